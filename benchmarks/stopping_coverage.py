"""Is the truth inside the ellipsoid at the moment of stopping, and is the wanted accuracy really reached?

    python benchmarks/stopping_coverage.py [--cells 125] [--seed 1000] [--jobs 1] [--road ROAD] [--keep FILE]
        [--operator random|planner|gain] [--kinds WORDS]

Cells of four kinds: a camera on an arm's hand, one beside the arm, two cameras on the hand, three boards.
A pose of a board has noise of 0.05 degrees about the sensor's x and y and 0.02 about z, 0.1 mm across and 0.3 mm along
its axis, all times a level that nobody states, 0.6 to 1.7; its covariance is stated without the level. The arm's poses
have noise of 0.003 to 0.02 degrees and 0.02 to 0.1 mm, which nobody states at all, and which two cameras share.

After each take from the fifth on the rule is asked: 0.5 mm at 0.8 m with 95 %. Roads to the answer: "stream", an update
of ``rw.Stream``; "calibrate", ``rw.calibrate``; "plain", the same that does not allow for errors of the arm that vary
with its configuration, which these arms do not have. Operators: "random" holds the board in poses at random, well
spread; "planner" brings it where the outline of `rw.plan`'s first pose is, planned anew after each take; "gain" takes
three poses at random, and then that which lowers the entropy of the cameras' poses most (the next view of
arXiv:2303.06766), of the same candidates. Planned boards are tilted, and as far away, as those at random may be. Beside
it: the same answers without widening, by a chi-square quantile, as who stops when a covariance looks small; and four
and eight fixed views.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from bars import Row, Share, each_done, keep_line, kept_lines, run_script
from numpy.typing import NDArray
from rwhec_factors.se3 import inverse, pose
from scipy.special import chdtri

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.point_uncertainty import ball_radius
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.capture.plan_candidates import drawn_candidates
from gtsam_rwhec.capture.plan_information import predicted, rows_at
from gtsam_rwhec.capture.plan_sources import cell_of
from gtsam_rwhec.geometry.pose_covariances import error_of
from gtsam_rwhec.simulate.simulated_noise import rotations_of_vectors

Array = NDArray[np.float64]
KINDS = ("eye in hand", "eye to hand", "two cameras", "several boards")
WANTED = rw.Accuracy(0.0005, distance_m=0.8)
#: rad about and m along the sensor's axes, times the level of a cell
NOISE_OF_B = np.r_[np.radians([0.05, 0.05, 0.02]), 1e-4, 1e-4, 3e-4]
LEVELS = 0.6, 1.7
TURNS_OF_A, SHIFTS_OF_A = np.radians([0.003, 0.02]), (2e-5, 1e-4)
FIRST_LOOK, MOST_TAKES = 5, 60
#: Of boards before a camera.
AWAY_M, TILT_DEG = (0.4, 0.9), 45.0
#: What planners know of cameras and boards.
CAMERA = Camera.of(1280, 960, "pinhole", [[1100, 0, 639.5], [0, 1100, 479.5], [0, 0, 1]], [], "a simulated cell")
BOARD = Checkerboard("b", 6, 8, 0.03).corners()
#: Shares: of all runs, and what their interval of 99 % has to touch.
INSIDE, REACHED, MOST_MEDIAN = (0.93, 0.97), 0.93, 12


@dataclass(frozen=True, eq=False)
class View:
    """Where a camera should see a board; without a name any one of them."""

    T_sensor_target: Array
    sensor: str = "cam_0"
    target: str = ""


class Cell:
    """A cell: its truth, and takes of it."""

    def __init__(self, kind: str, seed: int) -> None:
        self.draws = draws = np.random.default_rng((KINDS.index(kind), seed))
        self.kind = kind
        self.level, self.turn, self.shift = (
            math.exp(draws.uniform(*np.log(span))) for span in (LEVELS, TURNS_OF_A, SHIFTS_OF_A)
        )
        turned = rotations_of_vectors(draws.normal(0.0, 0.2, (5, 3)))
        moved = draws.normal(0.0, 0.03, (5, 3))
        if kind == "eye to hand":
            away = rotations_of_vectors([math.pi, 0.0, 0.0])
            self.Y = {"cam_0": pose(away @ turned[0], moved[0] + [0.6, 0.0, 1.0])}
            self.X = {"board_0": pose(turned[1], moved[1] + [0.0, 0.0, 0.1])}
            return
        cameras, boards = 2 if kind == "two cameras" else 1, 3 if kind == "several boards" else 1
        self.Y = {f"cam_{k}": pose(turned[k], moved[k] + [0.05 + 0.15 * k, 0.0, 0.08]) for k in range(cameras)}
        self.X = {f"board_{k}": pose(turned[k + 2], moved[k + 2] + [0.6, 0.4 * k, 0.0]) for k in range(boards)}

    def take(self, stream: rw.Stream, view: View, stamp_ns: int) -> None:
        """Measure with a board where a camera should see it; other boards by chance."""
        names = list(self.X)
        first = view.target or names[self.draws.integers(len(names))]
        A = self.Y[view.sensor] @ view.T_sensor_target @ inverse(self.X[first])
        error = self._error(np.repeat([self.turn, self.shift], 3))
        measured = A @ error if self.kind == "eye to hand" else error @ A  # the hand's error, in its own axes
        for sensor, Y in self.Y.items():
            for target, X in self.X.items():
                if target != first and self.draws.random() < 0.5:
                    continue
                B = inverse(Y) @ A @ X
                off = self._error(self.level * NOISE_OF_B)  # in the sensor's axes
                noisy = pose(off[:3, :3] @ B[:3, :3], B[:3, 3] + off[:3, 3])
                into = np.kron(np.eye(2), B[:3, :3].T)
                stated = into @ np.diag(NOISE_OF_B**2) @ into.T
                stream.add(
                    target=target,
                    sensor=sensor,
                    T_sensorcarrier_targetcarrier=measured,
                    T_sensor_target=noisy,
                    covariance=stated,
                    stamp_ns=stamp_ns,
                )

    def _error(self, deviations: Array) -> Array:
        xi = deviations * self.draws.standard_normal(6)
        return pose(rotations_of_vectors(xi[:3]), xi[3:])


Answer = rw.Calibration | rw.StreamUpdate
Operator = Callable[[Cell, rw.Stream], View]


def spread_views(cell: Cell, stream: rw.Stream) -> View:
    """The next pose of a board before the first camera: at random, tilted by 10 to 45 degrees, 0.4 to 0.9 m away."""
    draws = cell.draws
    about, tilt, roll = (
        draws.uniform(0.0, 2.0 * math.pi),
        draws.uniform(*np.radians([10.0, TILT_DEG])),
        draws.uniform(-1.5, 1.5),
    )
    tilted = rotations_of_vectors(tilt * np.array([math.cos(about), math.sin(about), 0.0]))
    away = draws.uniform(*AWAY_M)
    facing = rotations_of_vectors([0.0, 0.0, roll]) @ rotations_of_vectors([math.pi, 0.0, 0.0])
    return View(pose(tilted @ facing, away * np.r_[draws.uniform(-0.15, 0.15, 2), 1.0]))


def planned_view(cell: Cell, stream: rw.Stream) -> View:
    """Where the outline of the pose is that a plan puts first."""
    if not stream.last.measurements:
        return spread_views(cell, stream)
    known = {"cameras": dict.fromkeys(cell.Y, CAMERA), "boards": dict.fromkeys(cell.X, BOARD)}
    (pair, B), *_ = rw.plan(stream.problem, plan_options(cell), **known).poses[0].T_sensor_target.items()
    return View(B, pair.sensor, pair.target)


def most_gain(cell: Cell, stream: rw.Stream) -> View:
    """Where the cameras' poses lose most entropy, as by the deviations of the measurements so far."""
    if stream.last.measurements < 3 * len(cell.Y):
        return spread_views(cell, stream)
    options = plan_options(cell)
    cameras, boards = dict.fromkeys(cell.Y, CAMERA), dict.fromkeys(cell.X, BOARD)
    known = cell_of(stream.problem, options, None, cameras, boards)
    candidates = drawn_candidates(known, options, known.covariance, cell.draws)
    W = rows_at(known, candidates.A, candidates.seen)
    places = np.concatenate([np.arange(known.slots[name].start, known.slots[name].stop) for name in cell.Y])
    own = W @ known.covariance
    lost = own[:, :, places]
    inner = np.eye(W.shape[1]) + own @ W.transpose(0, 2, 1)
    left = known.covariance[np.ix_(places, places)] - lost.transpose(0, 2, 1) @ np.linalg.solve(inner, lost)
    best = int(np.argmin(np.linalg.slogdet(left)[1]))
    pair = next(pair for pair, seen in candidates.seen.items() if seen[best] > 0.0)
    return View(predicted(known, pair, candidates.A[[best]])[0], pair.sensor, pair.target)


