"""How often the control charts of a fleet alarm where nothing moved, and how soon they find what did.

    python benchmarks/fleet_drift.py [--robots 1000] [--seed 0] [--keep FILE] [--only KIND ...] [--calibrations 0]

Fleets of 100 robots are simulated as rows of `fleet run`, each night of each robot with a covariance of its own, and
given to ``gtsam_rwhec.fleet.watch``, which knows nothing of them. Kinds:

    quiet-D     60 nights without a change; the D numbers are those of D / 6 frames step-D      one frame of every
    second robot moves after 14 quiet nights, in a random direction, by 4 joint (Mahalanobis) deviations of one night
    all-D       all frames move together, by as much spread-12   quiet; robots' true variances are 0.5 to 2 times the
    stated ones serial-12   quiet; errors of successive nights have a correlation of 0.4 tied-12     quiet; the two
    frames' errors have correlations of 0.95, as those of a board and its camera have alone-12    quiet; each robot is
    watched by itself drift-12    one frame drifts by one deviation a night after 14 quiet nights

``--calibrations N`` adds N robots whose nights are calibrated (``rw.calibrate``, a camera and a board, 40 poses) and
half of which have a camera that moves by 4 joint deviations after 14 nights. ``--keep`` is a file of JSON lines with
what each fleet gave, from which an interrupted campaign goes on. Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from bars import Row, Share, given_options, keep_line, kept_lines, print_rows
from changes import log_of
from numpy.typing import NDArray
from rwhec_factors import se3
from simulated_arms import ARM

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.unknowns import Unknown
from gtsam_rwhec.fleet.fleet_rows import RobotRow, RowFrame
from gtsam_rwhec.fleet.watching import DAY_NS, Watched, watch
from gtsam_rwhec.results.changed_frames import as_result, without_constant_errors
from gtsam_rwhec.simulate.simulated_noise import random_poses

FloatArray = NDArray[np.float64]
SIZES = (6, 12, 24, 48)
KINDS = (
    *(f"quiet-{size}" for size in SIZES), *(f"step-{size}" for size in SIZES), *(f"all-{size}" for size in SIZES[1:]),
    "spread-12", "serial-12", "tied-12", "alone-12", "drift-12",
)  # fmt: skip
FLEET, NIGHTS = 100, 60
#: Every second robot of a fleet changes, where there are changes.
CHANGING = 2
#: The first changed night, the nights in which it is to be found, and its size in deviations of one night.
CHANGED, WITHIN, DEVIATIONS = 14, 3, 4.0
RATE, BAND, FOUND, DATED = 1e-3, 0.20, 0.90, 0.80
#: Deviations of a night's numbers, rad and m; they differ by this factor between nights.
SIZE, VARYING = np.r_[np.full(3, 1e-3), np.full(3, 1e-3)], 1.5


def fleet_rows(kind: str, size: int, generator: np.random.Generator) -> Iterator[RobotRow]:
    """The rows of one fleet."""
    quiet = kind not in ("step", "all", "drift")
    nights = NIGHTS if quiet else CHANGED + (20 if kind == "drift" else WITHIN)
    for robot in range(FLEET):
        frames = random_poses(size // 6, 1.0, generator)
        truth = math.exp(generator.uniform(-math.log(2.0), math.log(2.0))) if kind == "spread" else 1.0
        shape = np.eye(size)
        if kind == "tied":
            shape = np.kron(np.array([[1.0, 0.95], [0.95, 1.0]]), np.eye(6))
        turned = np.linalg.qr(generator.standard_normal((6, 6)))[0]
        root = np.linalg.cholesky(shape) @ np.kron(np.eye(size // 6), turned) * np.tile(SIZE, size // 6)[:, None]
        moved = np.zeros(size)
        if not quiet and robot % CHANGING == 0:
            rows = np.arange(size) if kind == "all" else 6 * generator.integers(size // 6) + np.arange(6)
            moved[rows] = generator.standard_normal(len(rows))
            moved *= (1.0 if kind == "drift" else DEVIATIONS) / np.linalg.norm(np.linalg.solve(root, moved))
        error = generator.standard_normal(size)
        for night in range(nights):
            fresh = generator.standard_normal(size)
            error = 0.4 * error + math.sqrt(1.0 - 0.4**2) * fresh if kind == "serial" else fresh
            # A night's own size; steps are of one night's deviations, so that these nights have the size of one.
            own = VARYING ** generator.uniform(-1.0, 1.0) if quiet else 1.0
            xi = math.sqrt(truth) * own * root @ error
            if night >= CHANGED:
                xi = xi + moved * (night - CHANGED + 1 if kind == "drift" else 1.0)
            T = frames @ se3.expmap(xi.reshape(-1, 6))
            yield row_of(f"robot_{robot:03d}", night, T, own**2 * root @ root.T)


def row_of(robot: str, night: int, T: FloatArray, covariance: FloatArray) -> RobotRow:
    """The row of one night."""
    begin = (20_000 + night) * DAY_NS
    names = [f"frame_{i}" for i in range(len(T))]
    return RobotRow(
        f"{robot}@{night}", robot, begin_ns=begin, end_ns=begin + 3_600_000_000_000, verdict=rw.Verdict.USE,
        frames=tuple(RowFrame(name, "sensor", pose) for name, pose in zip(names, T, strict=True)),
        covariance=covariance,
    )  # fmt: skip


def run(name: str, number: int, seed: int) -> dict[str, Any]:
    """What one fleet gave."""
    kind, size = name.split("-")[0], int(name.split("-")[1])
    generator = np.random.default_rng([seed, KINDS.index(name), number])
    rows = list(fleet_rows(kind, size, generator))
    if kind == "alone":
        each = [watch([row for row in rows if row.robot == robot]) for robot in sorted({row.robot for row in rows})]
    else:
        each = [watch(rows)]
    planted = kind in ("step", "all", "drift")
    found = counted(each, lambda robot: not planted or int(robot[-3:]) % CHANGING == 0)
    return {"kind": name, "number": number, "seed": seed, **found}


def counted(found: list[Watched], of: Callable[[str], bool] = bool) -> dict[str, Any]:
    """Nights that were tested, alarms, and of the planted changes how soon, which night, which frames, how."""
    robots = [robot for each in found for name, robot in each.robots.items() if of(name)]
    first = (20_000 + CHANGED) * DAY_NS
    first_alarms = [robot.alarms[0] for robot in robots if robot.alarms]
    return {
        "robots": len(robots),
        "tested": sum(len(robot.tests) - 1 for robot in robots),
        "alarms": sum(not alarm.is_back for robot in robots for alarm in robot.alarms),
        "back": sum(alarm.is_back for robot in robots for alarm in robot.alarms),
        "variance": [each.spread.variance for each in found][:1],
        "correlation": [each.spread.correlation for each in found][:1],
        "found": [
            [
                (alarm.when_ns - first) // DAY_NS + 1,
                abs(alarm.first_changed_ns - first) // DAY_NS,
                len(alarm.frames),
                alarm.kind,
            ]
            for alarm in first_alarms
        ],
    }


def calibrations(number: int, seed: int) -> dict[str, Any]:
    """One robot whose nights are calibrated; an odd one's camera moves."""
    generator = np.random.default_rng([seed, 1000, number])
    X = {"board": random_poses(1, 1.0, generator)[0]}
    Y = {"camera0": random_poses(1, 0.3, generator)[0]}
    rows = []
    options = rw.CalibrateOptions(systematic=False, misreadings=False, sizes="known", robust="none")
    for night in range(CHANGED + WITHIN):
        with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
            result = rw.calibrate(log_of("white", X, Y, ARM, generator), options)
        refined = without_constant_errors(as_result(result))
        unknowns = (Unknown.of("camera0"), Unknown.of("board"))
        C = refined.joint.covariance_of(refined.joint.selector(unknowns))
        rows.append(
            row_of(f"robot_{number}", night, np.stack([refined.Y["camera0"].matrix(), refined.X["board"].matrix()]), C)
        )
        if night == CHANGED - 1 and number % 2:
            moved = generator.standard_normal(6)
            # Four deviations beside the board, which does not move.
            moved *= DEVIATIONS / math.sqrt(moved @ np.linalg.inv(C)[:6, :6] @ moved)
            Y["camera0"] = Y["camera0"] @ se3.expmap(moved[None])[0]
    return {"kind": "moved" if number % 2 else "still", "number": number, "seed": seed, **counted([watch(rows)])}


