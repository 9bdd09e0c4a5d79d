"""Pictures of a solved log: frames, residuals over time, corners in images, cameras, standard deviations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import TargetError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import Log, open_log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report.plots import (
    PlottedMeasurement,
    plot_coverage,
    plot_deviations,
    plot_frames,
    plot_intrinsics,
    plot_residuals,
)
from gtsam_rwhec.runs.corner_answer import with_intrinsics
from gtsam_rwhec.runs.log_corners import LogCorners
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs
from gtsam_rwhec.runs.plotted_corners import plotted_corners, plotted_intrinsics, seen_views
from gtsam_rwhec.runs.solution_frames import frames_of
from gtsam_rwhec.runs.solving_stage import Solved

#: The pictures' files have these names.
FRAMES, RESIDUALS, COVERAGE, DEVIATIONS = "frames.png", "residuals.png", "coverage.png", "deviations.png"
#: Of intrinsics that were estimated.
INTRINSICS = "intrinsics.png"


def plot_all(solved: Solved, solved_path: str | Path, folder: Path) -> list[Path]:
    """Draw every picture into an existing folder; return their paths. The log at `solved_path` has the corners."""
    frames = frames_of(solved)
    names = {name: solved.rig.frame_of(name) for name in solved.refined.Y} | {name: name for name in solved.refined.X}
    covariances = {frame: solved.refined.covariance(name) for name, frame in names.items()}
    plot_frames(frames, covariances, folder / FRAMES)
    plot_deviations(frames, covariances, folder / DEVIATIONS)
    with open_log(solved_path) as log:
        seen = seen_views(solved, log)
        plot_residuals(plotted_residuals(by_estimated_intrinsics(solved, log)), folder / RESIDUALS)
    written = [folder / FRAMES, folder / DEVIATIONS, folder / RESIDUALS]
    if seen:
        corners = plotted_corners(solved, seen)
        plot_coverage(corners, {name: solved.cameras[name] for name in corners}, folder / COVERAGE)
        written.append(folder / COVERAGE)
    cameras = plotted_intrinsics(solved, seen)
    if cameras:
        plot_intrinsics(cameras, folder / INTRINSICS)
        written.append(folder / INTRINSICS)
    return written


def by_estimated_intrinsics(solved: Solved, log: Log) -> Solved:
    """The same with poses of targets by the estimated intrinsics, if there are any; the log has those by the stated."""
    refined = solved.refined
    if refined.reprojection is None:
        return solved
    cameras = {**solved.cameras, **{name: one.camera for name, one in refined.intrinsics.items()}}
    corners = LogCorners.of(log, solved.rig, cameras)
    try:
        pairs = with_intrinsics(solved.pairs, corners, cameras, refined.X, refined.Y, refined.reprojection.corner_px)
    except TargetError:  # a bundle that is not flat has no pose by the corners of one image
        return solved
    return replace(solved, pairs=pairs)


def plotted_residuals(solved: Solved) -> dict[Pair, PlottedMeasurement]:
    """The residuals of each pair: measurements against their predictions."""
    first = min(int(measured.stamps_ns.min()) for measured in solved.pairs.values() if len(measured.stamps_ns))
    result = {}
    for pair, measured in solved.pairs.items():
        if pair.target not in solved.refined.X or pair.sensor not in solved.refined.Y:
            continue  # no measurement of this pair was used
        degrees, millimetres = residuals_of(solved, pair, measured)
        result[pair] = PlottedMeasurement(
            stamps_s=(measured.stamps_ns - first) * 1e-9,
            rotation_deg=degrees,
            translation_mm=millimetres,
            inlier=measured.used,
            reason=measured.reasons,
        )
    return result


def residuals_of(solved: Solved, pair: Pair, measured: MeasuredPairs) -> tuple[Array, Array]:
    """Degrees (N,) and millimetres (N,) between B and its prediction Y^-1 A X."""
    predicted = predicted_B(solved, pair, measured.A)
    predicted[:, :3, 3] *= scale_of(solved, pair.target)
    off = se3.inverse(predicted) @ measured.B
    degrees: Array = np.degrees(np.linalg.norm(se3.so3_logmap(off[:, :3, :3]), axis=1))
    return degrees, 1e3 * np.linalg.norm(off[:, :3, 3], axis=1)


def predicted_B(solved: Solved, pair: Pair, A: Array) -> Array:
    """The prediction Y^-1 A X of B, (N, 4, 4), in true metres."""
    X, Y = solved.refined.X[pair.target].matrix(), solved.refined.Y[pair.sensor].matrix()
    predicted: Array = np.linalg.inv(Y) @ A @ X
    return predicted


def scale_of(solved: Solved, target: str) -> float:
    """Stated / true length of a target."""
    scale = solved.refined.scale
    return scale if isinstance(scale, float) else scale[target]
