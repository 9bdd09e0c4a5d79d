"""The third stage: from synchronised pairs to a certified, refined calibration with checked sizes and time offsets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.misreadings import Reading
from gtsam_rwhec.calibration.outliers import Outliers
from gtsam_rwhec.calibration.verdict import OUTLIERS, Choice, Finding, Ground, Judgement, Verdict
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.fitting.refined import Refined, RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.logs import Log, open_log
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.log_history import LogFields, OutlierCount, SizeFields, TimeOffsetFields
from gtsam_rwhec.results.removed_measurements import RemovalReason
from gtsam_rwhec.results.result_judgement import judge, short_of_measurements
from gtsam_rwhec.rig import GivenSection, Rig
from gtsam_rwhec.runs.carrier_motion import read_carrier_motion
from gtsam_rwhec.runs.changed_rig import rig_for_solving
from gtsam_rwhec.runs.comparable_noise import with_comparable_noise
from gtsam_rwhec.runs.doubted_intrinsics import doubted_intrinsics, finding_against
from gtsam_rwhec.runs.doubted_shapes import continued_boards, doubted_shapes
from gtsam_rwhec.runs.first_answer import first_answer
from gtsam_rwhec.runs.log_corners import LogCorners
from gtsam_rwhec.runs.log_findings import (
    estimated_sizes,
    in_rig_file,
    known_to_nothing,
    may_be_exchanged,
    moved_of_left_out,
    not_of_late_clocks,
    not_of_marked_outliers,
    with_cures,
)
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs, poses_used, problem_of, read_pairs
from gtsam_rwhec.runs.run_log import CLEANING_METADATA, read_cleaning_report, read_metadata
from gtsam_rwhec.runs.solving_rounds import Pairs, Purpose, SolvingRounds, sigma_of, without_outlier_marks
from gtsam_rwhec.runs.turned_images import turned_images
from gtsam_rwhec.solver.solution import Solution


@dataclass(frozen=True, eq=False)
class Solved:
    """A calibration from a log, as a solved log holds it.

    Attributes
    ----------
    refined : RefinedPoses
        Poses, covariances, scales; ``time_offsets_s`` has the whole offsets, not changes of a first estimate.
    solution : Solution
        The certified solution, with its certificate.
    pairs : dict of (target, sensor) to MeasuredPairs
        Every measurement, with A at the final time offsets, and the reason if it is not used.
    log : LogFields
        The reports of all stages.
    cameras : dict of sensor to Camera
        Intrinsics.
    rig : Rig
        The rig file that was used.
    judgement : Judgement
        The verdict, with its grounds.
    """

    refined: RefinedPoses
    solution: Solution
    pairs: Pairs
    log: LogFields
    cameras: dict[str, Camera]
    rig: Rig
    judgement: Judgement


@dataclass(frozen=True, eq=False)
class Calibrated(Solved):
    """A calibration that was just computed: `refined` is a `Refined`, with all that refinement found.

    Attributes
    ----------
    calibration : Calibration
        What ``calibrate`` found and chose; its refined poses, time offsets and outliers are those of the whole log.
    problem : Problem
        The measurements of the certified solution, with their weights.
    """

    refined: Refined
    calibration: Calibration
    problem: Problem


@one_blas_thread()
def solve_log(log: Log | str | Path, rig: Rig | None = None, *, progress: Progress | None = None) -> Calibrated:
    """Calibrate from a cleaned log.

    Parameters
    ----------
    log : Log or path
        The log that ``clean_log`` wrote.
    rig : Rig, optional
        By default the rig file embedded in the log.
    progress : callable, optional

    Raises
    ------
    LogError
        The log has no usable pairs, or was not cleaned.
    RwhecError
        As ``solve`` and ``refine`` do.
    """
    if not isinstance(log, Log):
        with open_log(log) as opened:
            return solve_log(opened, rig, progress=progress)
    path = log.files[0].path
    rig = rig_for_solving(log, rig)
    if rig.is_of_odometries:
        raise LogError(f"{path}: no sensor sees a target; solve it with solve_odometries")
    if rig.given != GivenSection():
        raise LogError(
            f"{rig.source.place(('given',))}: what is given is not used where cameras see targets; "
            "leave it out, or calibrate the odometries alone"
        )
    metadata, cleaning = read_metadata(log), read_cleaning_report(log)
    pairs = read_pairs(log, rig)
    used_sensors = {measured.sensor for measured in pairs.values() if measured.used.any()}
    if not used_sensors:
        raise LogError(f"{path}: it has no usable pair of measurements")
    motion = read_carrier_motion(log, rig)
    logged = LogCorners.of(log, rig, metadata.cameras)
    doubted = doubted_intrinsics(log, rig, metadata.cameras)
    of_shapes = doubted_shapes(log, rig, metadata.cameras)
    of_shapes += continued_boards(metadata.detection.strangers, rig)
    estimated = tuple(
        name for name, sensor in rig.sensors.items() if sensor.time_offset == "estimate" and name in used_sensors
    )
    missing = [name for name in estimated if name not in cleaning.time_offsets_s]
    if missing:
        raise LogError(f"{path}, metadata {CLEANING_METADATA}: no time offset of {', '.join(missing)}")
    rounds = SolvingRounds(rig, motion, estimated, progress or silent)
    given = with_comparable_noise(rounds, rounds.at(without_outlier_marks(pairs), cleaning.time_offsets_s))
    stated = [name for name in rig.sensors if name in used_sensors and name not in estimated]
    stated_s = {name: given.offsets_s.get(name, 0.0) for name in stated}
    first = first_answer(rounds, given, logged, metadata.cameras, stated_s, doubted)
    poses, of_corners, before, late = first.poses, first.of_corners, first.misreadings, first.late
    is_misread = first.is_misread
    settled, sizes = poses.pairs, poses.sizes
    calibration = rounds.calibrated(settled, poses.free, is_late=bool(late))
    # Without a refined calibration (the measurements look misread) the poses are refined all the same, for the plots.
    purpose: Purpose = "plots" if is_misread or late else "answer"
    refined = calibration.refined or rounds.refined(settled, poses.free, purpose)
    if calibration.refined is not None and not refined.free_directions:
        refined = of_corners.refined(refined, calibration.noise.model)
    # Those that were estimated from the same corners are named by them.
    of_intrinsics = (
        () if refined.intrinsics else tuple(finding_against(name, one, rig) for name, one in doubted.items())
    )
    offsets = settled.offsets_s | {n: settled.offsets_s[n] + value for n, value in refined.time_offsets_s.items()}
    outliers = tuple(_outlier_count(measured) for measured in settled.pairs.values())
    refined = replace(
        refined,
        time_offsets_s={name: offsets[name] for name in refined.time_offsets_s},
        inlier_counts={
            count.pair: (count.used, count.used + count.left_out)
            for count in outliers
            if rig.cleaning.robust == "gnc" and (count.used or count.left_out)
        },
    )
    fields = LogFields(
        sensor_carrier=rig.carriers.sensors,
        target_carrier=rig.carriers.targets,
        detection=metadata.detection,
        cleaning=cleaning,
        outliers=outliers,
        sizes=tuple(_in_the_answer(size, refined) for size in sizes),
        time_offsets=tuple(
            TimeOffsetFields(
                sensor=name,
                offset_s=offsets[name],
                sigma_s=sigma_of(refined, Unknown(UnknownKind.TIME_OFFSET, name))
                if name in refined.time_offsets_s
                else None,
            )
            for name in rig.sensors
            if name in offsets
        )
        + tuple(
            TimeOffsetFields(
                sensor=name, offset_s=cleaning.time_offsets_s[name], sigma_s=cleaning.coarse_sigma_s.get(name)
            )
            for name in rig.odometries
            if name in cleaning.time_offsets_s
        ),
    )
    left_out = _outliers(outliers, looked_for=rig.cleaning.robust == "gnc")
    findings = with_cures(calibration.findings, calibration.misreadings, rig)
    if left_out.looked_for:
        findings = not_of_marked_outliers(findings)
    if late:
        findings = not_of_late_clocks(findings, calibration.misreadings)
    findings = (*of_intrinsics, *of_shapes, *findings, *late)
    findings = (*findings, *estimated_sizes(fields.sizes, rig, with_intrinsics=bool(refined.intrinsics)))
    if refined.intrinsics or of_corners.corners is None:
        findings = (*findings, *of_corners.findings)
    if is_misread:  # as the poses were written, which tells more than A
        found = Reading(in_rig_file(before, rig)).finding
        others = (one for one in findings if one.ground not in (Ground.MISREAD, Ground.IMPLAUSIBLE))
        findings = (*([found] if found is not None else []), *others)
        calibration = replace(calibration, misreadings=before)
    findings = (*findings, *(Finding(Ground.IMAGES_BLURRED, words) for words in metadata.detection.blurred))
    if not (is_misread or late):
        findings = (*findings, *moved_of_left_out(findings, refined, settled.pairs))
        findings = (*findings, *turned_images(settled.pairs, refined, rig, metadata.image_names))
    if not is_misread:  # a misreading makes cleaning remove measurements that are right
        findings = (*findings, *short_of_measurements(fields, poses_used(settled.pairs.values())))
        if calibration.judgement.verdict is not Verdict.DO_NOT_USE and rounds.may_be_exchanged(settled):
            findings = (*findings, may_be_exchanged(rig, sum(count.used for count in outliers)))
    if calibration.judgement.verdict is not Verdict.DO_NOT_USE:
        findings = (*findings, *known_to_nothing(calibration.points.values(), rig))
    judgement = judge(refined.solution, refined, fields, findings)
    calibration = replace(
        calibration,
        findings=findings,
        misreadings=in_rig_file(calibration.misreadings, rig),
        refined=refined,
        X=refined.X,
        Y=refined.Y,
        scale=refined.scale,
        time_offsets_s=refined.time_offsets_s,
        judgement=judgement,
        outliers=left_out,
        choices=(
            *_choices_before(rig, estimated, left_out),
            *_made_in_the_answer(calibration.choices),
            *of_corners.choices,
        ),
    )
    solution, cameras = refined.solution, dict(metadata.cameras)
    # With B by the stated intrinsics, as it was read: a log that is solved again begins where it began.
    pairs = {
        pair: replace(one, B=pairs[pair].B, covariance=pairs[pair].covariance) for pair, one in settled.pairs.items()
    }
    problem = problem_of(settled.pairs, rig, settled.offsets_s, poses.free)
    return Calibrated(refined, solution, pairs, fields, cameras, rig, judgement, calibration, problem)


def _outliers(counts: tuple[OutlierCount, ...], *, looked_for: bool) -> Outliers:
    """The outliers of the whole log."""
    used = {name for count in counts if count.used for name in count.pair}
    return Outliers(
        inliers={},
        counts={count.pair: (count.used, count.used + count.left_out) for count in counts},
        left_out=tuple(dict.fromkeys(name for count in counts for name in count.pair if name not in used)),
        looked_for=looked_for,
    )


def _choices_before(rig: Rig, estimated: tuple[str, ...], outliers: Outliers) -> tuple[Choice, ...]:
    """What was chosen in the rounds before the answer."""
    choices = []
    if outliers.looked_for:
        choices.append(outliers.choice("they are farther off than the noise of the others explains"))
    else:
        choices.append(Choice(OUTLIERS, "every measurement counts", "the rig file says so"))
    if estimated:
        choices.append(
            Choice("time offsets", f"estimated for {', '.join(estimated)}", "the rig file states none for them")
        )
    return tuple(choices)


def _made_in_the_answer(choices: tuple[Choice, ...]) -> tuple[Choice, ...]:
    return tuple(choice for choice in choices if choice.what not in (OUTLIERS, "sizes of targets", "time offsets"))


def _in_the_answer(size: SizeFields, refined: Refined) -> SizeFields:
    """A free size as the answer has it. The answer takes the sizes that are not free as known."""
    unknown = Unknown(UnknownKind.SCALE, size.target)
    if isinstance(refined.scale, float) or unknown not in refined.joint.slots:
        return size
    found = {"scale": refined.scale[size.target], "sigma": sigma_of(refined, unknown), "is_free": True}
    return size.model_copy(update=found)


def _outlier_count(measured: MeasuredPairs) -> OutlierCount:
    """How many measurements robust estimation used and left out."""
    count = measured.count
    left_out = count.removed.get(RemovalReason.OUTLIER, 0)
    return OutlierCount(target=count.target, sensor=count.sensor, used=count.used, left_out=left_out)
