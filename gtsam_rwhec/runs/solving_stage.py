"""The third stage: calibrate from a cleaned log, with the findings that only a log allows."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions, Recording, SizesChoice
from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.known_frames import known_all_the_same
from gtsam_rwhec.calibration.misreadings import Reading, are_too_few_to_tell, exchange_of
from gtsam_rwhec.calibration.outliers import Outliers
from gtsam_rwhec.calibration.stages import calibrate
from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement, Verdict
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_evidence import IntrinsicsEvidence
from gtsam_rwhec.errors import CameraError, LogError, RwhecError, RwhecWarning
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.fitting.fit_options import CornerOptions, RefineOptions
from gtsam_rwhec.fitting.refined import PairNoise, Refined, RefinedPoses, sigma_of
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.logs.mcap_reader import Log, open_log
from gtsam_rwhec.problem.directions import shifted_and_turned
from gtsam_rwhec.problem.knowledge import Stretch
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.results.log_history import (
    OF_THE_MOTION,
    CleaningReport,
    LogFields,
    OutlierCount,
    RemovalReason,
    SizeFields,
    TimeOffsetFields,
)
from gtsam_rwhec.results.result_judgement import judge, short_of_measurements
from gtsam_rwhec.rig.odometry_sections import GivenSection
from gtsam_rwhec.rig.rig import Rig
from gtsam_rwhec.runs.carrier_motion import CarrierMotion, read_carrier_motion
from gtsam_rwhec.runs.changed_rig import rig_for_solving
from gtsam_rwhec.runs.clocks_by_turning import late_clocks
from gtsam_rwhec.runs.doubted_statements import continued_boards, doubted_intrinsics, doubted_shapes, finding_against
from gtsam_rwhec.runs.log_corners import LogCorners
from gtsam_rwhec.runs.log_findings import (
    estimated_sizes,
    in_rig_file,
    known_to_nothing,
    may_be_exchanged,
    turned_images,
)
from gtsam_rwhec.runs.measured_pairs import (
    MeasuredPairs,
    Pairs,
    at_offsets,
    poses_used,
    problem_of,
    read_pairs,
    without_marks,
)
from gtsam_rwhec.runs.run_log import CLEANING_METADATA, LogMetadata, read_cleaning_report, read_metadata
from gtsam_rwhec.solver.solution import Solution, solve

#: Findings of ``calibrate`` that this stage words anew, with the lines of the rig file and the images.
SAID_BY_THE_LOG = frozenset({
    Ground.NO_ANSWER, Ground.FEW_MEASUREMENTS, Ground.SIZE_DOUBTED, Ground.SIZE_UNCERTAIN, Ground.SIZE_ESTIMATED,
    Ground.NO_SIZE_FITS,
})  # fmt: skip
#: The option of ``calibrate`` for each value of ``sizes`` in the rig file.
SIZES: dict[str, SizesChoice] = {"known": "check", "check": "correct", "estimate": "estimate"}


@dataclass(frozen=True, eq=False)
class Solved:
    """A calibration from a log, as a solved log holds it."""

    #: Poses, covariances, scales; ``time_offsets_s`` has the whole offsets, not changes of a first estimate
    refined: RefinedPoses
    solution: Solution  #: The certified solution, with its certificate
    pairs: Pairs  #: Every measurement, with A at the final time offsets, and the reason if it is not used
    log: LogFields  #: The reports of all stages
    cameras: dict[str, Camera]  #: Intrinsics
    rig: Rig  #: The rig file that was used
    judgement: Judgement  #: The verdict, with its grounds


@dataclass(frozen=True, eq=False)
class Calibrated(Solved):
    """A calibration that was just computed: `refined` is a `Refined`, with all that refinement found."""

    refined: Refined
    #: What ``calibrate`` found and chose; its refined poses, time offsets and outliers are those of the whole log
    calibration: Calibration
    problem: Problem  #: The measurements of the certified solution, with their weights


@dataclass(frozen=True, eq=False)
class CleanedLog:
    """What a cleaned log holds for its calibration; offsets in seconds by sensor."""

    rig: Rig
    metadata: LogMetadata
    cleaning: CleaningReport
    pairs: Pairs
    motion: CarrierMotion
    corners: LogCorners
    doubted: Mapping[str, IntrinsicsEvidence]
    of_shapes: tuple[Finding, ...]
    estimated: tuple[str, ...]

    @staticmethod
    def read(log: Log, rig: Rig | None) -> CleanedLog:
        """Read a log that ``clean_log`` wrote; `LogError` where it cannot be calibrated."""
        path, rig = log.files[0].path, rig_for_solving(log, rig)
        if rig.is_of_odometries:
            raise LogError(f"{path}: no sensor sees a target; solve it with solve_odometries")
        if rig.given != GivenSection():
            raise LogError(
                f"{rig.source.place(('given',))}: what is given is not used where cameras see targets; "
                "leave it out, or calibrate the odometries alone"
            )
        metadata, cleaning = read_metadata(log), read_cleaning_report(log)
        pairs = without_marks(read_pairs(log, rig), (RemovalReason.OUTLIER,))
        used = {pair.sensor for pair, measured in pairs.items() if measured.used.any()}
        if not used:
            raise LogError(f"{path}: it has no usable pair of measurements")
        motion = read_carrier_motion(log, rig)
        corners = LogCorners.of(log, rig, metadata.cameras)
        doubted = doubted_intrinsics(log, rig, metadata.cameras)
        of_shapes = doubted_shapes(log, rig, metadata.cameras)
        of_shapes += continued_boards(metadata.detection.strangers, rig)
        asked = [name for name, sensor in rig.sensors.items() if sensor.time_offset == "estimate" and name in used]
        missing = [name for name in asked if name not in cleaning.time_offsets_s]
        if missing:
            raise LogError(f"{path}, metadata {CLEANING_METADATA}: no time offset of {', '.join(missing)}")
        at = at_offsets(pairs, motion.trajectory, cleaning.time_offsets_s, asked)
        return CleanedLog(rig, metadata, cleaning, at, motion, corners, doubted, of_shapes, tuple(asked))

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Stated intrinsics by sensor."""
        return self.metadata.cameras

    @property
    def is_detected(self) -> bool:
        """Whether the targets were found in the sensors' images, by our detector."""
        return all(sensor.images is not None for sensor in self.rig.sensors.values())

    def problem_of(self, pairs: Pairs) -> Problem:
        """The used measurements, with stamps on the carriers' clock."""
        problem = problem_of(pairs, self.rig, self.cleaning.time_offsets_s)
        problem.sensor_carrier, problem.target_carrier = self.rig.carriers.sensors, self.rig.carriers.targets
        return problem

    def options(self) -> CalibrateOptions:
        """The options of ``calibrate`` that the rig file states."""
        rig, noise = self.rig, self.motion.noise
        bias_px = {target.name: target.bias_px for target in rig.target_list} if self.is_detected else {}
        return CalibrateOptions(
            noise="estimate" if rig.noise == "estimate" else "given",
            robust="gnc" if rig.cleaning.robust == "gnc" else "none",
            sizes=SIZES[rig.sizes],
            carrier_noise=noise,
            systematic=rig.carriers.arm,
            time_offsets=self.estimated or False,
            carrier_path=self.motion.trajectory if self.estimated else None,
            corners=CornerOptions(
                stated={name: rig.stated_of(name) for name in self.cameras if name in rig.sensors},
                shared=rig.shared,
                carrier_noise="estimate" if noise is None or noise.covariances is not None else noise,
                about=self.motion.about,
                bias_px=bias_px,
            ),
        )

    def recording(self, pairs: Pairs, problem: Problem) -> Recording:
        """What the log has besides its measurements, of which ``problem`` has the used ones."""
        rig, offsets_s = self.rig, self.cleaning.time_offsets_s
        used = {pair.sensor for pair, measured in pairs.items() if measured.used.any()}
        stated = {name: offsets_s.get(name, 0.0) for name in rig.sensors if name in used and name not in self.estimated}
        is_marked = any(why in OF_THE_MOTION for measured in pairs.values() for why in measured.reasons)
        return Recording(
            uncleaned=self.problem_of(without_marks(pairs, OF_THE_MOTION)) if is_marked else problem,
            is_detected=self.is_detected,
            is_inverse=rig.carriers.poses.parent_and_child[0] == rig.carriers.targets,
            late=tuple(late_clocks(pairs, self.motion.trajectory, rig, stated)),
            far_off=tuple(name for name, one in self.doubted.items() if one.is_far_off),
        )


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
    return _solved(CleanedLog.read(log, rig), progress)


