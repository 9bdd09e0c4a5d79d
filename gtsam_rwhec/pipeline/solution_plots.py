"""Pictures of a solved log: frames, residuals over time, corners in images, standard deviations."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log, open_log
from gtsam_rwhec.pipeline.carrier_motion import read_carrier_motion
from gtsam_rwhec.pipeline.log_contract import detections_topic, records_of
from gtsam_rwhec.pipeline.measured_pairs import MeasuredPairs
from gtsam_rwhec.pipeline.solution_frames import frames_of
from gtsam_rwhec.pipeline.solving_stage import Solved
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.report.plots import (
    PlottedCorners,
    PlottedMeasurement,
    plot_coverage,
    plot_deviations,
    plot_frames,
    plot_residuals,
)

#: The pictures' files have these names.
FRAMES, RESIDUALS, COVERAGE, DEVIATIONS = "frames.png", "residuals.png", "coverage.png", "deviations.png"


def plot_all(solved: Solved, solved_path: str | Path, folder: Path) -> list[Path]:
    """Draw every picture into an existing folder; return their paths. The log at `solved_path` has the corners."""
    frames = frames_of(solved)
    names = {name: solved.rig.frame_of(name) for name in solved.refined.Y} | {name: name for name in solved.refined.X}
    covariances = {frame: solved.refined.covariance(name) for name, frame in names.items()}
    plot_frames(frames, covariances, folder / FRAMES)
    plot_deviations(frames, covariances, folder / DEVIATIONS)
    plot_residuals(plotted_residuals(solved), folder / RESIDUALS)
    written = [folder / FRAMES, folder / DEVIATIONS, folder / RESIDUALS]
    with open_log(solved_path) as log:
        corners = plotted_corners(solved, log)
    if corners:
        plot_coverage(corners, {name: solved.cameras[name] for name in corners}, folder / COVERAGE)
        written.append(folder / COVERAGE)
    return written


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


def plotted_corners(solved: Solved, log: Log) -> dict[str, PlottedCorners]:
    """The corners of used detections, and their reprojection errors under the calibration, by camera."""
    path = read_carrier_motion(log, solved.rig).trajectory
    targets = {target.name: target for target in solved.rig.target_list}
    offsets = {offset.sensor: offset.offset_s for offset in solved.log.time_offsets}
    seen: dict[str, list[Array]] = defaultdict(list)
    errors: dict[str, list[Array]] = defaultdict(list)
    used = {
        (pair, int(stamp))
        for pair, measured in solved.pairs.items()
        for stamp in measured.stamps_ns[measured.used].tolist()
    }
    for sensor, camera in solved.cameras.items():
        if sensor not in solved.refined.Y:
            continue
        for record in records_of(log, [detections_topic(sensor)], DetectionRecord):
            pair = Pair(record.id, sensor)
            if record.corners_px is None or record.corner_indices is None or (pair, record.stamp_ns) not in used:
                continue
            A, _ = path.at(np.array([record.stamp_ns + round(1e9 * offsets.get(sensor, 0.0))]))
            T = predicted_B(solved, pair, A)[0]
            points = targets[record.id].corners()[list(record.corner_indices)] / scale_of(solved, record.id)
            seen[sensor].append(record.corners_px)
            errors[sensor].append(record.corners_px - camera.project(points @ T[:3, :3].T + T[:3, 3]))
    return {sensor: PlottedCorners(np.concatenate(seen[sensor]), np.concatenate(errors[sensor])) for sensor in seen}
