"""``difference``: what changed from one calibration to the next, and whether by more than chance."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.files.terminal_text import brief, shown
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.change_test import LEVEL, ChangeTest, change_test, checked_level
from gtsam_rwhec.results.common_quantities import Movement, Quantities, less_common_errors, numbers_of, quantities
from gtsam_rwhec.results.result_file import Result
from gtsam_rwhec.results.schema import CalibrationFields
from gtsam_rwhec.solver.solution import Solution


@dataclass(frozen=True)
class NumberChange:
    """How a number changed that both calibrations estimated: a scale, a time offset, a camera's parameter."""

    name: str  #: "scale:board", "time_offset:cam", "fx of cam"
    old: float
    new: float


@dataclass(frozen=True)
class Difference:
    """What changed from an old calibration to a new one; ``str()`` is the verdict."""

    movements: dict[str, Movement]  #: Of every frame that both have; sensors first
    #: By group ("scale:board", "time_offset:cam", "intrinsics:cam"), of what both estimated
    numbers: dict[str, tuple[NumberChange, ...]]
    test: ChangeTest | None  #: None where it does not apply; ``why_no_test`` says why
    why_no_test: str
    not_compared: dict[str, str]  #: What the test leaves out, with the reason
    remarks: tuple[str, ...]  #: Frames that only one has, other ways to count sizes, what was assumed
    is_same: bool = field(default=False)

    @property
    def has_changed(self) -> bool:
        """Whether something changed by more than chance."""
        return self.test is not None and self.test.has_changed

    def __str__(self) -> str:
        if self.is_same:
            return "Nothing changed: both are the same answer, number by number."
        if self.test is None:
            return f"Not tested: {self.why_no_test}."
        level = f"{100.0 * self.test.level:g} %"
        if not self.test.has_changed:
            return (
                f"Nothing changed by more than chance at {level}: the two differ by {self.test.deviations:.1f} joint "
                f"deviations in {self.test.dimension} directions, as much as without a change in "
                f"{share_words(self.test.chance)}."
            )
        named = self.test.changed
        if not named:
            return (
                f"Changed, by more than chance at {level}: by {self.test.deviations:.1f} joint deviations in "
                f"{self.test.dimension} directions together. No frame stands out by itself."
            )
        return f"Changed: {'; '.join(self.sentence(name) for name in named)}, more than chance at {level}."

    def sentence(self, name: str) -> str:
        """How one frame or number changed, in words, without a full stop."""
        if name in self.movements:
            return movement_words(name, self.movements[name], self.test)
        said = ", ".join(f"{shown(one.name)} from {one.old:.6g} to {one.new:.6g}" for one in self.numbers[name])
        return said + _deviations(name, self.test)


def movement_words(name: str, moved: Movement, test: ChangeTest | None) -> str:
    """How a frame moved, in words, without a full stop."""
    verb = "moved" if test is None or name in test.changed else "differs by"
    return f"{shown(name)} {verb} {moved}{_deviations(name, test)}"


def _deviations(name: str, test: ChangeTest | None) -> str:
    return "" if test is None or name not in test.groups else f": {test.groups[name].deviations:.1f} joint deviations"


def share_words(chance: float) -> str:
    """A chance in words, such as "23 of 100 comparisons"."""
    if chance >= 0.01:
        return f"{100.0 * chance:.0f} of 100 comparisons"
    return "less than one of 100 comparisons"


@one_blas_thread()
def difference(
    old: Result | Calibration,
    new: Result | Calibration,
    *,
    level: float = LEVEL,
    frames: Collection[str] = (),
    clocks_may_change: bool = False,
    same_arm: bool = True,
    same_measurements: bool = False,
) -> Difference:
    """What changed from an old calibration to a new one, and whether by more than chance.

    The difference of both answers is compared with the sum of both joint covariances: of all frames, scales, time
    offsets and intrinsics that both have, together and one by one (`change_test`). The errors of the two are taken as
    independent. Where they share some (a prior of intrinsics, the systematic error of one arm), false alarms are fewer
    than the level says, and small changes are harder to see.

    Parameters
    ----------
    old, new : Result (``rw.results.read_result``) or Calibration
    level : float
        How often it may say that something changed where nothing did.
    frames : names, optional
        Only these frames are tested. One frame alone is tested most sharply.
    clocks_may_change : bool
        Whether time offsets are left out of the test.
    same_arm : bool
        Whether the carriers' poses come from the same arm or tracker. A constant error of these, which no residual
        shows, is then the same in both, and does not count in the difference.
    same_measurements : bool
        Whether both are known to have the same measurements, such as by checksums of files: then nothing is tested. The
        same numbers in both are noticed without this option.

    Raises
    ------
    FrameError
        They have no frame in common, their carriers or roles differ, or ``frames`` has a name that is in neither.
    OptionError
        ``level`` is not between 0 and 1, or an argument is of another type.
    """
    checked_level(level)
    first, second = (as_result(each) for each in (old, new))
    check_same_rig(first, second)
    answers = [each.refined or each.solution for each in (first, second)]
    made_anew = objects_of(first, second)
    movements = {name: moved for name, moved in movements_of(*answers).items() if name not in made_anew}
    unknown = [name for name in frames if name not in movements]
    if unknown:
        raise FrameError(
            f"both must have {', '.join(map(brief, unknown))}; both have {', '.join(map(shown, movements))}"
        )
    remarks = list(remarks_of(first, second))
    if first.refined is None or second.refined is None:
        which = " and ".join(name for name, each in (("OLD", first), ("NEW", second)) if each.refined is None)
        why = f"{which} has no covariances, because it was not refined; calibrate with rw.calibrate or gtsam-rwhec"
        return Difference(movements, {}, None, why, {}, tuple(remarks))
    without = {UnknownKind.TIME_OFFSET} if clocks_may_change else set()
    counted = first.refined, second.refined
    if same_arm:
        counted = without_constant_errors(first), without_constant_errors(second)
    common = quantities(*counted, without)
    common = common.only(lambda unknown: unknown.owner not in made_anew)
    numbers = _numbers(first.refined, second.refined, common)
    not_compared = {str(unknown): why for unknown, why in common.not_compared.items()}
    not_compared |= dict.fromkeys(sorted(made_anew), MADE_ANEW)
    if all(abs(common.difference) <= SAME) and all(abs(moved.xi).max() <= SAME for moved in movements.values()):
        return Difference(movements, numbers, None, "", not_compared, tuple(remarks), is_same=True)
    if same_measurements or is_of_the_same_measurements(first, second):
        why = "both rest on the same measurements, whose errors cancel in the difference; compare with another log"
        return Difference(movements, numbers, None, why, not_compared, tuple(remarks))
    if frames:
        common = common.only(lambda unknown: unknown.kind is UnknownKind.FRAME and unknown.owner in frames)
    if not common.slots:
        why = "nothing is left to compare: " + "; ".join(f"{shown(name)}: {why}" for name, why in not_compared.items())
        return Difference(movements, numbers, None, why, not_compared, tuple(remarks))
    freedom = first.refined.degrees_of_freedom, second.refined.degrees_of_freedom
    test = change_test(common.difference, common.covariances, common.free, common.groups, freedom, level)
    if same_arm and has_constant_errors(first) and has_constant_errors(second):
        remarks.append(
            "a constant error of the carriers' poses, which no residual shows, counts as the same in both and not as a "
            "change (unless NEW is said to have another arm)"
        )
    remarks.append(
        "the errors of both are taken as independent; errors that both share, such as those of one arm or of one "
        "stated lens, make alarms rarer than the level says"
    )
    return Difference(movements, numbers, test, "", not_compared, tuple(remarks))