def _solved(log: CleanedLog, progress: Progress | None) -> Calibrated:
    rig, offsets_s = log.rig, log.cleaning.time_offsets_s
    pairs, against = with_comparable_noise(log.pairs, rig, log.motion, offsets_s, progress or silent)
    problem = of_poses = log.problem_of(pairs)
    for one in log.metadata.detection.objects:
        pair = Pair(one.target, one.sensor)
        if pair in pairs:
            off = shifted_and_turned(1e-3 * one.alike_mm, np.radians(one.alike_deg), pairs[pair].B)
            problem.alike[pair] = np.column_stack([off, *one.by_groups])
            if one.stretch_sigma_percent is not None:
                share, sigma = one.stretch_percent / 100.0, one.stretch_sigma_percent / 100.0
                problem.stretched[pair] = Stretch(one.sensor, share, sigma)
    try:
        problem = log.corners.in_problem(problem, pairs, log.cameras)
    except CameraError as error:  # a driver's corners outside of its images: the poses have an answer, in doubt
        against.append(Finding(Ground.CORNERS_DOUBTED, str(error)))
    found = calibrate(problem, log.options(), recording=log.recording(pairs, of_poses), progress=progress)
    refined = found.refined or _for_pictures(found, log.options(), progress)
    whole = {name: offsets_s.get(name, 0.0) + more for name, more in refined.time_offsets_s.items()}
    pairs = _with_outliers_marked(at_offsets(pairs, log.motion.trajectory, offsets_s | whole, whole), found.outliers)
    outliers = tuple(_outlier_count(measured) for measured in pairs.values())
    left_out = _outliers(outliers, looked_for=found.outliers.looked_for)
    refined = replace(
        refined, time_offsets_s=whole, inliers={}, inlier_counts=left_out.counts if left_out.looked_for else {}
    )
    fields = _fields(log, found, refined, outliers, offsets_s | whole)
    findings = [*against, *log.of_shapes, *_findings(log, found, refined, fields, pairs)]
    calibration = replace(
        found,
        findings=tuple(findings),
        misreadings=in_rig_file(found.misreadings, rig),
        refined=refined,
        X=refined.X,
        Y=refined.Y,
        scale=refined.scale,
        time_offsets_s=whole,
        judgement=judge(refined.solution, refined, fields, findings),
        outliers=left_out,
    )
    inliers = found.outliers.inliers
    # B is by the stated intrinsics, as it was read, so that solving this log again starts from the same values.
    measured = {
        pair: replace(one, B=log.pairs[pair].B, covariance=log.pairs[pair].covariance) for pair, one in pairs.items()
    }
    counted = selected(found.problem, inliers) if inliers else found.problem
    return Calibrated(
        refined, refined.solution, measured, fields, dict(log.cameras), rig, calibration.judgement, calibration, counted
    )