def plan_options(cell: Cell) -> rw.PlanOptions:
    """What the operator tells a planner."""
    return rw.PlanOptions(
        wanted=WANTED, near_m=AWAY_M[0], far_m=AWAY_M[1], tilt_deg=TILT_DEG, stated="exact",
        moves="targets" if cell.kind == "eye to hand" else "sensors",
    )  # fmt: skip


OPERATORS: dict[str, Operator] = {"random": spread_views, "planner": planned_view, "gain": most_gain}


def run(kind: str, seed: int, road: str, operator: str = "random") -> dict[str, Any]:
    """One cell: what is true when the rule stops, when a naive one does, and after four and eight views."""
    cell, stream, rule = Cell(kind, seed), rw.Stream(), rw.StoppingRule(WANTED, most_takes=MOST_TAKES)
    found: dict[str, Any] = {"kind": kind, "seed": seed, "road": road, "operator": operator}
    with warnings.catch_warnings(action="ignore"):
        for takes in range(1, MOST_TAKES + 1):
            cell.take(stream, OPERATORS[operator](cell, stream), takes * 10**9)
            if takes < FIRST_LOOK and takes != 4:
                continue
            answer: Answer = stream.last
            if road != "stream":
                answer = rw.calibrate(stream.problem, rw.CalibrateOptions(systematic=road == "calibrate"))
            if takes in (4, 8):
                found[f"off_{takes}"] = off_mm(cell, answer)
            if takes < FIRST_LOOK:
                continue
            decision = rule.after(answer, takes=takes)
            if "naive" not in found and answer.refined is not None and is_small(answer):
                found["naive"] = at_stop(cell, answer, takes, 1.0, naive=True)
            if decision.stop and "rule" not in found:
                found["rule"] = at_stop(cell, answer, takes, decision.widening, naive=False)
            if takes >= 8 and "rule" in found and "naive" in found:
                break
    return found


