"""How often ``rw.results.difference`` and ``verify`` say that something changed: where nothing did, and where it did.

    python benchmarks/changes.py [--runs 1000] [--seed 0] [--workers 1] [--keep FILE]

Pairs of logs of the same cell are simulated, each with its own motion and noise, and calibrated with ``rw.calibrate``,
``--runs`` pairs of each of four kinds of noise:

    white      on B alone
    carriers   on A too, which two sensors share at each stamp
    drift      on A and B, and of B's track: errors whose correlation from step to step is 0.9
    arm        on A and B, of an arm that is not built as its controller believes, the same one in both logs

Errors that vary with the configuration are modelled in the last kind alone, where there are such.

``difference`` compares both answers; ``verify`` tests the first one on the second log. For the power a frame of the
second log is moved by a number of joint deviations in a random direction, or all frames together, and the share that is
found is compared with that of the noncentral chi-square, which is of noise that is known. (Noise that is estimated from
60 measurements of a pair costs some three points. An arm's errors that vary with its configuration are in both
covariances although both logs share a part of them: there alarms are rarer, and power is lower.)

``--keep`` is a file of JSON lines to which every pair is added, and from which an interrupted campaign goes on. Exits
with 1 if a bar is missed.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from bars import Row, Share, each_done, keep_line, kept_lines, run_script
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtri
from scipy.stats import ncx2
from simulated_arms import ARM, BENT_RAD, Arm, moved_by, white

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.unknowns import Unknown
from gtsam_rwhec.results.change_test import change_test
from gtsam_rwhec.results.changed_frames import as_result, without_constant_errors
from gtsam_rwhec.results.common_quantities import Quantities, quantities
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.simulate.simulated_rigs import Motion, carrier_poses

FloatArray = NDArray[np.float64]
KINDS = ("white", "carriers", "drift", "arm")
#: In these the errors of both logs are independent.
INDEPENDENT = KINDS[:3]
LEVEL, BAND = 0.01, 0.005
#: Rotation (rad) and translation (m) about and along each axis.
OF_B = np.radians(0.1), 0.001
OF_A = np.radians(0.1), 0.001
DRIFT = np.radians(0.3), 0.003
#: By how much each of the arm's angles (rad) and lengths (m) is off; how far its joints move, rad.
MISBUILT, JOINTS = (np.radians(0.03), 2e-4), np.radians([25.0, 20.0, 20.0, 30.0, 30.0, 60.0])
#: The correlation of drift from one measurement to the next, and the measurements of each pair of frames.
CORRELATION, COUNT = 0.9, 60
#: A change of one frame, in its own joint deviations; the share that must be found, and how near the theory's.
DEVIATIONS, FOUND, NEAR = 4.5, 0.80, 0.05
#: A change of all frames is as large as is found with this probability.
POWER = 0.8
#: Of so many pairs one log is verified again with a frame that moved.
VERIFIED_MOVED = 4
PERIOD_NS = 100_000_000


def cell(kind: str, generator: np.random.Generator) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """True X and Y: one board and one camera, or two cameras that share the errors of A."""
    sensors = 2 if kind == "carriers" else 1
    X = {"board": random_poses(1, 1.0, generator)[0]}
    return X, {f"camera{i}": pose for i, pose in enumerate(random_poses(sensors, 0.3, generator))}


def log_of(
    kind: str, X: dict[str, FloatArray], Y: dict[str, FloatArray], arm: Arm, generator: np.random.Generator
) -> rw.Problem:
    """A log of the cell: a motion and errors of its own. ``arm`` is as it was built."""
    if kind == "arm":
        joints = BENT_RAD + JOINTS * generator.uniform(-1.0, 1.0, (COUNT, 6))
        path, told = (np.linalg.inv(each.hand(joints)) for each in (arm, ARM))
    else:
        path = told = np.linalg.inv(carrier_poses(Motion("general"), COUNT, generator))
    A = told if kind == "white" else moved_by(told, white(COUNT, *OF_A, generator))
    problem = rw.Problem()
    for target, T_target in X.items():
        for sensor, T_sensor in Y.items():
            errors = white(COUNT, *OF_B, generator)
            if kind == "drift":
                errors += correlated(white(COUNT, *DRIFT, generator))
            B = moved_by(np.linalg.inv(T_sensor) @ path @ T_target, errors)
            problem.add(target, sensor, A, B, stamps_ns=PERIOD_NS * np.arange(COUNT))
    return problem


def correlated(steps: FloatArray) -> FloatArray:
    """Errors (N, 6) of unit correlation in themselves and ``CORRELATION`` with their neighbours, of white steps."""
    errors = steps.copy()
    for i in range(1, len(errors)):
        errors[i] = CORRELATION * errors[i - 1] + np.sqrt(1.0 - CORRELATION**2) * steps[i]
    return errors


def run(kind: str, number: int, seed: int) -> dict[str, Any]:
    """One pair of logs: chances without a change, and whether changes are found."""
    generator = np.random.default_rng([seed, KINDS.index(kind), number])
    X, Y = cell(kind, generator)
    with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
        arm = ARM.misbuilt(*MISBUILT, generator)
        problems = [log_of(kind, X, Y, arm, generator) for _ in range(2)]
        # Nothing is misread, of another size or an outlier here, so none is looked for.
        options = rw.CalibrateOptions(systematic=kind == "arm", misreadings=False, sizes="known", robust="none")
        old, new = (rw.calibrate(problem, options) for problem in problems)
        if old.refined is None or new.refined is None:
            return {"kind": kind, "number": number, "answered": False}
        found = rw.results.difference(old, new)
        verified = rw.results.verify(old, problems[1], systematic=kind == "arm").test
    assert found.test is not None
    common = quantities(*(without_constant_errors(as_result(each)) for each in (old, new)))
    freedom = old.refined.degrees_of_freedom, new.refined.degrees_of_freedom
    result = {
        "kind": kind,
        "number": number,
        "answered": True,
        "dimension": found.test.dimension,
        "square": found.test.deviations**2,
        "freedom": found.test.degrees_of_freedom,
        "chance": found.test.chance,
        "joint": found.test.joint_chance,
        "verified": verified.chance,
        "verified_joint": verified.joint_chance,
        "verified_square": verified.deviations**2 / verified.dimension,
        "verdicts": [old.verdict.value, new.verdict.value],
    }
    frame = "camera0"
    rows = common.groups[frame]
    C = np.add(*common.covariances)
    root = np.linalg.cholesky(C)
    # The estimates are as good wherever the frames are: a frame that moved moves its estimate.
    one = np.zeros(len(C))
    one[rows] = DEVIATIONS * np.linalg.cholesky(C[rows, rows]) @ direction(6, generator)
    moved = change_test(common.difference + one, common.covariances, common.free, common.groups, freedom, LEVEL)
    only = subset(common, rows, common.difference + one)
    named = change_test(*only, {frame: slice(0, 6)}, freedom, LEVEL)
    everything = np.sqrt(noncentrality(found.test.dimension)) * root @ direction(len(C), generator)
    together = change_test(
        common.difference + everything, common.covariances, common.free, common.groups, freedom, LEVEL
    )
    if number % VERIFIED_MOVED == 0:
        with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
            turned = gtsam.Pose3.Expmap(one[rows] * unit_of(old, frame)).matrix()
            again = rw.results.verify(old, with_moved(problems[1], frame, turned), systematic=kind == "arm")
        result["verified_one"], result["verified_named"] = not again.holds, again.test.changed == (frame,)
    return result | {
        "one": moved.has_changed,
        "one_expected": float(ncx2.sf(chdtri(len(C), LEVEL), len(C), one @ np.linalg.solve(C, one))),
        "one_named": moved.changed == (frame,),
        "frame": named.has_changed,
        "together": together.has_changed,
        "together_joint": together.joint_chance < LEVEL,
    }


def unit_of(calibration: rw.Calibration, frame: str) -> FloatArray:
    """The units (6,) in which a frame's rows are compared."""
    assert calibration.refined is not None
    joint = calibration.refined.joint
    return joint.unit[joint.rows((Unknown.of(frame),))]