def with_comparable_noise(
    pairs: Pairs, rig: Rig, motion: CarrierMotion, offsets_s: Mapping[str, float], tell: Progress
) -> tuple[Pairs, list[Finding]]:
    """The pairs, with covariances of the targets' poses that fit their residuals with the targets alone; findings.

    One variance factor is estimated for targets and motions together, so the ratios of their covariances must be right.

    The pairs are unchanged if the rig file states the noise, if there is no odometry or no target, or if a calibration
    with the targets alone fails: that is a finding, since all measurements together may have an answer, under weights
    that are guessed.
    """
    targets = {pair: one for pair, one in pairs.items() if not pair.is_motion and one.used.any()}
    if rig.noise != "estimate" or not targets or not any(pair.is_motion for pair in pairs):
        return pairs, []
    tell("finding the noise of the targets' poses")
    problem = problem_of(targets, rig, offsets_s)
    options = RefineOptions(
        noise="estimate", robust=rig.cleaning.robust, carrier_noise=motion.noise, carrier_model="propagated"
    )
    try:
        with warnings.catch_warnings(action="ignore", category=RwhecWarning):
            noise = refine(problem, solve(problem), options, progress=tell).noise
    except RwhecError as error:
        words = (
            "the noise of the targets' poses beside that of the motions is guessed, since the targets alone have no "
        )
        return pairs, [Finding(Ground.NOT_CHECKED, f"{words}answer: {error}")]
    return pairs | {pair: _with_noise(one, noise[pair]) for pair, one in targets.items() if pair in noise}, []


