"""Whether two results can be compared: the same rig, other measurements; and what else differs between them."""

from __future__ import annotations

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.results.result_file import Result

#: Two numbers that differ by less than this share are the same number, computed twice.
SAME = 1e-12


def check_same_rig(old: Result, new: Result) -> None:
    """A FrameError for calibrations that do not say poses of the same frames in the same carriers."""
    first, second = old.refined or old.solution, new.refined or new.solution
    if old.log is not None and new.log is not None:
        for what in ("sensor_carrier", "target_carrier"):
            names = [getattr(each.log, what) for each in (old, new)]
            if names[0] != names[1]:
                raise FrameError(
                    f"OLD has poses in the frame {shown(names[0])}, NEW in {shown(names[1])} "
                    f"({what.replace('_', ' ')}): these are of different rigs. "
                    "Compare results of one rig file, or name the carrier as before"
                )
    exchanged = [
        name
        for name in (*first.X, *first.Y)
        if (name in first.X) != (name in second.X) and name in (second.X | second.Y)
    ]
    if exchanged:
        raise FrameError(
            f"{', '.join(map(shown, exchanged))}: a target in one of the two and a sensor in the other; exchange one"
        )
    if not (first.X.keys() & second.X.keys() or first.Y.keys() & second.Y.keys()):
        theirs = [", ".join(map(shown, (*each.Y, *each.X))) for each in (first, second)]
        raise FrameError(f"no frame is in both: OLD has {theirs[0]}, NEW has {theirs[1]}. They are of different rigs")


def is_of_the_same_measurements(old: Result, new: Result) -> bool:
    """Whether two results rest on the same measurements, by the noise of their corners or by their residuals.

    Numbers that come from images or poses with noise are equal to the last digits only if these are the same.
    """
    if old.log is not None and new.log is not None:
        noise = [each.log.detection.corner_px for each in (old, new) if each.log is not None]
        if noise[0] and noise[0] == noise[1] and len(set(noise[0].values())) > 1:
            return True
    residuals = [each.solution.residuals for each in (old, new)]
    pairs = [pair for pair in residuals[0] if pair in residuals[1]]
    return any(
        residuals[0][pair].translation_rms_m > 0.0
        and abs(residuals[0][pair].translation_rms_m / residuals[1][pair].translation_rms_m - 1.0) <= SAME
        for pair in pairs
        if residuals[1][pair].translation_rms_m > 0.0
    )


def remarks_of(old: Result, new: Result) -> list[str]:
    """What differs between the two besides their numbers, in words."""
    remarks = []
    first, second = old.refined or old.solution, new.refined or new.solution
    for which, own, other in (("OLD", first, second), ("NEW", second, first)):
        alone = [name for name in (*own.Y, *own.X) if name not in other.X and name not in other.Y]
        if alone:
            remarks.append(f"only {which} has {', '.join(map(shown, alone))}")
    if first.scale_mode != second.scale_mode:
        words = {"known": "sizes as known", "shared": "one scale for all sizes", "per_target": "a scale for each size"}
        remarks.append(f"OLD has {words[first.scale_mode]}, NEW {words[second.scale_mode]}: sizes are not compared")
    for which, each in (("OLD", old), ("NEW", new)):
        judgement = each.judgement
        if judgement.verdict is Verdict.DO_NOT_USE:
            remarks.append(f"{which} itself says: {judgement}")
        if each.refined is not None:
            remarks += [f"{which} leaves free: {direction}" for direction in each.refined.free_directions]
    return remarks