def with_moved(problem: rw.Problem, sensor: str, T: FloatArray) -> rw.Problem:
    """The log that a sensor would have recorded after Y T took the place of its Y: B becomes T^-1 B."""
    moved = rw.Problem()
    for pair in problem.pairs:
        one = problem.measurements(*pair)
        B = np.linalg.inv(T) @ one.B if pair.sensor == sensor else one.B
        moved.add(*pair, one.A, B, stamps_ns=one.stamps_ns)
    return moved


def subset(common: Quantities, rows: slice, difference: FloatArray) -> tuple[Any, ...]:
    """The arguments of the test of some rows."""
    first, second = common.covariances
    return difference[rows], (first[rows, rows], second[rows, rows]), common.free[rows]


def direction(size: int, generator: np.random.Generator) -> FloatArray:
    """A random unit vector."""
    drawn = generator.standard_normal(size)
    return drawn / np.linalg.norm(drawn)


def noncentrality(dimension: int) -> float:
    """That which a chi-square test at the level finds with probability ``POWER``."""
    limit = chdtri(dimension, LEVEL)
    return float(brentq(lambda at: ncx2.sf(limit, dimension, at) - POWER, 1.0, 200.0))


def runs_of(runs: int, seed: int, workers: int, keep: Path | None) -> Iterator[dict[str, Any]]:
    """All pairs of all kinds: those of the file, then those that it lacks, which are added to it."""
    kept = [one for one in kept_lines(keep) if one["seed"] == seed and one["number"] < runs]
    yield from kept
    done = {(one["kind"], one["number"]) for one in kept}
    missing = [(kind, i, seed) for i in range(runs) for kind in KINDS if (kind, i) not in done]
    for _, found in each_done(run, missing, workers, "pairs"):
        one = found | {"seed": seed}
        keep_line(keep, one)
        yield one