def _with_noise(measured: MeasuredPairs, noise: PairNoise) -> MeasuredPairs:
    """Scale the covariances so that their median is `noise`; without any, use `noise` for all measurements."""
    variances = np.array([noise.rotation_rad**2] * 3 + [noise.translation_m**2] * 3)
    if measured.covariance is None:
        covariance = np.tile(np.diag(variances), (len(measured.B), 1, 1))
        return replace(measured, covariance=covariance)
    diagonal = np.diagonal(measured.covariance[measured.used], axis1=1, axis2=2)
    stated = np.repeat(np.median(diagonal.reshape(-1, 2, 3).mean(axis=2), axis=0), 3)
    by = np.sqrt(variances / stated)
    return replace(measured, covariance=by[:, None] * measured.covariance * by)


def _for_pictures(found: Calibration, options: CalibrateOptions, progress: Progress | None) -> Refined:
    """A refinement of misread measurements, or of those with unknown noise. It is used only for figures."""
    how = RefineOptions(
        noise="given" if options.noise == "given" else "estimate",
        carrier_noise=options.carrier_noise,
        carrier_model="propagated",
    )
    problem, inliers = found.problem, found.outliers.inliers
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        kept = selected(problem, inliers) if inliers else problem
        return refine(kept, found.solution or solve(kept), how, progress=progress)


def _findings(
    log: CleanedLog, found: Calibration, refined: Refined, fields: LogFields, pairs: Pairs
) -> Iterator[Finding]:
    """The findings against the poses, worded for a log."""
    rig, is_misread, late = log.rig, bool(found.misreadings), Ground.LATE_CLOCK
    is_late = any(finding.ground is late for finding in found.findings) and found.refined is None
    for sensor, one in log.doubted.items():
        if sensor not in refined.intrinsics or rig.sensors[sensor].shared is not None:  # one for all cannot be mended
            yield finding_against(sensor, one, rig)
        elif one.is_far_off and refined.intrinsics[sensor].stated_as == "unknown":
            yield finding_against(sensor, one, rig, refined.intrinsics[sensor].camera)
    if is_misread and (said := Reading(in_rig_file(found.misreadings, rig)).finding) is not None:
        yield said
    dropped = SAID_BY_THE_LOG | ({Ground.MISREAD} if is_misread else set())
    dropped |= {Ground.SIZE_UNTOLD} if rig.sizes == "known" else set()
    yield from (finding for finding in found.findings if finding.ground not in dropped)
    yield from estimated_sizes(fields.sizes, rig, with_intrinsics=bool(refined.intrinsics))
    yield from (Finding(Ground.IMAGES_BLURRED, words) for words in log.metadata.detection.blurred)
    if not (is_misread or is_late):
        yield from turned_images(pairs, refined, rig, log.metadata.image_names)
    if not is_misread:  # a misreading makes cleaning remove measurements that are right
        yield from short_of_measurements(fields, poses_used(pairs.values()))
    if found.judgement.verdict is not Verdict.DO_NOT_USE:
        if are_too_few_to_tell(found.problem) and exchange_of(found.problem).is_open:
            yield may_be_exchanged(rig, sum(count.used for count in fields.outliers))
        yield from (unknown := known_to_nothing(found.points.values(), rig))
        if unknown:
            yield from known_all_the_same(refined, found.views, Ground.KNOWN_TO_NOTHING)