#: Why the frame of an object is not compared.
MADE_ANEW = "its frame is made anew of each log's clouds"


def objects_of(*results: Result) -> frozenset[str]:
    """The targets that are objects in clouds."""
    logs = (result.log for result in results)
    return frozenset(each.target for log in logs if log is not None for each in log.detection.objects)


def movements_of(old: Solution | RefinedPoses, new: Solution | RefinedPoses) -> dict[str, Movement]:
    """How the frames moved that both have, sensors first."""
    both = ((old.Y, new.Y), (old.X, new.X))
    return {name: Movement.of(pose, now[name]) for poses, now in both for name, pose in poses.items() if name in now}


def as_result(given: object) -> Result:
    """The given result, or a result made of a calibration. Raises OptionError for anything else."""
    if isinstance(given, Calibration):
        if given.solution is None:
            raise OptionError(f"a calibration to compare has no answer: {given.judgement}")
        return Result(given.solution, given.refined, None, CalibrationFields.of(given))
    if not isinstance(given, Result):
        raise OptionError(
            f"a calibration to compare is a {type(given).__name__}; give what rw.results.read_result or rw.calibrate "
            "returned"
        )
    return given


def _numbers(old: RefinedPoses, new: RefinedPoses, common: Quantities) -> dict[str, tuple[NumberChange, ...]]:
    found = {}
    for unknown in common.slots:
        owner = unknown.owner
        if unknown.kind is UnknownKind.FRAME:
            continue
        if unknown.kind is UnknownKind.INTRINSICS:
            names = [f"{name} of {owner}" for name in old.intrinsics[owner].names]
        elif unknown.kind is UnknownKind.TIME_OFFSET:
            names = [f"time offset of {owner} (s)"]
        else:
            names = [f"scale of {owner}" if owner else "scale"]
        values = (numbers_of(each, unknown).tolist() for each in (old, new))
        found[str(unknown)] = tuple(map(NumberChange, names, *values))
    return found


#: Two numbers that differ by less than this share are the same number, computed twice.
SAME = 1e-12


def check_same_rig(old: Result, new: Result) -> None:
    """Raise FrameError if the calibrations do not have poses of the same frames on the same carriers."""
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


def has_constant_errors(result: Result) -> bool:
    """Whether the covariance holds a constant error of the carriers' poses, as the result says."""
    return result.calibration is not None and bool(np.any(result.calibration.constant_errors))


def without_constant_errors(result: Result) -> RefinedPoses:
    """The refined calibration with its covariance less that of a constant error of the carriers' poses.

    Unchanged if the result does not state this error, or if the covariance is smaller than that of the error.
    """
    refined, fields = result.refined, result.calibration
    assert refined is not None
    if fields is None or not has_constant_errors(result):
        return refined
    joint = refined.joint
    rest = less_common_errors(joint.finite, constant_covariance(refined, fields.constant_errors))
    return refined if rest is None else replace(refined, joint=replace(joint, finite=rest))


def constant_covariance(refined: RefinedPoses, constant_errors: tuple[tuple[float, ...], ...]) -> Array:
    """The part (d, d) of the covariance of all unknowns that a constant error of A makes, by its deviations."""
    joint = refined.joint
    total = np.zeros_like(joint.finite)
    for poses, deviations in zip((refined.X, refined.Y), constant_errors, strict=False):
        shift = np.zeros((len(total), 6))
        for name, pose in poses.items():
            unknown = Unknown(UnknownKind.FRAME, name)
            if unknown in joint.slots:
                shift[joint.slots[unknown]] = pose.inverse().AdjointMap() * np.array(deviations)
        total += shift @ shift.T
    return total
