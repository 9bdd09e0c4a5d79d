"""Whether the logs of a unit agree to one answer: what each log alone would change, against what its noise explains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rwhec_factors import se3
from rwhec_factors.batch import BatchResiduals
from scipy.special import chdtrc

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fleet.unit_problem import UnitProblem
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.corners import candidates_of
from gtsam_rwhec.problem.measurements import Pair

#: Logs disagree where a frame's changes are this many times what noise explains, by chance in one case of a million.
TIMES, CHANCE = 2.0, 1e-6


def disagreeing_logs(found: Calibration, measured: UnitProblem, logs: Sequence[str]) -> tuple[Finding, ...]:
    """A finding where a frame is elsewhere in one of the logs (URLs) than in the others, by more than the noise.

    With the information M = sum J' C^-1 J of a log, its measurements alone would move a frame by
    d = M^-1 sum J' C^-1 r. About the logs' mean of d, sum (d - mean)' M (d - mean) is a chi-square where they agree.
    Errors of the carriers' poses that differ between logs count as a disagreement: the covariance does not hold them
    either.
    """
    refined = found.refined
    if refined is None or len(logs) < 2:
        return ()
    worst, words = TIMES, ""
    for name, (scores, information) in _by_frame(refined, measured, len(logs)).items():
        there = np.flatnonzero(np.linalg.cond(information) < 1e12)
        if len(there) < 2:
            continue
        shifts = np.linalg.solve(information[there], scores[there][:, :, None])[:, :, 0]
        shifts -= np.linalg.solve(information[there].sum(axis=0), scores[there].sum(axis=0))
        squares = np.einsum("li,lij,lj->l", shifts, information[there], shifts)
        freedom = 6.0 * (len(there) - 1)
        times = float(np.sqrt(squares.sum() / freedom))
        if times <= worst or chdtrc(freedom, squares.sum()) > CHANCE:
            continue
        worst, most = times, int(np.argmax(squares))
        mm, degrees = 1e3 * np.linalg.norm(shifts[most, 3:]), np.degrees(np.linalg.norm(shifts[most, :3]))
        words = (
            f"the logs disagree, {times:.1f} times as much as their noise explains, most about {name}: "
            f"{logs[there[most]]} puts it {mm:.2g} mm and {degrees:.2g} degrees from the common answer. Something may "
            "have moved between logs: calibrate with --each log or --each day, and ask fleet watch when"
        )
    return (Finding(Ground.COVARIANCE_DOUBTED, words),) if words else ()


def _by_frame(refined: Refined, measured: UnitProblem, logs: int) -> dict[str, tuple[Array, Array]]:
    """The scores (L, 6) and information (L, 6, 6) of each frame by log, under the noise of all residuals."""
    frames: dict[str, tuple[Array, Array]] = {}
    squares, count = 0.0, 0
    for pair in measured.problem.pairs:
        scale = refined.scale if isinstance(refined.scale, float) else refined.scale.get(pair.target, 1.0)
        X, Y = refined.X[pair.target].matrix(), refined.Y[pair.sensor].matrix()
        A, B, C = _measurements(refined, measured, pair)
        linear = BatchResiduals(A, B).linearize(X, Y, scale)
        W = np.linalg.inv(C)
        Wr = np.einsum("nij,nj->ni", W, linear.residual)
        squares, count = squares + float((linear.residual * Wr).sum()), count + Wr.size
        for name, J in zip(pair.frames, (linear.target, linear.sensor), strict=True):
            scores, information = frames.setdefault(name, (np.zeros((logs, 6)), np.zeros((logs, 6, 6))))
            np.add.at(scores, measured.log_of[pair], -np.einsum("nij,ni->nj", J, Wr))
            np.add.at(information, measured.log_of[pair], np.swapaxes(J, 1, 2) @ W @ J)
    variance = squares / max(count, 1)
    return {name: (scores / variance, information / variance) for name, (scores, information) in frames.items()}


def _measurements(refined: Refined, measured: UnitProblem, pair: Pair) -> tuple[Array, Array, Array]:
    """A by the answer's clocks, B, and its covariances; for an answer from corners, B by the corners."""
    problem = measured.problem
    raw = problem.measurements(*pair)
    A, offset_s = raw.A, refined.time_offsets_s.get(pair.sensor)
    if measured.path is not None and offset_s is not None and raw.stamps_ns is not None:
        A = measured.path.at(raw.stamps_ns + round(1e9 * offset_s))[0]
    if raw.pixels is not None and refined.reprojection is not None:
        estimated = refined.intrinsics.get(pair.sensor)
        camera = problem.cameras[pair.sensor] if estimated is None else estimated.camera
        boards = candidates_of(camera, problem.boards[pair.target], raw.pixels, problem.corner_px, str(pair))
        X, Y = refined.X[pair.target].matrix(), refined.Y[pair.sensor].matrix()
        return A, *boards.chosen(boards.nearer(se3.inverse(Y[None]) @ A @ X))
    if raw.covariances is not None:
        return A, raw.B, raw.covariances
    noise = refined.noise[pair]
    variances = np.repeat([noise.rotation_rad**2, noise.translation_m**2], 3)
    return A, raw.B, np.tile(np.diag(variances), (len(raw.A), 1, 1))