def _fields(
    log: CleanedLog,
    found: Calibration,
    refined: Refined,
    outliers: tuple[OutlierCount, ...],
    offsets_s: Mapping[str, float],
) -> LogFields:
    rig, cleaning, estimated = log.rig, log.cleaning, refined.time_offsets_s
    offsets = [
        TimeOffsetFields(
            sensor=name,
            offset_s=offsets_s[name],
            sigma_s=sigma_of(refined, Unknown(UnknownKind.TIME_OFFSET, name)) if name in estimated else None,
        )
        for name in rig.sensors
        if name in offsets_s
    ]
    offsets += [
        TimeOffsetFields(sensor=name, offset_s=cleaning.time_offsets_s[name], sigma_s=cleaning.coarse_sigma_s.get(name))
        for name in rig.odometries
        if name in cleaning.time_offsets_s
    ]
    return LogFields(
        sensor_carrier=rig.carriers.sensors,
        target_carrier=rig.carriers.targets,
        detection=log.metadata.detection,
        cleaning=cleaning,
        outliers=outliers,
        sizes=_sizes(rig, found, refined),
        time_offsets=tuple(offsets),
    )


def _sizes(rig: Rig, found: Calibration, refined: Refined) -> tuple[SizeFields, ...]:
    """The targets' sizes by the motion: estimated ones as in the answer, and the others."""
    told = {size.target: (size.scale, size.sigma, False) for size in found.sizes}
    for name in rig.targets:
        unknown = Unknown(UnknownKind.SCALE, name)
        if not isinstance(refined.scale, float) and unknown in refined.joint.slots:
            told[name] = (refined.scale[name], sigma_of(refined, unknown), True)
    return tuple(
        SizeFields(target=one.name, stated_m=one.length_m, scale=scale, sigma=sigma, is_free=is_free)
        for one in rig.target_list
        if one.name in told
        for scale, sigma, is_free in [told[one.name]]
    )


def _with_outliers_marked(pairs: Pairs, outliers: Outliers) -> Pairs:
    """The pairs with their outliers marked. `outliers` has a boolean for each used measurement of a pair."""
    result = {}
    for pair, measured in pairs.items():
        reasons = list(measured.reasons)
        if pair in outliers.inliers:
            for i in np.flatnonzero(measured.used)[~outliers.inliers[pair]].tolist():
                reasons[i] = RemovalReason.OUTLIER
        result[pair] = replace(measured, reasons=tuple(reasons))
    return result


def _outliers(counts: tuple[OutlierCount, ...], *, looked_for: bool) -> Outliers:
    """The outliers of the whole log."""
    used = {name for count in counts if count.used for name in count.pair}
    return Outliers(
        inliers={},
        counts={count.pair: (count.used, count.used + count.left_out) for count in counts},
        left_out=tuple(dict.fromkeys(name for count in counts for name in count.pair if name not in used)),
        looked_for=looked_for,
    )


def _outlier_count(measured: MeasuredPairs) -> OutlierCount:
    """How many measurements robust estimation used and left out."""
    count = measured.count
    left_out = count.removed.get(RemovalReason.OUTLIER, 0)
    return OutlierCount(target=count.target, sensor=count.sensor, used=count.used, left_out=left_out)
