"""Planned poses against random ones: how many takes, is something seen, and does a plan promise what comes?

    python benchmarks/planned_poses.py [--rigs 100] [--calibrated 16] [--seed 0] [--jobs 1]

Cells (`planned_cells`) are of four kinds: a camera on the hand, a camera beside the arm, two cameras on the hand,
three boards. Cameras project the boards' corners with noise of 0.1 to 0.2 px; the arm's poses have 0.01 to 0.03 degrees
and 0.05 to 0.2 mm. The operator knows each camera's pose to 5 degrees and 3 cm, nothing of the boards', takes the
present pose, and then the first pose of a new plan, twelve in all. Random poses are uniform in the same box about the
present pose, turned by up to 45 degrees about any axis, and kept where a camera sees a whole board; planned ones may
turn by 90. Rows without a bar have random poses that turn further.

The deviation of a point 0.8 m before the worst sensor is compared: by the information at the truth, with what was
really seen; and the root mean square of errors that came, of answers by `rw.refine`. The deviation for the next take is
predicted from measurements, and, from the sixth take on, from a calibration, whose noise is estimated anew at each
(``--calibrated`` cells; A's is stated, as in rig files); and compared with what the next one says.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace

import numpy as np
from bars import Row, at_most, in_order, run_script
from planned_cells import KINDS, WANTED_AT_M, Array, TrueCell, cell
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.capture.plan_candidates import drawn_candidates
from gtsam_rwhec.capture.plan_information import rows_at
from gtsam_rwhec.capture.plan_ranking import Task
from gtsam_rwhec.capture.plan_sources import cell_of
from gtsam_rwhec.errors import RwhecWarning

PLANNED, RANDOM = 12, 40
TURNS_DEG = (45.0, 60.0, 90.0)
#: Of the bound of what any planned poses leave: candidates, steps, and how much the worst direction counts.
CANDIDATES, STEPS, SHARPNESS = 1000, 200, 15.0
#: Takes after which a calibration predicts the next.
FIRST, LAST = 6, 12
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True)
class Taken:
    """What became of a cell."""

    ratios: tuple[float, ...]  #: Deviation of the planned over that of the random poses, for each turn
    least: tuple[float, ...]  #: The same of what no planned poses beat
    errors_mm: tuple[float, float]  #: Of the answers that came, planned and random
    unseen: int  #: Takes at which no camera saw a board
    off: tuple[float, ...]  #: How far predictions were off what came, shares
    seconds: float  #: Of the processor, of the slowest plan


def at_truth(true: TrueCell, poses: Array) -> tuple[Task, Array, Array]:
    """The task, what is known without a take (d, d), and what a take at each pose adds (N, d, d), at the truth."""
    known = cell_of(None, replace(true.options, guesses={**true.X, **true.Y}), None, true.cameras, true.boards)
    seen = {pair: np.array([true.pixels(*pair, A) is not None for A in poses]) for pair in known.pairs}
    W = rows_at(known, poses, seen)
    task = Task.of(known, list(true.Y), [WANTED_AT_M] * len(true.Y), 0.95)
    return task, known.known + 1e-9 * np.diag(known.rough), W.transpose(0, 2, 1) @ W


def deviation_mm(true: TrueCell, poses: Array) -> float:
    """The largest deviation of a point before a sensor, by the information at the truth."""
    task, known, added = at_truth(true, poses)
    return 1e3 * float(np.sqrt(task.variances(np.linalg.inv(known + added.sum(axis=0)))[:, -1].max()))


def least_mm(true: TrueCell, poses: Array) -> float:
    """No ``PLANNED`` of these poses leave a smaller one, whoever chooses them, and however often each.

    With weights Z of all directions, the mean variance tr(Z V) is at most the largest, and convex in how often each
    pose is taken: its derivatives anywhere bound it from below everywhere. Where, multiplicative steps find.
    """
    task, known, added = at_truth(true, poses)
    often, least = np.full(len(poses), PLANNED / len(poses)), 0.0
    for _ in range(STEPS):
        V = np.linalg.inv(known + np.tensordot(often, added, 1))
        values, axes = np.linalg.eigh(task.rows @ V @ task.rows.transpose(0, 2, 1))
        Z = np.exp(SHARPNESS * (values / values.max() - 1.0))
        rows = np.sqrt(Z / Z.sum())[:, :, None] * (axes.transpose(0, 2, 1) @ task.rows)
        moved = rows.reshape(-1, len(V)) @ V
        gains = np.einsum("ki,nij,kj->n", moved, added, moved, optimize=True)
        mean = float(np.einsum("ki,ki->", moved, rows.reshape(-1, len(V))))
        least = max(least, mean + float(often @ gains) - PLANNED * float(gains.max()))
        often *= np.sqrt(gains)
        often *= PLANNED / often.sum()
    return 1e3 * float(np.sqrt(least))


def error_mm(true: TrueCell, problem: rw.Problem) -> float:
    """How far the worst point is from its true place, by an answer with the noise as it is."""
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        options = rw.RefineOptions(noise="given", carrier_noise=true.noise)
        refined = rw.refine(problem, rw.solve(problem), options)
    point = np.array([0.0, 0.0, WANTED_AT_M, 1.0])
    return 1e3 * max(float(np.linalg.norm(((refined.Y[name].matrix() - T) @ point)[:3])) for name, T in true.Y.items())


def taken(kind: str, seed: int) -> Taken:
    """Twelve takes of a cell, each the best of a new plan; and forty at random."""
    true, problem, options = cell(kind, seed), rw.Problem(), None
    poses: list[Array] = []
    off: list[float] = []
    seconds, unseen, promised = 0.0, 0, np.nan
    for i in range(PLANNED + 1):
        options = true.options if options is None else replace(options, present=None)
        start = time.process_time()
        plan = rw.plan(problem if i else None, options, cameras=true.cameras, boards=true.boards)
        seconds = max(seconds, time.process_time() - start)
        if np.isfinite(promised):
            off.append(abs(promised / plan.outlook.now_mm - 1.0))
        if i == PLANNED or not plan.poses:
            break
        poses.append(plan.poses[0].T_sensorcarrier_targetcarrier)
        promised = plan.poses[0].deviation_mm
        unseen += not true.take(problem, poses[-1], i)
    found, at_random = [], rw.Problem()
    for turn in TURNS_DEG:
        others = true.random_poses(RANDOM, turn)
        found.append(deviation_mm(true, others))
        if turn == TURNS_DEG[0]:
            for i, A in enumerate(others):
                true.take(at_random, A, i)
    known = replace(true.options, guesses={**true.X, **true.Y}, candidates=CANDIDATES)
    exact = cell_of(None, known, None, true.cameras, true.boards)
    every = drawn_candidates(exact, known, np.zeros_like(exact.known), true.rng).A
    least = least_mm(true, np.concatenate([every, others, poses]))
    ratios = [deviation_mm(true, np.array(poses)) / one for one in found]
    bounds = tuple(least / one for one in found)
    return Taken(
        tuple(ratios), bounds, (error_mm(true, problem), error_mm(true, at_random)), unseen, tuple(off), seconds
    )


def calibrated(kind: str, seed: int, road: str) -> list[float]:
    """What a calibration predicts for the next take over what the next calibration says; "plain" as in `rows`."""
    true, problem = cell(kind, 10_000 + seed), rw.Problem()
    options, ratios, promised = true.options, [], np.nan
    for i in range(LAST + 1):
        source: rw.Problem | rw.Calibration | None = problem if i else None
        if i >= FIRST:
            with warnings.catch_warnings(action="ignore", category=RwhecWarning):
                how = rw.CalibrateOptions(observations="poses", carrier_noise=true.noise, systematic=road != "plain")
                source = rw.calibrate(problem, how)
            points = [source.uncertainty_at([0.0, 0.0, WANTED_AT_M], name).radius_mm for name in true.Y]
            if np.isfinite(promised):
                ratios.append(promised / max(points))
        plan = rw.plan(source, options, cameras=true.cameras, boards=true.boards)
        promised = plan.poses[0].deviation_mm if i >= FIRST else np.nan
        true.take(problem, plan.poses[0].T_sensorcarrier_targetcarrier, i)
        options = replace(options, present=None)
    return ratios


#: A gantry that turns its hand about one axis only.
GANTRY = "".join(
    ["<robot name='gantry'>", *(f"<link name='l{i}'/>" for i in range(5))]
    + [
        f"<joint name='j{i}' type='{kind}'><parent link='l{i}'/><child link='l{i + 1}'/><axis xyz='{axis}'/>"
        f"<limit lower='{-size}' upper='{size}' effort='1' velocity='1'/></joint>"
        for i, (kind, axis, size) in enumerate(
            [
                ("prismatic", "1 0 0", 0.3),
                ("prismatic", "0 1 0", 0.3),
                ("prismatic", "0 0 1", 0.3),
                ("revolute", "0 0 1", 1.5),
            ]
        )
    ]
    + ["</robot>"]
)


def said_after(case: str, seed: int) -> int:
    """After how many takes a plan says that what is wanted is never reached; 99 if it does not within ten."""
    import tempfile
    from pathlib import Path

    true, problem = cell("hand", 20_000 + seed), rw.Problem()
    options = replace(true.options, wanted=rw.Accuracy(5e-4, WANTED_AT_M))
    if case == "no target within the box":
        place = se3.inverse(true.present)[:3, 3] + 3.0
        options = replace(options, box_m=(tuple(place), tuple(place + 0.5)))
    elif case == "an accuracy beyond the arm":
        options = replace(options, wanted=rw.Accuracy(1e-6, WANTED_AT_M))
    else:
        with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
            Path(file.name).write_text(GANTRY)
            arm = rw.capture.Arm.read(file.name, "l0", "l4", [0.0, 0.0, 0.0, 0.0])
        # the gantry's base is where its hand is at present
        X = {name: true.present @ T for name, T in true.X.items()}
        true = replace(true, X=X, present=np.eye(4))
        options = replace(options, arm=arm, present=np.eye(4), box_m=None)
    for i in range(10):
        plan = rw.plan(problem if i else None, options, cameras=true.cameras, boards=true.boards)
        if not plan.outlook.can_be_reached:
            return i
        true.take(problem, plan.poses[0].T_sensorcarrier_targetcarrier, i)
        options = replace(options, present=None)
    return 99


CASES = ("no target within the box", "an accuracy beyond the arm", "an arm that turns about one axis")


def rows(rigs: int, calibrated_cells: int, seed: int, jobs: int) -> list[Row]:
    """The table."""
    each = max(rigs // len(KINDS), 1)
    calls = [(kind, seed + i) for kind in KINDS for i in range(each)]
    done = in_order(taken, calls, jobs, "cells")
    ratios = np.array([one.ratios for one in done])
    what = f"{PLANNED} planned poses over {RANDOM} random ones, deviation"
    found = [at_most(f"{what}: median of {len(done)} cells", float(np.median(ratios[:, 0])), 1.0)]
    for kind in KINDS:
        own = ratios[[call[0] == kind for call in calls]]
        words = ", ".join(
            f"{value:.2f} to {turn:g} deg" for value, turn in zip(np.median(own, axis=0), TURNS_DEG, strict=True)
        )
        found.append(Row(f"  {kind}", words))
    turned = np.median(ratios, axis=0)
    found += [
        Row(f"  random poses turn to {t:g} deg", f"{v:.2f}") for t, v in zip(TURNS_DEG[1:], turned[1:], strict=True)
    ]
    least = np.median([one.least for one in done], axis=0)
    words = ", ".join(f"{value:.2f} to {turn:g} deg" for value, turn in zip(least, TURNS_DEG, strict=True))
    found.append(Row(f"  no {PLANNED} of {CANDIDATES} candidates do better, were the cell known", words))
    errors = np.sqrt((np.array([one.errors_mm for one in done]) ** 2).mean(axis=0))
    found.append(Row("  root mean square of errors that came", f"{errors[0]:.3f} mm over {errors[1]:.3f} mm"))
    found.append(
        at_most(
            f"of {PLANNED * len(done)} proposed poses no camera sees a board at", sum(one.unseen for one in done), 0
        )
    )
    found.append(
        at_most("200 candidates ranked, slowest of all plans, processor", max(one.seconds for one in done), 0.5, " s")
    )
    off = np.concatenate([one.off for one in done])
    found.append(at_most("predicted for the next take, from measurements: off, median", float(np.median(off)), 0.10))
    for road, bar in (("calibrate", 0.10), ("plain", None)):  # "plain": no errors of A that vary with the configuration
        asked = [(kind, seed + i, road) for kind in KINDS for i in range(max(calibrated_cells // len(KINDS), 1))]
        by_answers = np.concatenate(in_order(calibrated, asked, jobs, "calibrations"))
        off_median = float(np.median(np.abs(by_answers - 1.0)))
        found.append(at_most(f"the same from {len(by_answers)} calibrations, {road}", off_median, bar))
        spread = ", ".join(f"{one:.2f}" for one in np.quantile(by_answers, QUANTILES))
        found.append(Row("  predicted over what came: quantiles 5, 25, 50, 75, 95 %", spread))
    for case in CASES:
        after = [said_after(case, seed + i) for i in range(5)]
        found.append(at_most(f"{case}: said after takes", max(after), 3))
    return found


if __name__ == "__main__":
    run_script(
        "Planned poses",
        lambda **o: rows(o["rigs"], o["calibrated"], o["seed"], o["jobs"]),
        rigs=100,
        calibrated=16,
        seed=0,
        jobs=1,
    )
