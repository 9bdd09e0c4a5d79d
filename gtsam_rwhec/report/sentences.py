"""A solution in words: what is proven, its parts, its scale and its weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.solver.certificate import Basis, Certificate, Status
from gtsam_rwhec.solver.solution import Solution


def certificate_sentence(certificate: Certificate, answer: str = "this answer") -> str:
    """What the certificate proves about the cost of the answer, which the sentence calls ``answer``."""
    region = certificate.region
    no_answer = "no answer" if region is None else f"no answer within {region.distance}"
    proof = (
        f"{answer} costs {certificate.cost:.10g}, and {no_answer} can cost less than {certificate.lower_bound:.10g} "
        f"(relative gap {certificate.relative_gap:.1e}; {certificate.path.words})"
    )
    limits = limits_of(certificate)
    if certificate.status is Status.CERTIFIED:
        return f"Certified globally optimal: {proof}.{limits}"
    if certificate.status is Status.CERTIFIED_NOT_UNIQUE:
        return f"Certified, but not unique: {proof}; other answers fit equally well, up to noise.{limits}"
    if certificate.status is Status.GAP:
        return f"Not certified: {proof}; {certificate.reason}.{limits}"
    return f"Not certified: {answer} costs {certificate.cost:.10g}; {certificate.reason}."


def limits_of(certificate: Certificate) -> str:
    """What the bound is not about, in sentences with a blank before each; empty where it is about everything."""
    region, basis = certificate.region, _BASES[certificate.basis]
    said = "" if region is None else f" {str(region)[0].upper()}{str(region)[1:]}."
    return said + (f" {basis}" if basis else "")


_BASES = {
    Basis.MEASUREMENTS: "",
    Basis.MOMENTS: "It is of the moments: the measurements were not kept, so the rounding of the sums is not in it.",
}


def part_sentences(solution: Solution) -> Iterator[str]:
    """A sentence for each unconnected part, if there are several parts."""
    if len(solution.parts) < 2:
        return
    yield f"The measurements fall into {len(solution.parts)} unconnected parts. Each was solved by itself:"
    for part in solution.parts:
        yield f"  - {', '.join(sorted(part.names, key=natural_key))}: {certificate_sentence(part.certificate)}"


def scale_sentence(solution: Solution) -> str:
    """The scale and its meaning for lengths."""
    if solution.scale_mode == "known":
        return "Scale: 1, known."
    if isinstance(solution.scale, Mapping):
        return "Scale: the table has the scale of each target; measured length = scale x true length."
    longer = 100.0 * (solution.scale - 1.0)
    comparison = "longer" if longer >= 0 else "shorter"
    return (
        f"Scale: {solution.scale:.6g}; measured lengths are {abs(longer):.2f}% {comparison} than true ones "
        "(measured length = scale x true length)."
    )


def weights_sentence(solution: Solution, source: str = "as given", *, noise_is_estimated: bool = False) -> str:
    """Where the weights of the measurements come from (`source`), and what the cost means with these weights.

    ``noise_is_estimated``: there are covariances from the noise that the residuals show.
    """
    if solution.is_relative and noise_is_estimated:
        return (
            "Weights: sigma or kappa was not given, so the certified cost is relative. The covariances are not: they "
            "come from the noise that the residuals show."
        )
    if solution.is_relative:
        return (
            "Weights: sigma or kappa was not given and 1 was used, so costs and covariances are relative. Give both "
            "for absolute numbers."
        )
    if solution.certificate.objective.form == "inverse":
        return f"Weights: {source}. The cost is not a chi-square: it is of the inverse equation B X^-1 = Y^-1 A."
    return f"Weights: {source}. If they are true, the cost is half a chi-square."


def time_sentence(certificate: Certificate) -> str:
    """How long each step took."""
    stages = ", ".join(f"{stage} {seconds:.3f}" for stage, seconds in certificate.seconds.items())
    return f"Time of the certified solution alone: {sum(certificate.seconds.values()):.3f} s ({stages})."
