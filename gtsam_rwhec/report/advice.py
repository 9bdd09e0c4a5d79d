"""What a person should do about a calibration: where it needs other measurements, and what is odd about its log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gtsam_rwhec.calibration.verdict import Ground, Judgement
from gtsam_rwhec.files.terminal_text import counted, natural_key, some
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.solver.certificate import Basis, Certificate, Status
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeReason
from gtsam_rwhec.solver.solution import Solution

#: A sentence, and its style on a terminal.
Styled = tuple[str, str]
#: An estimated size is named if it differs from the stated size by more than this many standard deviations.
SIZE_SIGMAS = 3.0
#: A common cause explains the targets' scales if they differ by less than this.
COMMON_SCALE = 0.005
#: Unknown tags are named up to this number.
MOST_NAMED = 10
#: Grounds that name the targets whose sizes are wrong.
SIZES = frozenset({Ground.SIZE_DOUBTED, Ground.NO_SIZE_FITS, Ground.SIZE_ESTIMATED})


def advice_of(
    free: Sequence[FreeDirection], log: LogFields | None = None, judgement: Judgement | None = None
) -> tuple[Styled, ...]:
    """What to do about a calibration that the ``judgement``, which stands above it, does not say.

    What the measurements leave free, with the cure, and what is odd about the log or its rig file. What a misreading
    leaves free is no fault of the motion, so its cure is the only one.
    """
    said: list[Styled] = []
    if free and not (judgement is not None and judgement.is_of_the_reading):
        open_ones = [direction for direction in free if direction.reason is not FreeReason.SLIDES]
        said += [(words, "bold red") for words in _not_determined(open_ones)]
        said += [(MEASURE_AGAIN, "")] if open_ones else []
        sliding = {name for one in free if one.reason is FreeReason.SLIDES for name in one.frames}
        said += [(SLIDES.format(", ".join(sorted(sliding, key=natural_key))), "")] if sliding else []
    doubts = [] if log is None else log_advice(log, judgement)
    return (*said, *((words, "bold yellow") for words in doubts))


MEASURE_AGAIN = "Measure again, and turn the carriers about at least two different axes. Or fix frames that you know."


#: What is seen of a target may slide along it, as a sphere turns about its centre.
SLIDES = (
    "Some turns or shifts of {} are free, as all that was seen of it slides along itself. The sensors' poses do not "
    "need them. If you need the whole pose, show another thing, or another side of it."
)


def _not_determined(free: Sequence[FreeDirection]) -> list[str]:
    """The free directions; those of too few measurements in one sentence, since each names the same frames."""
    few = [direction for direction in free if direction.reason is FreeReason.FEW]
    said = [f"Not determined: {direction}" for direction in free if len(few) < 2 or direction not in few]
    if len(few) > 1:
        frames = sorted({name for direction in few for name in direction.frames}, key=natural_key)
        said.insert(0, f"Not determined: {len(few)} directions of {some(frames, MOST_NAMED)}: {FreeReason.FEW.words}")
    return said


def log_advice(log: LogFields, judgement: Judgement | None = None) -> list[str]:
    """What is odd about a log or its rig file, and what to do about it, without the sizes that a judgement names."""
    of_clouds = {each.sensor for each in log.detection.objects}
    advice = [
        f"{counted(len(faults), 'cloud' if sensor in of_clouds else 'image')} of {sensor} could not be used. "
        f"The first: {faults[0]}"
        for sensor, faults in log.detection.undecoded.items()
        if faults
    ]
    if judgement is None or Ground.NO_ANSWER not in judgement.grounds:  # which says it with the counts
        advice += log.detection.likely
    contradicted = {counts.frame for counts in log.contradicted}
    given = [clock.sensor for clock in log.time_offsets if clock.sigma_s is None and clock.sensor in contradicted]
    if given and (judgement is None or not {Ground.MOVED, Ground.MIXED}.intersection(judgement.grounds)):
        advice.append(
            f"The time offset of {', '.join(given)} was not estimated. If the clock may be late, write time_offset: "
            "estimate in the rig file. Wrong intrinsics show like this, too."
        )
    grounds = () if judgement is None else judgement.grounds
    if Ground.INTRINSICS_DOUBTED not in grounds:  # with wrong focal lengths sizes say nothing
        advice += _sizes(log, are_said=bool(SIZES.intersection(grounds)))
    advice += log.detection.remarks
    if log.detection.strangers:
        names = [f"{name} ({count} times)" for name, count in log.detection.strangers.items()]
        advice.append(f"The images show tags that the rig file does not name: {some(names, MOST_NAMED)}.")
    return advice


def _sizes(log: LogFields, *, are_said: bool) -> list[str]:
    """Stated sizes that do not fit the motion, or that it does not check; not the doubted ones where these are said."""
    advice = []
    free = [size for size in log.sizes if size.is_free]
    doubted = [size for size in log.sizes if size.is_doubted and not size.is_free]
    for size in free + doubted:
        if are_said and size.is_doubted:
            continue
        off = size.percent_too_large
        fact = (
            f"The stated size of {size.target} is {abs(off):.2f} % too {'large' if off > 0 else 'small'}: the rig file "
            f"says {1e3 * size.stated_m:.3f} mm, the motion says {1e3 * size.stated_m / size.scale:.3f} mm."
        )
        if size in doubted:
            advice.append(
                f"{fact} The poses use the rig file's size and may be wrong. Measure the target, or write sizes: check "
                "in the rig file."
            )
        elif size.sigma is not None and abs(size.scale - 1.0) > SIZE_SIGMAS * size.sigma:
            advice.append(
                f"{fact} The poses use the size that the motion gives. Measure the target and correct the rig file."
            )
    unchecked = [size.target for size in log.sizes if size.sigma is None]
    if unchecked:
        advice.append(
            f"The motion is too small to check the size of {', '.join(unchecked)}. Measure it with care: the "
            "calibration does not show if it is wrong."
        )
    suspects = free or doubted
    if len(suspects) > 1 and len(suspects) == len(log.sizes) and np.ptp([s.scale for s in suspects]) < COMMON_SCALE:
        advice.append(
            "All sizes are wrong by nearly the same factor. More probably the carriers' unit of length or the focal "
            "lengths are wrong."
        )
    return advice


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


def weights_sentence(solution: Solution, *, noise_is_estimated: bool = False) -> str:
    """Where the weights of the measurements come from, and what the cost means with these weights.

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
        return "Weights: as given. The cost is not a chi-square: it is of the inverse equation B X^-1 = Y^-1 A."
    return "Weights: as given. If they are true, the cost is half a chi-square."


def time_sentence(certificate: Certificate) -> str:
    """How long each step took."""
    stages = ", ".join(f"{stage} {seconds:.3f}" for stage, seconds in certificate.seconds.items())
    return f"Time of the certified solution alone: {sum(certificate.seconds.values()):.3f} s ({stages})."
