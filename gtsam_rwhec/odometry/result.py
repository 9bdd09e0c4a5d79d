"""The record of a calibration from its answer: the frame that was asked for, covariance, dependence, findings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.calibrated import OdometryCalibration
from gtsam_rwhec.odometry.clocks import Clock
from gtsam_rwhec.odometry.findings import contradictions_of, findings_of, remarks_of, residual_sizes
from gtsam_rwhec.odometry.found import Influence, Windows
from gtsam_rwhec.odometry.freedom import REACHES, seven_each
from gtsam_rwhec.odometry.other_answers import other_answers
from gtsam_rwhec.odometry.plausible import inverted_in_words
from gtsam_rwhec.odometry.solved_windows import Answer, Task
from gtsam_rwhec.odometry.tracks import OdometryNoise, OdometryTrack
from gtsam_rwhec.odometry.unknowns import OFFSET, SCALE
from gtsam_rwhec.odometry.window_choice import axes_turned
from gtsam_rwhec.results.removed_measurements import Removed
from gtsam_rwhec.solver.certificate import Status
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeReason, free_directions_of, reason_for, sparse_basis


def calibration_of(
    answer: Answer,
    task: Task,
    tracks: Sequence[OdometryTrack],
    reference: str,
    offsets: Array,
    clocks: Sequence[Clock],
    removed: dict[str, tuple[Removed, ...]],
    origin_ns: int,
) -> OdometryCalibration:
    """All that a person is told."""
    names, layout, state = task.names, task.layout, answer.fit.state
    sensors = (reference, *(name for name in names if name != reference))
    change, T, order = _in_frame_of(reference, task, state.T)
    scaled = [name for k, name in enumerate(names) if task.scaled[k]]
    C = answer.freedom.covariance()
    covariance = change @ C @ change.T
    left = change @ answer.freedom.left
    if left.shape[1]:
        reached = (np.abs(left) > REACHES * np.abs(left).max(axis=0)).any(axis=1)
        covariance[reached], covariance[:, reached] = 0.0, 0.0
        covariance[reached, reached] = np.inf
    free = _free_directions(answer, task)
    certificate = answer.certificate
    others = other_answers(
        answer, task, lambda pose: dict(zip(order, _in_frame_of(reference, task, pose)[1], strict=True))
    )
    if free and certificate.status is Status.CERTIFIED:
        certificate = replace(certificate, status=Status.CERTIFIED_NOT_UNIQUE)
    back = float(offsets[names.index(reference)])
    clock_at = [int(layout.at[k, OFFSET]) for k in range(len(names))]
    sigmas = _clock_sigmas(C, clock_at, names, reference) if layout.open[:, OFFSET].any() else {}
    window = answer.windows
    return OdometryCalibration(
        reference=reference,
        sensors=sensors,
        T_reference_sensor={reference: np.eye(4), **dict(zip(order, T, strict=True))},
        scales={name: float(state.scale[names.index(name)]) for name in scaled},
        time_offsets_s={name: float(offsets[names.index(name)]) - back for name in order},
        time_offset_sigmas_s=sigmas,
        order=order,
        covariance=covariance,
        certificate=certificate,
        free_directions=free,
        windows=Windows(
            seconds=float(np.median(window.end - window.start)),
            count=len(window),
            used={name: int(window.used[k].sum()) for k, name in enumerate(names)},
            start_ns=origin_ns + np.round(window.start * 1e9).astype(np.int64),
            end_ns=origin_ns + np.round(window.end * 1e9).astype(np.int64),
        ),
        noise={name: OdometryNoise(*(float(x) for x in np.sqrt(answer.variances[k]))) for k, name in enumerate(names)},
        noise_was_found=frozenset(name for k, name in enumerate(names) if not task.stated[k]),
        removed=removed,
        residuals=residual_sizes(answer, names),
        influences=_influences(answer, task, change, order),
        others=others,
        contradictions=(*inverted_in_words(tracks), *contradictions_of(answer, task)),
        findings=findings_of(answer, task, tracks, clocks, sigmas),
        remarks=remarks_of(task),
    )


def _in_frame_of(reference: str, task: Task, T: Array) -> tuple[Array, Array, tuple[str, ...]]:
    """The matrix (d, p) from the unknowns to the record's tangents and scales, the poses (m - 1, 4, 4), their names.

    With T_r the reference's pose in the frame of sensor 0, a pose is T_r^-1 T_k, and its tangent x_k - Ad(pose^-1) x_r.
    """
    names, layout = task.names, task.layout
    r = names.index(reference)
    order = tuple(name for name in names if name != reference)
    at = [names.index(name) for name in order]
    poses = se3.inverse(T[r][None]) @ T[at]
    scales = [k for k in range(len(names)) if task.scaled[k]]
    change = np.zeros((6 * len(at) + len(scales), layout.size + 1))
    back = se3.adjoint(se3.inverse(poses))
    for row, k in enumerate(at):
        rows = slice(6 * row, 6 * row + 6)
        if k:
            change[rows, layout.at[k, :6]] += np.eye(6)
        if r:
            change[rows, layout.at[r, :6]] -= back[row]
    for row, k in enumerate(scales):
        change[6 * len(at) + row, layout.at[k, SCALE]] = 1.0
    return change[:, :-1], poses, order


def _clock_sigmas(C: Array, at: list[int], names: tuple[str, ...], reference: str) -> dict[str, float]:
    """Standard deviations of the offsets to the reference's clock."""
    padded = np.pad(C, ((0, 1), (0, 1)))
    r = at[names.index(reference)]
    return {
        name: float(np.sqrt(max(padded[k, k] + padded[r, r] - 2.0 * padded[k, r], 0.0)))
        for name, k in zip(names, at, strict=True)
        if name != reference
    }