def is_small(answer: Answer) -> bool:
    """Whether the covariance looks small enough, by a chi-square quantile."""
    place = WANTED.place_m
    every = [answer.uncertainty_at(place, name).covariance_m2 for name in answer.Y]
    return all(
        np.isfinite(c).all() and ball_radius(np.linalg.eigvalsh(c), WANTED.level) <= WANTED.radius_m for c in every
    )


def at_stop(cell: Cell, answer: Answer, takes: int, widening: float, *, naive: bool) -> dict[str, Any]:
    """What is true of the first camera, and of the worst one, at the moment of stopping."""
    refined = answer.refined
    point = answer.uncertainty_at(WANTED.place_m, "cam_0")
    errors = (
        ("inside", error_of(refined.Y["cam_0"], cell.Y["cam_0"]), refined.covariance("cam_0")),
        ("inside_of_point", moved(cell, answer, "cam_0"), point.covariance_m2),
    )
    found: dict[str, Any] = {"takes": takes, "off_mm": off_mm(cell, answer)}
    for name, e, covariance in errors:
        most = chdtri(len(e), 1.0 - WANTED.level) if naive else refined.squared_radius(len(e), WANTED.level)
        found[name] = bool(e @ np.linalg.solve(covariance, e) <= most * widening**2)
    return found


