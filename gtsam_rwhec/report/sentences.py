"""A solution in words: what is proven, what is left free, what the numbers may be used for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from gtsam_rwhec.files.natural_order import natural_key
from gtsam_rwhec.solver.cause import Status
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solving.solution import Solution


def summary_sentence(solution: Solution) -> str:
    """How much was solved: "16 targets, 8 sensors, 73 pairs, 3230 measurements"."""
    measurements = sum(residual.number_of_measurements for residual in solution.residuals.values())
    counts = (
        (len(solution.X), "target"),
        (len(solution.Y), "sensor"),
        (len(solution.residuals), "pair"),
        (measurements, "measurement"),
    )
    return ", ".join(f"{number} {word}{'' if number == 1 else 's'}" for number, word in counts)


def certificate_sentence(certificate: Certificate) -> str:
    """What is proven about the cost, in one sentence."""
    proof = (
        f"this answer costs {certificate.cost:.10g}, and no answer can cost less than {certificate.lower_bound:.10g} "
        f"(relative gap {certificate.relative_gap:.1e}; by {certificate.path})"
    )
    if certificate.status is Status.CERTIFIED:
        return f"Certified globally optimal: {proof}."
    if certificate.status is Status.CERTIFIED_NOT_UNIQUE:
        return f"Certified, but not unique: {proof}; other answers fit as well, up to noise."
    if certificate.status is Status.GAP:
        return f"Not certified: {proof}; {certificate.reason}."
    return f"Not certified: this answer costs {certificate.cost:.10g}; {certificate.reason}."


def identifiability_sentences(solution: Solution) -> Iterator[str]:
    """What the measurements do not determine; nothing when they determine everything."""
    identifiability = solution.identifiability
    if identifiability.is_unique:
        return
    yield "Not determined by these measurements (do not use these numbers):"
    for direction in identifiability.free_directions:
        yield f"  - {direction}"
    yield "What helps: turn further, about at least two different axes, while measuring; or fix frames that are known."


def part_sentences(solution: Solution) -> Iterator[str]:
    """One sentence for each unconnected part, when there are several."""
    if len(solution.parts) < 2:
        return
    yield f"The measurements fall into {len(solution.parts)} unconnected parts, each solved on its own:"
    for part in solution.parts:
        yield f"  - {', '.join(sorted(part.names, key=natural_key))}: {certificate_sentence(part.certificate)}"


def scale_sentence(solution: Solution) -> str:
    """What the scale is and what that means for lengths."""
    if solution.scale_mode == "known":
        return "Scale: known, 1."
    if isinstance(solution.scale, Mapping):
        return "Scale: one for each target, in the table; measured length = scale x true length."
    longer = 100.0 * (solution.scale - 1.0)
    comparison = "longer" if longer >= 0 else "shorter"
    return (
        f"Scale: {solution.scale:.6g}; measured lengths are {abs(longer):.2f}% {comparison} than true ones "
        "(measured length = scale x true length)."
    )


def weights_sentence(solution: Solution) -> str:
    """What the cost may be compared with."""
    if solution.is_relative:
        return "Weights: sigma or kappa was not given, and 1 (m) was used; costs and covariances are relative."
    if solution.certificate.objective.form == "inverse":
        return "Weights: as given; the cost is that of the inverse equation B X^-1 = Y^-1 A, which is no chi-square."
    return "Weights: as given; if they are true, the cost is half a chi-square."


def time_sentence(certificate: Certificate) -> str:
    """Where the time went."""
    stages = ", ".join(f"{stage} {seconds:.3f}" for stage, seconds in certificate.seconds.items())
    return f"Time: {sum(certificate.seconds.values()):.3f} s ({stages})."