def _free_directions(answer: Answer, task: Task) -> tuple[FreeDirection, ...]:
    left = answer.freedom.left
    if not left.shape[1]:
        return ()
    names = task.names[1:]
    windows, fit = answer.windows, answer.fit
    length = 1.0
    variance = 1.0 / float((1.0 / answer.variances[:, 0]).sum())
    turned, squares, _ = axes_turned(windows, fit.state.motion, variance)
    residual = float(np.sqrt((fit.linear.r[..., :3] ** 2).sum(axis=2)[windows.used].mean()))
    reason = reason_for(min(turned, 2), float(np.sqrt(squares.sum())), residual, len(windows))
    if reason is FreeReason.CONTRADICTION:
        reason = FreeReason.NOISE
    basis = sparse_basis(seven_each(left, task.layout), length)
    return free_directions_of(names, basis, length, dict.fromkeys(names, reason))


def _influences(answer: Answer, task: Task, change: Array, order: tuple[str, ...]) -> tuple[Influence, ...]:
    """dx / dg = (information)^-1 row' / sigma for each whitened row of what is given."""
    rows = answer.fit.rows
    Z = answer.freedom.complement()
    inner = Z.T @ answer.freedom.information @ Z
    solve = Z @ np.linalg.solve(inner + 1e-13 * np.diag(np.diagonal(inner)), Z.T)
    result = []
    C = answer.freedom.covariance()
    for r, row, number in zip(rows.r, rows.J, rows.numbers, strict=True):
        if not number.what:
            continue
        moved = (change @ solve @ row / number.sigma)[: 6 * len(order)].reshape(-1, 6)
        spare = 1.0 - float(row @ C @ row)
        result.append(
            Influence(
                number.what,
                number.value,
                number.sigma,
                number.unit,
                {name: _twist(twist) for name, twist in zip(order, moved, strict=True)},
                {name: _twist(twist * number.sigma) for name, twist in zip(order, moved, strict=True)},
                off_by=abs(float(r)) / np.sqrt(spare) if spare > 1e-3 else 0.0,
            )
        )
    return tuple(result)


def _twist(x: Array) -> tuple[float, float, float, float, float, float]:
    a, b, c, d, e, f = (float(v) for v in x)
    return a, b, c, d, e, f