def fleets_of(kind: str, robots: int) -> int:
    """How many fleets have so many robots of the kind."""
    return math.ceil(robots / FLEET) * (CHANGING if kind.split("-")[0] in ("step", "all", "drift") else 1)


def campaign(given: Any) -> Iterator[dict[str, Any]]:
    """What the file has, and what it lacks."""
    done = {(one["kind"], one["number"], one["seed"]): one for one in kept_lines(given.keep)}
    jobs = [(kind, number) for kind in given.only for number in range(fleets_of(kind, given.robots))]
    jobs += [("moved" if number % 2 else "still", number) for number in range(given.calibrations)]
    for kind, number in jobs:
        one = done.get((kind, number, given.seed))
        if one is None:
            calibrated = kind in ("moved", "still")
            one = calibrations(number, given.seed) if calibrated else run(kind, number, given.seed)
            keep_line(given.keep, one)
        yield one


def table(found: list[dict[str, Any]]) -> list[Row]:
    """The rows of the table."""
    rows = []
    for kind in (*KINDS, "still", "moved"):
        own = [one for one in found if one["kind"] == kind]
        if not own:
            continue
        robots, tested = sum(one["robots"] for one in own), sum(one["tested"] for one in own)
        alarms, back = sum(one["alarms"] for one in own), sum(one["back"] for one in own)
        if kind.split("-")[0] in ("step", "all", "moved", "drift"):
            first = [each for one in own for each in one["found"]]
            early = sum(each[0] < 1 for each in first)
            hit = [each for each in first if 1 <= each[0] <= (20 if kind.startswith("drift") else WITHIN)]
            share = Share(len(hit), robots)
            dated = Share.of([each[1] <= 1 for each in hit])
            named = Share.of([each[2] == 1 for each in hit])
            slow = sum(each[3] == "drift" for each in hit)
            has_bar = kind.startswith("step")
            rows.append(Row(
                f"{kind}: found within {WITHIN} nights" if slow < len(hit) / 2 else f"{kind}: found",
                f"{share}; {early} false before", f">= {100 * FOUND:g} %" if has_bar else "",
                share.value >= FOUND if has_bar else None,
            ))  # fmt: skip
            rows.append(Row(
                "    its date within one night", f"{dated}; one frame named {named}; a drift said {slow}",
                f">= {100 * DATED:g} %" if has_bar else "", dated.value >= DATED if has_bar else None,
            ))  # fmt: skip
        else:
            low, high = Share(alarms, tested).interval(0.95)
            spread = np.mean([one["variance"] for one in own]), np.mean([one["correlation"] for one in own])
            rows.append(Row(
                f"{kind}: false alarms a robot in {1 / RATE:.0f} nights",
                f"{alarms / tested / RATE:.2f} [{low / RATE:.2f}, {high / RATE:.2f}] ({alarms} in {tested} nights, "
                f"{back} back); variance {spread[0]:.3f}, correlation {spread[1]:.3f}",
            ))  # fmt: skip
    return rows


