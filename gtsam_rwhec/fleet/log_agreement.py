"""Whether the logs of a unit agree to one answer: what each log alone would change, against what its noise explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.fleet.detection_covariance import rows_of_pair, weights_of_pair
from gtsam_rwhec.fleet.measured_problem import MeasuredProblem
from gtsam_rwhec.geometry.poses import Array

#: Logs disagree where a frame's changes are this many times what noise explains, by chance in one case of a million.
TIMES, CHANCE = 2.0, 1e-6


@dataclass
class _Sums:
    """Of one frame, by log: scores (L, 6), their covariances and the information (L, 6, 6)."""

    scores: Array
    spread: Array
    information: Array


def disagreeing_logs(found: Calibration, measured: MeasuredProblem) -> tuple[Finding, ...]:
    """A finding where a frame is elsewhere in one log than in the others, by more than the detections' noise.

    About the common answer a log's score g = sum J' W r of a frame has the covariance M = sum J' W C W J, and
    sum g' M^-1 g over logs is a chi-square where they agree. Errors of the carriers' poses that differ between logs
    count as a disagreement: the covariance does not hold them either.
    """
    refined = found.refined
    if refined is None or len(measured.logs) < 2:
        return ()
    worst, words = TIMES, ""
    for name, sums in _of_frames(refined, measured).items():
        there = np.flatnonzero(np.linalg.cond(sums.information) < 1e12)
        if len(there) < 2:
            continue
        scores = sums.scores[there]
        squares = np.einsum("li,li->l", scores, np.linalg.solve(sums.spread[there], scores[:, :, None])[:, :, 0])
        freedom = 6.0 * (len(there) - 1)
        times = float(np.sqrt(squares.sum() / freedom))
        if times <= worst or chdtrc(freedom, squares.sum()) > CHANCE:
            continue
        log = there[int(np.argmax(squares))]
        shift = np.linalg.solve(sums.information[log], sums.scores[log])
        mm, degrees = 1e3 * np.linalg.norm(shift[3:]), np.degrees(np.linalg.norm(shift[:3]))
        worst = times
        words = (
            f"the logs disagree, {times:.1f} times as much as their noise explains, most about {name}: "
            f"{measured.logs[log]} puts it {mm:.2g} mm and {degrees:.2g} degrees from the common answer. Something may "
            "have moved between logs: calibrate with --each log or --each day, and ask fleet watch when; --refine "
            "looks for outliers and errors of the carriers' poses"
        )
    return (Finding(Ground.COVARIANCE_DOUBTED, words),) if words else ()


def _of_frames(refined: RefinedPoses, measured: MeasuredProblem) -> dict[str, _Sums]:
    count, slots = len(measured.logs), refined.joint.slots
    frames: dict[str, _Sums] = {}
    squares, number = 0.0, 0
    for pair in measured.problem.pairs:
        raw = measured.problem.measurements(*pair)
        places, J, residual = rows_of_pair(refined, pair, raw.A, raw.B)
        weights = weights_of_pair(refined, pair, raw)
        C = measured.covariances.get(pair)
        C = np.einsum("ni,ij->nij", 1.0 / weights, np.eye(6)) if C is None else C
        squares += float(np.einsum("ni,ni->", residual, np.linalg.solve(C, residual[:, :, None])[:, :, 0]))
        number += residual.size
        log = measured.log_of[pair]
        for name in pair.frames:
            slot = slots.get(Unknown(UnknownKind.FRAME, name))
            if slot is None:
                continue
            of_frame = J[:, :, np.isin(places, np.arange(slot.start, slot.stop))]
            WJ = weights[:, :, None] * of_frame
            sums = frames.setdefault(
                name, _Sums(np.zeros((count, 6)), np.zeros((count, 6, 6)), np.zeros((count, 6, 6)))
            )
            np.add.at(sums.scores, log, -np.einsum("nij,ni->nj", WJ, residual))
            np.add.at(sums.spread, log, np.einsum("nij,nik->njk", WJ, C @ WJ, optimize=True))
            np.add.at(sums.information, log, np.einsum("nij,nik->njk", of_frame, WJ, optimize=True))
    for sums in frames.values():
        sums.spread *= squares / max(number, 1)
    return frames
