"""The first answer from a log: the poses of targets, then the corners; by fitted intrinsics where stated ones fail.

Stated intrinsics that are far off (of another resolution, of another lens) can bend the poses of targets so much that
they look misread, or leave directions free: then the corners have no start. The corners of planes alone give intrinsics
(Zhang 2000), and by these the poses are computed again.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.calibration.from_corners import CornersFound
from gtsam_rwhec.calibration.misreadings import Misreading
from gtsam_rwhec.calibration.verdict import Choice, Finding
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_evidence import IntrinsicsEvidence
from gtsam_rwhec.cameras.unknown_intrinsics import CORNERS, Lens, estimated_intrinsics
from gtsam_rwhec.errors import RwhecError, RwhecWarning
from gtsam_rwhec.fitting.observations import solved_with_chosen_poses
from gtsam_rwhec.runs.clocks_by_turning import late_clocks
from gtsam_rwhec.runs.corner_answer import corner_answer, with_intrinsics
from gtsam_rwhec.runs.doubted_intrinsics import finding_against
from gtsam_rwhec.runs.log_corners import LogCorners
from gtsam_rwhec.runs.log_findings import is_of_the_poses
from gtsam_rwhec.runs.settled_poses import SettledPoses, settled_poses
from gtsam_rwhec.runs.solving_rounds import SolvingRounds, SynchronisedPairs
from gtsam_rwhec.solver.solution import solve


@dataclass(frozen=True, eq=False)
class FirstAnswer:
    """What the poses and the corners say before the whole log is calibrated.

    Attributes
    ----------
    poses : SettledPoses
    of_corners : CornersFound
    misreadings : tuple of Misreading
        Likely misreadings of the poses as they were written.
    late : tuple of Finding
        Clocks that are late.
    """

    poses: SettledPoses
    of_corners: CornersFound
    misreadings: tuple[Misreading, ...]
    late: tuple[Finding, ...]

    @property
    def is_misread(self) -> bool:
        """Whether poses were misread in a way that no round helps."""
        return is_of_the_poses(self.misreadings)


def first_answer(
    rounds: SolvingRounds,
    given: SynchronisedPairs,
    logged: LogCorners,
    cameras: Mapping[str, Camera],
    stated_s: Mapping[str, float],
    doubted: Mapping[str, IntrinsicsEvidence],
) -> FirstAnswer:
    """Poses and corners under the stated intrinsics, or under fitted ones where these are far off and lead nowhere.

    Parameters
    ----------
    rounds : SolvingRounds
    given : SynchronisedPairs
        No outlier is marked yet.
    logged : LogCorners
    cameras : dict of str to Camera
        Stated intrinsics.
    stated_s : dict of str to float
        Time offsets of the sensors whose clock is stated, seconds.
    doubted : dict of str to IntrinsicsEvidence
        Sensors whose corners contradict their stated intrinsics.
    """
    answer = _answer(rounds, given, logged, cameras, stated_s, {})
    far = {name: found for name, found in doubted.items() if found.is_far_off}
    if answer.of_corners.corners is not None or not far:
        return answer
    rounds.progress("computing the poses of targets again, with intrinsics that the images tell")
    try:
        fitted = {
            **cameras,
            **{name: _told_by_images(given, logged, found.stated, name) for name, found in far.items()},
        }
        again = _answer(rounds, _by_fitted(given, logged, fitted), logged, fitted, stated_s, far)
    except RwhecError:
        return answer  # no pose by the fitted ones: what the stated ones gave is judged, and they are named
    return answer if again.of_corners.corners is None else again


def _answer(
    rounds: SolvingRounds,
    given: SynchronisedPairs,
    logged: LogCorners,
    cameras: Mapping[str, Camera],
    stated_s: Mapping[str, float],
    far: Mapping[str, IntrinsicsEvidence],
) -> FirstAnswer:
    late = late_clocks(given.pairs, rounds.motion.trajectory, rounds.rig, dict(stated_s))
    before = rounds.misreadings(given)
    # Outliers, sizes and corners mean nothing where poses were misread, or are of another time.
    poses, of_corners = SettledPoses(given), CornersFound.none("the measurements look misread, or are of another time")
    if not (is_of_the_poses(before) or late):
        poses = settled_poses(rounds, given)
        poses, of_corners = corner_answer(poses, given, rounds, logged, cameras, far)
    if far and of_corners.corners is not None:
        said = {f"intrinsics of {name}": found for name, found in far.items()}
        of_corners = replace(
            of_corners,
            choices=tuple(
                Choice(one.what, one.chosen, "the stated ones do not fit the corners, and count as unknown")
                if one.what in said
                else one
                for one in of_corners.choices
            ),
            findings=(
                *(
                    finding_against(name, found, rounds.rig, of_corners.intrinsics[name].camera)
                    for name, found in far.items()
                    if name in of_corners.intrinsics
                ),
                *of_corners.findings,
            ),
        )
    return FirstAnswer(poses, of_corners, before, tuple(late))


def _told_by_images(given: SynchronisedPairs, logged: LogCorners, stated: Camera, sensor: str) -> Camera:
    """The intrinsics that a sensor's images of flat boards tell alone, as ``intrinsics: estimate`` does.

    Raises CameraError where they determine none.
    """
    boards, corners = [], []
    for pair, measured in given.pairs.items():
        board = logged.targets.get(pair.target)
        if pair.sensor != sensor or board is None or board[:, 2].any():
            continue
        for pixels in logged.seen(measured)[1]:
            known = np.isfinite(pixels[:, 0])
            if known.sum() >= CORNERS:
                boards.append(board[known])
                corners.append(pixels[known])
    lens: Lens = "equidistant" if stated.model == "equidistant" else "any"
    return estimated_intrinsics(boards, corners, (stated.width, stated.height), lens).camera


def _by_fitted(given: SynchronisedPairs, logged: LogCorners, cameras: Mapping[str, Camera]) -> SynchronisedPairs:
    """The pairs with B by fitted intrinsics; a certified solution chooses between a plane's two poses."""
    views = {}
    for pair, measured in given.pairs.items():
        seen, pixels = logged.seen(measured)
        if len(seen) and pair.sensor in cameras:
            views[pair.target, pair.sensor] = measured.A[seen], pixels, None
    observations = logged.of_views(views, cameras)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RwhecWarning)  # of weights: no outlier is left out yet
        found = solved_with_chosen_poses(observations, solve, lambda solution: (solution.X, solution.Y))
    with_corners = {pair: one for pair, one in given.pairs.items() if pair.sensor in cameras}
    pairs = with_intrinsics(with_corners, logged, cameras, found.X, found.Y, observations.corner_px)
    return replace(given, pairs={**given.pairs, **pairs})