def pooled(found: list[dict[str, Any]]) -> list[Row]:
    """The false alarms of all sizes together, without and with those that end a false alarm."""
    own = [one for one in found if one["kind"].startswith("quiet")]
    tested, alarms = sum(one["tested"] for one in own), sum(one["alarms"] for one in own)
    both = alarms + sum(one["back"] for one in own)
    rows = []
    for what, count in (("first alarms", alarms), ("and those that say that it is back", both)):
        low, high = Share(count, tested).interval(0.95)
        rate = count / tested / RATE if tested else math.nan
        rows.append(Row(
            f"quiet, all sizes: {what}, a robot in {1 / RATE:.0f} nights",
            f"{rate:.2f} [{low / RATE:.2f}, {high / RATE:.2f}] ({count} in {tested} nights)",
            f"{1 - BAND:g} to {1 + BAND:g}", abs(rate - 1.0) <= BAND,
        ))  # fmt: skip
    return rows if own else []


def main() -> int:
    """Run it; 0 if the bars are met."""
    given = given_options(robots=1000, seed=0, keep=Path, only=KINDS, calibrations=0)
    title = f"Drift of fleets, {given.robots} robots of each kind"
    found = list(campaign(given))
    return print_rows(title, pooled(found) + table(found))


if __name__ == "__main__":
    sys.exit(main())
