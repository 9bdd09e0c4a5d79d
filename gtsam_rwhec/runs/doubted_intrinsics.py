"""Find stated intrinsics that the corners of boards contradict, before a size, an arm or a clock is blamed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_evidence import LEAST_CORNERS, IntrinsicsEvidence, View, evidence_of_intrinsics
from gtsam_rwhec.logs import Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.run_log import seen_corners

#: If the ratios of fitted to stated numbers are all 0.5 or all 2 within this share, the stated ones are of another
#: resolution.
RESOLUTION_SHARE = 0.1


def doubted_intrinsics(log: Log, rig: Rig, cameras: Mapping[str, Camera]) -> dict[str, IntrinsicsEvidence]:
    """Evidence of a log's corners against stated intrinsics, by sensor, for those that the corners contradict.

    Sensors that state no intrinsics, and those whose targets have few corners (single tags), are not judged.
    """
    corners = {target.name: target.corners() for target in rig.target_list}
    boards = {name: points for name, points in corners.items() if len(points) >= LEAST_CORNERS}
    doubted = {}
    for sensor, camera in cameras.items():
        if not boards or sensor not in rig.sensors or rig.sensors[sensor].stated == "unknown":
            continue
        views = [
            View(boards[seen.target][seen.indices], seen.corners_px, seen.T)
            for seen in seen_corners(log, sensor, boards)
        ]
        found = evidence_of_intrinsics(camera, views)
        if found is not None and found.contradicts:
            doubted[sensor] = found
    return doubted


def finding_against(sensor: str, found: IntrinsicsEvidence, rig: Rig, estimated: Camera | None = None) -> Finding:
    """The finding that corners contradict the stated intrinsics. `estimated` are those used in their place, if any."""

    def numbers(camera: Camera) -> str:
        K = np.rint(camera.K).astype(int)
        words = f"fx, fy = {K[0, 0]}, {K[1, 1]} and cx, cy = {K[0, 2]}, {K[1, 2]}"
        if len(found.sigma) == 4 or not camera.D.any():
            return words
        k1, k2 = np.round(np.pad(camera.D, (0, 2))[:2], 3) + 0.0
        return f"{words}, k1, k2 = {k1:g}, {k2:g}"

    words = (
        f"the intrinsics of {sensor} ({rig.source.place(('sensors', sensor, 'intrinsics'))}) do not fit its corners: "
        f"{numbers(found.stated)}, as stated, leave {found.stated_px:.2f} px rms in {found.views} images, and "
    )
    if estimated is not None:
        words += f"{numbers(estimated)}, which the images alone tell, are used"
        return Finding(Ground.INTRINSICS_ESTIMATED, words + _of_another_resolution(found.stated, estimated))
    give_or_take = f"standard deviations {found.sigma[:2].max():.2g} and {found.sigma[2:4].max():.2g} px"
    words += f"{numbers(found.fitted)} would leave {found.fitted_px:.2f} px ({give_or_take})"
    words += _of_another_resolution(found.stated, found.fitted)
    return Finding(Ground.INTRINSICS_DOUBTED if found.is_far_off else Ground.INTRINSICS_UNCERTAIN, words)


def _of_another_resolution(stated: Camera, right: Camera) -> str:
    """A clause of the message if the stated intrinsics are of images of half or double the resolution; else empty."""
    at = ([0, 1, 0, 1], [0, 1, 2, 2])
    ratio = right.K[at] / stated.K[at]
    for times, words in ((2.0, "half"), (0.5, "double")):
        if np.abs(ratio / times - 1.0).max() < RESOLUTION_SHARE:
            return f"; the stated ones look like those of images of {words} the resolution"
    return ""
