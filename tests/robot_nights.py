"""Rows of robots' nights, made up: a camera and a board each, of which some move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.fleet.fleet_rows import FailedLog, RobotRow, RowFrame

DAY_NS = 86_400_000_000_000
FIRST_DAY = 20_000
#: Deviations of the tangents: rad and m.
DEVIATIONS = np.tile(np.r_[np.full(3, 1e-3), np.full(3, 2e-4)], 2)


def day_ns(night: int) -> int:
    """When a night begins."""
    return (FIRST_DAY + night) * DAY_NS


def night_row(robot: str, night: int, T: np.ndarray, covariance: np.ndarray) -> RobotRow:
    """A night of a camera and a board."""
    frames = (RowFrame("cam", "sensor", T[0]), RowFrame("board", "target", T[1]))
    return RobotRow(
        f"{robot}@{night}", robot, "hall", day_ns(night), day_ns(night) + 10**12, Verdict.USE, "All fits.",
        frames=frames, covariance=covariance, logs=3, measurements=120, cpu_s=2.5, bytes_read=10**6, peak_bytes=10**8,
        result=f"robots/{robot}@{night}/result.json",
    )  # fmt: skip


def robot_nights(robot: str, nights: int, moved_at: int = 10**9, size: float = 8.0, seed: int = 0) -> list[RobotRow]:
    """The nights of a robot whose camera moves by so many deviations before one of them."""
    generator = np.random.default_rng([seed, *robot.encode()])
    T = se3.expmap(generator.standard_normal((2, 6)))
    covariance = np.diag(DEVIATIONS**2)
    step = np.zeros(12)
    step[:6] = size / np.sqrt(6.0)
    xi = generator.standard_normal((nights, 12)) + (np.arange(nights) >= moved_at)[:, None] * step
    return [
        night_row(robot, night, T @ se3.expmap((DEVIATIONS * each).reshape(2, 6)), covariance)
        for night, each in enumerate(xi)
    ]


def with_constant_errors(row: RobotRow, size: float) -> RobotRow:
    """The same night with a constant error of both carriers in its covariance, as ``rw.calibrate`` puts it there."""
    covariance = row.covariance.copy()
    for kind in ("sensor", "target"):  # the errors of the two carriers are independent
        moves = (size * (frame.kind == kind) * se3.adjoint(np.linalg.inv(frame.T)[None])[0] for frame in row.frames)
        shift = np.vstack(list(moves))
        covariance += shift @ shift.T
    return replace(row, covariance=covariance, constant_errors=((size,) * 6, (size,) * 6))


def failed_night(robot: str, night: int) -> RobotRow:
    """A night without a calibration."""
    logs = (FailedLog(f"s3://logs/{robot}/{night}.mcap", "the store stopped half way"),)
    return RobotRow(
        f"{robot}@{night}", robot, "hall", day_ns(night), day_ns(night), failed_logs=logs, failure="no log was read"
    )


def with_free_height(row: RobotRow) -> RobotRow:
    """The same night where the camera's z is free."""
    covariance = row.covariance.copy()
    covariance[5, 5] = np.inf
    return replace(row, covariance=covariance, verdict=Verdict.DO_NOT_USE, grounds=(Ground.NOT_UNIQUE,))