def moved(cell: Cell, answer: Answer, sensor: str) -> Array:
    """(3,): how far off the point in front of a sensor is, m."""
    place = np.r_[WANTED.place_m, 1.0]
    return ((poses_of(answer)[sensor].matrix() - cell.Y[sensor]) @ place)[:3]


def poses_of(answer: Answer) -> dict[str, gtsam.Pose3]:
    """The sensors' best poses."""
    return answer.Y if answer.refined is None else answer.refined.Y


def off_mm(cell: Cell, answer: Answer) -> float:
    """The same of the worst sensor, mm; infinite without an answer."""
    return max((1e3 * float(np.linalg.norm(moved(cell, answer, name))) for name in poses_of(answer)), default=math.inf)


def rows(cells: int, seed: int, jobs: int, road: str, operator: str, kinds: str, keep: str) -> list[Row]:
    """The table; a run that was ended goes on with what it kept."""
    path = Path(keep) if keep else None
    done = kept_lines(path)
    had = {(one["kind"], one["seed"]) for one in done}
    asked = [kind for kind in KINDS if kinds in kind]
    calls = [(kind, seed + i, road, operator) for i in range(cells) for kind in asked if (kind, seed + i) not in had]
    for _, one in each_done(run, calls, jobs, "cells"):
        done.append(one)
        keep_line(path, one)
    table = []
    for kind in (*KINDS, "all"):
        of_kind = [one for one in done if kind in (one["kind"], "all")]
        if of_kind:
            table += rows_of(kind, of_kind)
    return table


def rows_of(kind: str, done: list[dict[str, Any]]) -> list[Row]:
    """The lines of one kind, or of all."""
    wanted, is_all = 1e3 * WANTED.radius_m, kind == "all"
    stopped = [one["rule"] for one in done if "rule" in one]
    table = [Row(f"{kind}: stopped within {MOST_TAKES} takes", f"{len(stopped)} of {len(done)}")]
    for name, what in (("inside", "pose inside 95 %"), ("inside_of_point", "point at 0.8 m inside 95 %")):
        share = Share.of([one[name] for one in stopped])
        bar = ("93 to 97 %", INSIDE[0] <= share.value <= INSIDE[1]) if is_all else ()
        table.append(Row(f"    {what}", str(share), *bar))
    share = Share.of([one["off_mm"] <= wanted for one in stopped])
    table.append(Row("    0.5 mm really reached", str(share), *((">= 93 %", share.value >= REACHED) if is_all else ())))
    median = float(np.median([one["takes"] for one in stopped]))
    table.append(
        Row("    takes, median", f"{median:g}", *((f"<= {MOST_MEDIAN}", median <= MOST_MEDIAN) if is_all else ()))
    )
    naive = [one["naive"] for one in done if "naive" in one]
    of_naive = [Share.of([one[name] for one in naive]) for name in ("inside", "inside_of_point")]
    off = Share.of([one["off_mm"] <= wanted for one in naive])
    table.append(Row("    when a covariance looks small: pose, point inside", f"{of_naive[0]}; {of_naive[1]}"))
    table.append(Row("    the same: reached; takes, median", f"{off}; {np.median([one['takes'] for one in naive]):g}"))
    for views in (4, 8):
        share = Share.of([one[f"off_{views}"] <= wanted for one in done])
        table.append(Row(f"    {views} fixed views: 0.5 mm reached", str(share)))
    return table


if __name__ == "__main__":
    run_script(
        "The moment of stopping: 0.5 mm at 0.8 m, by {road}, {operator}",
        rows, cells=125, seed=1000, jobs=1, road="stream", operator="random", kinds="", keep="",
    )  # fmt: skip