def rows(runs: int, seed: int, workers: int, keep: Path | None) -> list[Row]:
    """The shares against the bars."""
    found = list(runs_of(runs, seed, workers, keep))
    answered = [one for one in found if one["answered"]]
    result = [Row("pairs of logs", f"{len(found)}, {len(answered)} with covariances")]
    for kind in ("", *KINDS):
        own = [one for one in answered if kind in ("", one["kind"])]
        alarms = Share.of([one["chance"] < LEVEL for one in own])
        joint = Share.of([one["joint"] < LEVEL for one in own])
        squares = np.mean([one["square"] / one["dimension"] for one in own]) if own else np.nan
        what = f"false alarms at {100 * LEVEL:g} %" if not kind else f"    {kind}"
        words = f"{alarms}; joint statistic alone {joint}; mean square over dimension {squares:.3f}"
        met = None if kind else abs(alarms.value - LEVEL) <= BAND
        bar = "" if kind else f"{100 * LEVEL:g} +- {100 * BAND:g} %"
        result.append(Row(what.replace("false", "diff: false"), words, bar, met))
        verified = Share.of([one["verified"] < LEVEL for one in own])
        joint = Share.of([one["verified_joint"] < LEVEL for one in own])
        squares = np.mean([one["verified_square"] for one in own]) if own else np.nan
        words = f"{verified}; joint statistic alone {joint}; mean square over dimension {squares:.3f}"
        met = None if kind else abs(verified.value - LEVEL) <= BAND
        result.append(Row(what.replace("false", "verify: false") + " of verify" * bool(kind), words, bar, met))
    frame = Share.of([one["frame"] for one in answered])
    theory = float(ncx2.sf(chdtri(6, LEVEL), 6, DEVIATIONS**2))
    is_near = abs(frame.value - theory) <= NEAR and frame.value >= FOUND
    result.append(
        Row(
            f"diff: one frame moved {DEVIATIONS} joint deviations, tested by itself",
            f"{frame}; noncentral chi-square {100 * theory:.1f} %",
            f">= {100 * FOUND:g} %, within {100 * NEAR:g} points",
            is_near,
        )
    )
    for kind in KINDS:
        own = [one for one in answered if one["kind"] == kind]
        one_of = Share.of([one["one"] for one in own])
        theory = float(np.mean([one["one_expected"] for one in own]))
        right = Share.of([one["one_named"] for one in own if one["one"]])
        result.append(
            Row(
                f"    {kind}: the same, tested with the whole cell",
                f"{one_of}; noncentral chi-square of the joint statistic {100 * theory:.1f} %; frame named {right}",
            )
        )
    # The errors that vary with an arm's configuration are in both covariances, and partly the same in both logs.
    for kind in ("", *KINDS):
        own = [one for one in answered if one["kind"] in ((kind,) if kind else INDEPENDENT)]
        together = Share.of([one["together"] for one in own])
        joint = Share.of([one["together_joint"] for one in own])
        result.append(
            Row(
                f"    {kind}" if kind else f"diff: all frames moved, in {', '.join(INDEPENDENT)}",
                f"{together}; joint statistic alone {joint}; noncentral chi-square {100 * POWER:g} %",
                "" if kind else f"within {100 * NEAR:g} points",
                None if kind else abs(together.value - POWER) <= NEAR,
            )
        )
    own = [one for one in answered if "verified_one" in one]
    moved = Share.of([one["verified_one"] for one in own])
    right = Share.of([one["verified_named"] for one in own if one["verified_one"]])
    theory = float(np.mean([one["one_expected"] for one in own]))
    result.append(
        Row(
            f"verify: one frame moved {DEVIATIONS} joint deviations in the new log, all tested",
            f"{moved}; noncentral chi-square of the joint statistic {100 * theory:.1f} %; frame named {right}",
            f"not {100 * NEAR:g} points below",
            moved.value >= theory - NEAR,
        )
    )
    return result


if __name__ == "__main__":
    run_script("Changes, {runs} pairs of logs of each kind", rows, runs=1000, seed=0, workers=1, keep=Path)
