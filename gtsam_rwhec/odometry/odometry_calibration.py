"""Calibrate sensors that know only their own motion, all at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3
from scipy.special import chdtrc

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.lidar_pair import LidarsTogether
from gtsam_rwhec.errors import CountError, FrameError, OptionError, OutlierError, ScaleError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress, check_progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.odometry_track import OdometryTrack
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.clouds_of_lidars import near_poses, pose_of, poses_of, registered_maps
from gtsam_rwhec.odometry.odometry_outcome import calibration_of, contradiction
from gtsam_rwhec.odometry.odometry_record import OdometryCalibration
from gtsam_rwhec.odometry.prior_knowledge import Given, GivenRows, up_direction
from gtsam_rwhec.odometry.track_comparison import (
    Clock,
    OdometryOptions,
    check_common_time,
    check_not_the_same,
    check_turns,
    first_offset,
)
from gtsam_rwhec.odometry.window_likelihood import Layout
from gtsam_rwhec.odometry.window_motions import (
    SampledTrack,
    WindowMotions,
    best_length,
    edges_near,
    first_rotation_variances,
)
from gtsam_rwhec.odometry.window_solution import FEWEST, Answer, Task, solve_windows, too_few
from gtsam_rwhec.results.log_history import RemovalReason, Removed
from gtsam_rwhec.runs.odometry_cleaning import Gated, gated

#: If the drive does not determine a time offset, it stays within about this many seconds of the first guess.
CLOCK_SIGMA_S = 0.05
#: The windows are made again with new offsets until these change by less than this, s, and so often at most. What is
#: left is in the residuals to first order.
SAME_CLOCK_S = 2e-3
CLOCK_ROUNDS = 4
#: A start for the translation's noise: this part of the median way of a second, in metres a root of a second.
WAY_SHARE = 0.01
#: The mean square turn about an axis is less than this, in units of its noise: it did not turn. The noise is that of
#: angles, which pure noise makes 2.2 times too small.
LEAST_TURNS = 6.0
#: The mean square turn of a sensor's windows is at least so many times the variance that its disagreement asks for.
LEAST_AGREEMENT = 3.0
#: Windows for the question whether it turned are about this long, s: short windows hide slow turns in noise.
LONG_S = 2.0


@one_blas_thread()
def calibrate_odometries(
    tracks: Sequence[OdometryTrack],
    *,
    reference: str,
    given: Given | None = None,
    options: OdometryOptions | None = None,
    maps: Mapping[str, Sequence[Cloud]] | None = None,
    progress: Progress | None = None,
) -> OdometryCalibration:
    """Find where sensors are on a vehicle, each of which knows only its own motion.

    All sensors are solved at once (design fact 24): the joint cost is certified, then the exact likelihood of all
    windows is refined, with the vehicle's motion as unknowns. The result names what the drive leaves free.

    Parameters
    ----------
    tracks : sequence of OdometryTrack
        Two or more, of different sensors; at least one of known scale.
    reference : str
        The sensor in whose frame the poses are.
    given : Given, optional
        What is known beside the tracks.
    options : OdometryOptions, optional
    maps : mapping of sensor to clouds, optional
        What LiDARs saw along their ways, ``CloudTrack.maps``: where those of two overlap they are registered with each
        other, which tells heights on a plane too. `OdometryCalibration.together` says what came of it.
    progress : callable, optional
        Takes the name of each stage.

    Raises
    ------
    CountError, FrameError, StampError
        Fewer than two tracks, a sensor twice or not there, no common time.
    ScaleError
        No sensor has a known scale.
    UnderdeterminedError
        The vehicle did not turn, or the tracks share too few windows of time.
    OutlierError
        A sensor contradicts the others most of the time.
    NoiseError, OptionError
        What is given is no number, or not of these sensors.
    """
    given, options = given or Given(), options or OdometryOptions()
    check_progress(progress)
    tell = progress or silent
    tracks = _ordered(tracks, reference, given)
    names = [track.sensor for track in tracks]
    given.checked(names, reference)
    if lost := [sensor for sensor in maps or () if sensor not in names]:
        raise FrameError(f"maps are of {lost[0]!r}, and no track is of it; the sensors are {', '.join(names)}")
    tell("comparing clocks")
    check_common_time(tracks, options.search_s if options.estimate_time_offsets else 0.0)
    gates = [gated(track, options.gates) for track in tracks]
    check_not_the_same(tracks)
    check_turns([gate.track for gate in gates])
    clocks = [Clock(0.0)] + [
        first_offset(gates[0].track, gate.track, options) if options.estimate_time_offsets else Clock(0.0)
        for gate in gates[1:]
    ]
    drive = _Drive(tuple(tracks), tuple(gates), tuple(clocks), reference, given, options, tell)
    tell("choosing windows")
    together, findings = _beside_the_motions(drive, maps or {})
    drive = replace(drive, given=replace(given, poses=(*given.poses, *poses_of(together))))
    first = drive.calibrated(options.window_s)
    found = _narrowed(first) if options.window_s else _agreeing(drive, first)
    remarks = (*found.remarks, *map(str, together))
    return replace(found, together=together, findings=(*found.findings, *findings), remarks=remarks)


def _beside_the_motions(
    drive: _Drive, maps: Mapping[str, Sequence[Cloud]]
) -> tuple[tuple[LidarsTogether, ...], list[Finding]]:
    """What the maps of every two LiDARs tell, and which known poses the motions alone contradict."""
    if sum(map(bool, maps.values())) < 2 and not drive.given.poses:
        return (), []
    answer, task, offsets, _ = replace(drive, given=replace(drive.given, poses=())).solved(drive.options.window_s)
    T = near_poses(answer, task)
    found = registered_maps(answer, task, T, [gate.track for gate in drive.gates], offsets, maps, drive.tell)
    off = {str(pose): contradiction(answer, task, T, pose) for pose in drive.given.poses}
    together = []
    for each in found:
        words = "" if each.why_not else contradiction(answer, task, T, pose_of(each))
        off[f"by their clouds, {pose_of(each)}"] = words
        together.append(replace(each, why_not=words) if words else each)
    findings = [f"{what} contradicts the motions: {words}" for what, words in off.items() if words]
    return tuple(together), [Finding(Ground.CONTRADICTED, words) for words in findings]


@dataclass(frozen=True)
class _Drive:
    """What calibrations with windows of different lengths share."""

    tracks: tuple[OdometryTrack, ...]
    gates: tuple[Gated, ...]
    clocks: tuple[Clock, ...]
    reference: str
    given: Given
    options: OdometryOptions
    tell: Progress

    def calibrated(self, seconds: float | None) -> OdometryCalibration:
        """The calibration with windows of about this length; None: of that with the most information."""
        answer, task, offsets, begins_ns = self.solved(seconds)
        removed = {
            name: gate.removed + _outlying(begins_ns, left_out)
            for name, gate, left_out in zip(task.names, self.gates, answer.left_out, strict=True)
        }
        self.tell("gathering")
        origin = int(self.tracks[0].stamps_ns[0])
        return calibration_of(answer, task, self.tracks, self.reference, offsets, self.clocks, removed, origin)

    def solved(self, seconds: float | None) -> tuple[Answer, Task, Array, np.ndarray]:
        """The answer and its task, the time offsets (m,), s, and when all windows begin, those of outliers too, ns."""
        tracks, gates, clocks, given, options = self.tracks, self.gates, self.clocks, self.given, self.options
        names = tuple(track.sensor for track in tracks)
        origin = int(tracks[0].stamps_ns[0])
        offsets = np.array([clock.offset_s for clock in clocks])
        scaled = np.array([track.has_unknown_scale for track in tracks])
        answer: Answer | None = None
        variances: Array = np.zeros((0, 2))
        for _ in range(CLOCK_ROUNDS):
            samples = [
                SampledTrack(gate.track, origin, float(offset), gate.good)
                for offset, gate in zip(offsets, gates, strict=True)
            ]
            seconds = seconds or best_length(samples, options.max_gap_s)
            edges = edges_near(samples, seconds)
            windows = WindowMotions.of(samples, edges, options.max_gap_s, clocks=options.estimate_time_offsets)
            _check_windows(windows, names)
            if answer is None:
                variances = _first_variances(windows, tracks)
                _check_turning(samples, options, variances)
            normal, sigma = up_direction(given, windows, variances, self.reference)
            rows = GivenRows(given, {name: k for k, name in enumerate(names)}, normal, sigma, CLOCK_SIGMA_S)
            layout = Layout.of(scaled, clocks=options.estimate_time_offsets, has_ground=rows.has_ground)
            stated = np.array([track.noise is not None for track in tracks])
            task = Task(names, scaled, stated, layout, rows, options.reject_outliers)
            answer = solve_windows(windows, variances, task, answer.fit.state if answer else None, self.tell)
            variances = answer.variances
            change = answer.fit.state.offset
            offsets = offsets + change
            if float(np.abs(change).max()) < SAME_CLOCK_S:
                break
        assert answer is not None
        _check_agreement(answer, names)
        return answer, task, offsets, origin + np.round(windows.start * 1e9).astype(np.int64)


#: The answer is compared with those of windows of these lengths, s: an error that is no random walk (white noise of a
#: pose, a clock, a map that bends) weighs otherwise in short and in long windows.
OTHER_WINDOWS_S = (0.5, 2.0)
#: Windows count as longer from this factor on.
LONGER = 1.5
#: Answers disagree where chance makes such a difference in fewer drives than this.
BY_CHANCE = 1e-3


def _agreeing(drive: _Drive, first: OdometryCalibration) -> OdometryCalibration:
    """The answer of the shortest windows with which those of all longer ones agree; doubted where some disagree."""
    answers, why = [first], ""
    for seconds in OTHER_WINDOWS_S:
        if seconds > LONGER * answers[-1].windows.seconds:
            drive.tell(f"comparing with windows of {seconds:g} s")
            try:
                answers.append(drive.calibrated(seconds))
            except (CountError, OutlierError, UnderdeterminedError) as error:  # too few windows of that length
                why = str(error)
    if why and len(answers) == 1:
        words = f"answers from windows of other lengths could not be compared: {why}"
        return replace(first, findings=(*first.findings, Finding(Ground.NOT_CHECKED, words)))
    words = ""
    for k, answer in enumerate(answers):
        off = next(filter(None, (_disagreement(answer, other) for other in answers[k + 1 :])), "")
        if not off:
            break
        words = words or off
    if not words:
        return _narrowed(first)
    words += f". Its errors are no random walk; the poses are from windows of {answer.windows.seconds:.2g} s"
    return replace(answer, findings=(*answer.findings, Finding(Ground.COVARIANCE_DOUBTED, words)))


def _narrowed(found: OdometryCalibration) -> OdometryCalibration:
    """Blocks of windows that scatter less than expected make the covariance smaller, after all comparisons."""
    return replace(found, covariance=found.narrowed)


def _disagreement(one: OdometryCalibration, other: OdometryCalibration) -> str:
    """The sensor that is elsewhere with windows of another length, in words; empty where none is beyond chance."""
    for name in one.order:
        both = one.covariance_of(name) + other.covariance_of(name)
        if not np.isfinite(both).all():
            continue
        error = se3.logmap((np.linalg.inv(one.T_reference_sensor[name]) @ other.T_reference_sensor[name])[None])[0]
        if chdtrc(6, float(error @ np.linalg.solve(both, error))) < BY_CHANCE:
            apart = f"{np.degrees(np.linalg.norm(error[:3])):.2g} degrees and {1e3 * np.linalg.norm(error[3:]):.3g} mm"
            return (
                f"{name} is {apart} elsewhere with windows of {other.windows.seconds:.2g} s than with those of "
                f"{one.windows.seconds:.2g} s, which is more than both claim"
            )
    return ""


def _ordered(tracks: Sequence[OdometryTrack], reference: str, given: Given) -> list[OdometryTrack]:
    """The reference first; or, if its scale is unknown, the first sensor of known scale."""
    tracks = list(tracks)
    names = [track.sensor for track in tracks]
    if len(tracks) < 2:
        raise CountError(
            f"{len(tracks)} track is given; sensors are calibrated against one another, so give two tracks or more"
        )
    for track in tracks:
        if names.count(track.sensor) > 1:
            raise FrameError(f"two tracks are of {track.sensor!r}; give each sensor its own name and one track")
        if len(track.stamps_ns) < 3:
            raise CountError(f"the track of {track.sensor} has {len(track.stamps_ns)} poses; at least three are needed")
    if reference not in names:
        raise FrameError(f"the reference is {reference!r}, and no track is of it; the sensors are {', '.join(names)}")
    if all(track.has_unknown_scale for track in tracks):
        raise ScaleError(
            "all tracks have an unknown scale: nothing says how long a metre is. Give one of known scale (wheels, "
            "LiDAR, stereo, inertial)"
        )
    first = next(track for track in tracks if track.sensor == reference)
    if first.has_unknown_scale:
        if given.ground is not None or given.directions:
            raise OptionError(
                f"the ground or a direction is given in the frame of {reference}, whose scale is unknown; choose a "
                "reference of known scale, and give them in its frame"
            )
        first = next(track for track in tracks if not track.has_unknown_scale)
    return [first, *(track for track in tracks if track is not first)]


def _check_windows(windows: WindowMotions, names: tuple[str, ...]) -> None:
    if len(windows) < FEWEST:
        raise too_few(len(windows))
    for k, name in enumerate(names):
        if windows.used[k].sum() < FEWEST:
            raise UnderdeterminedError(
                f"{name} has {int(windows.used[k].sum())} windows with another sensor; at least {FEWEST} are needed. "
                "Look for gaps in its track, and for steps that are too fast (max_speed_m_per_s, max_turn_rad_per_s)"
            )


def _first_variances(windows: WindowMotions, tracks: Sequence[OdometryTrack]) -> Array:
    """Starts (m, 2), or what is stated."""
    variances = np.c_[first_rotation_variances(windows), np.zeros(len(tracks))]
    for k, track in enumerate(tracks):
        used = windows.used[k]
        way = np.linalg.norm(windows.M[k, used, :3, 3], axis=1) / windows.length[k, used]
        variances[k, 1] = (WAY_SHARE * max(float(np.median(way)), 1e-3)) ** 2
        if track.noise is not None:
            variances[k] = track.noise.rotation_rad_per_sqrt_s**2, track.noise.translation_m_per_sqrt_s**2
    positive: Array = np.maximum(variances, 1e-16)
    return positive


def _check_turning(samples: list[SampledTrack], options: OdometryOptions, variances: Array) -> None:
    windows = WindowMotions.of(samples, edges_near(samples, LONG_S), options.max_gap_s, clocks=False)
    w = windows.rotation_vectors()
    noise = variances[:, :1] * windows.length
    mean_square = float(((w**2).sum(axis=2) / noise)[windows.used].mean()) / 3.0 if len(windows) else np.inf
    if mean_square < LEAST_TURNS:
        raise UnderdeterminedError(
            f"the vehicle did not turn: over {LONG_S:g} s the tracks turn by {np.sqrt(mean_square):.1f} times their "
            "noise. Without turning nothing tells where a sensor is; drive curves to both sides"
        )


def _check_agreement(answer: Answer, names: tuple[str, ...]) -> None:
    """Refuse a track of another drive: its estimated noise is as large as its turns."""
    windows = answer.windows
    square = (windows.rotation_vectors() ** 2).sum(axis=2) / 3.0
    for k, name in enumerate(names):
        used = windows.used[k]
        noise = float((answer.variances[k, 0] * windows.length[k, used]).mean())
        if float(square[k, used].mean()) < LEAST_AGREEMENT * noise:
            raise OutlierError(
                f"the turns of {name} do not agree with the other sensors': they differ by "
                f"{np.degrees(np.sqrt(noise)):.2g} degrees a window, and are themselves not much larger. Is it a track "
                "of this drive, on the same clock, with poses T_start_sensor that are not inverted?"
            )


def _outlying(begins_ns: np.ndarray, left_out: np.ndarray) -> tuple[Removed, ...]:
    at = np.flatnonzero(left_out).tolist()
    return tuple(Removed(RemovalReason.OUTLIER, i, int(begins_ns[i]), 1.0, 1.0) for i in at)
