"""The answer from the corners of a log, started at the poses of targets in its images.

These poses were computed with the stated intrinsics. With the estimated ones they are computed again, since outliers,
noise and findings are of them; where the corners contradict what was stated, all of that is settled again.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import gtsam
import numpy as np

from gtsam_rwhec.calibration.from_corners import SIZE_SHARE, CornersFound, corners_found
from gtsam_rwhec.calibration.verdict import Choice, Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError, RwhecError
from gtsam_rwhec.fitting.fit_options import CornerOptions
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.runs.log_corners import LogCorners
from gtsam_rwhec.runs.settled_poses import SettledPoses, settled_poses
from gtsam_rwhec.runs.solving_rounds import Pairs, SolvingRounds, SynchronisedPairs


def corner_answer(
    settled: SettledPoses,
    given: SynchronisedPairs,
    rounds: SolvingRounds,
    logged: LogCorners,
    cameras: Mapping[str, Camera],
    unknown: Collection[str] = (),
) -> tuple[SettledPoses, CornersFound]:
    """Refine from corners, where all measurements have them; and the poses under the estimated intrinsics.

    Parameters
    ----------
    settled : SettledPoses
        What the poses of targets say.
    given : SynchronisedPairs
        The same before outliers were marked.
    rounds : SolvingRounds
    logged : LogCorners
    cameras : dict of str to Camera
        Stated intrinsics.
    unknown : collection of str
        Sensors whose intrinsics are only where the refinement starts: nobody stated them.
    """
    found = _from_corners(settled, rounds, logged, cameras, unknown)
    if found.corners is None:
        return settled, found
    rounds.progress("computing the poses of targets again, with the estimated intrinsics")
    try:
        if found.contradicted:
            again = settled_poses(rounds, _with_estimated(given, logged, cameras, found))
            better = _from_corners(again, rounds, logged, cameras, unknown)
            if better.corners is not None:
                settled, found = again, better
        return replace(settled, pairs=_with_estimated(settled.pairs, logged, cameras, found)), found
    except RwhecError:
        return settled, found  # a target that is not flat has no pose in an image alone


def _from_corners(
    settled: SettledPoses,
    rounds: SolvingRounds,
    logged: LogCorners,
    cameras: Mapping[str, Camera],
    unknown: Collection[str],
) -> CornersFound:
    rig, motion = rounds.rig, rounds.motion
    used = {pair: measured for pair, measured in settled.pairs.pairs.items() if measured.used.any()}
    if rig.odometries and any(pair.is_motion for pair in used):
        return CornersFound.none("the poses of targets are solved together with the motions of odometries")
    without = [name for name in dict.fromkeys(pair.sensor for pair in used) if name not in cameras]
    if without:
        return CornersFound.none(f"the log has no intrinsics of {', '.join(without)}")
    lacking = logged.lacking(used)
    if lacking:
        return CornersFound.none(f"the detections of {', '.join(map(str, lacking[:5]))} have no corners")
    start = settled.refined or rounds.refined(settled.pairs, settled.free, "time offsets")
    if start.free_directions:
        return CornersFound.none("the motion leaves poses free")
    try:
        observations = logged.observations(used, cameras, motion, settled.pairs.offsets_s)
    except CameraError as error:  # a driver's corners outside of its images: the poses have an answer, in doubt
        return CornersFound.none(f"the corners give none: {error}", Finding(Ground.CORNERS_DOUBTED, str(error)))
    assert observations is not None
    noise = motion.noise
    options = CornerOptions(
        stated={name: "unknown" if name in unknown else rig.sensors[name].stated for name in observations.sensors},
        size_share=dict.fromkeys((name for name in settled.free if name in observations.corners), SIZE_SHARE),
        carrier_noise="estimate" if noise is None or noise.covariances is not None else noise,
        about=motion.about,
        time_offsets=tuple(name for name in rounds.estimated if name in observations.sensors),
    )
    found = corners_found(start.X, start.Y, observations, options, rounds.progress)
    missing = logged.without_corners(used)
    if found.corners is None or not missing:
        return found
    counts = ", ".join(f"{number} of {pair}" for pair, number in missing.items())
    left_out = Choice("measurements without corners", f"{counts} do not count in the poses", "the others have corners")
    return replace(found, choices=(*found.choices, left_out))


def _with_estimated(
    given: SynchronisedPairs, logged: LogCorners, cameras: Mapping[str, Camera], found: CornersFound
) -> SynchronisedPairs:
    """The pairs with B by the estimated intrinsics."""
    assert found.corners is not None
    estimated = {**cameras, **{name: one.camera for name, one in found.intrinsics.items()}}
    corners = found.corners
    pairs = with_intrinsics(given.pairs, logged, estimated, corners.X, corners.Y, corners.noise.corner_px)
    return replace(given, pairs=pairs)


def with_intrinsics(
    pairs: Pairs,
    logged: LogCorners,
    cameras: Mapping[str, Camera],
    X: Mapping[str, gtsam.Pose3],
    Y: Mapping[str, gtsam.Pose3],
    corner_px: float,
) -> Pairs:
    """The pairs with B of their corners by some intrinsics: of a plane's two poses, the one near Y^-1 A X.

    Raises TargetError for a target that is not flat: it has no pose in an image alone.
    """
    changed = dict(pairs)
    for pair, measured in pairs.items():
        seen, pixels = logged.seen(measured)
        if not len(seen) or pair.target not in X or pair.sensor not in Y:
            continue
        A = measured.A[seen]
        predicted: Array = np.linalg.inv(Y[pair.sensor].matrix()) @ A @ X[pair.target].matrix()
        observations = replace(logged.of_views({pair: (A, pixels, None)}, cameras), corner_px=corner_px)
        poses = observations.poses({pair: predicted}).measurements(*pair)
        B = measured.B.copy()
        B[seen] = poses.B
        covariance = None if measured.covariance is None else measured.covariance.copy()
        if covariance is not None and poses.covariances is not None:
            covariance[seen] = poses.covariances
        changed[pair] = replace(measured, B=B, covariance=covariance)
    return changed
