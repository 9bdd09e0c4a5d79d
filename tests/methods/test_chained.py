"""Methods for one pair on every pair of the best tree: the tree, what it avoids, and the gap to the joint answer."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from rich.console import Console

import gtsam_rwhec as rw
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import PoseLike
from gtsam_rwhec.methods.comparison import PAIR_SOLVERS, Comparison, chained, comparison_fields
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report.comparison_report import print_comparison
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(sigma_m=0.01, kappa=1250.0)
QUICK = ("shah2013", "li2010_dq", "certified", "lom")


def of_counts(counts: dict[tuple[str, str], int], noise: Noise | None = NOISE) -> tuple[rw.Problem, rw.Solution]:
    """Three targets and two sensors, with so many measurements of each pair."""
    whole = general(3, 2, seed=3, number_of_measurements=40, noise=noise).problem
    kept = {Pair(*pair): np.arange(40) < counts.get(tuple(pair), 0) for pair in whole.pairs}
    measurements = {pair: whole.measurements(*pair).selected(mask) for pair, mask in kept.items() if mask.any()}
    problem = whole.with_measurements(measurements)
    return problem, rw.solve(problem)


COUNTS = {
    ("target0", "sensor0"): 20, ("target0", "sensor1"): 40, ("target1", "sensor0"): 30, ("target1", "sensor1"): 10,
    ("target2", "sensor1"): 15,
}  # fmt: skip


def printed(comparison: Comparison) -> str:
    console = Console(file=io.StringIO(), width=200, highlight=False, no_color=True)
    print_comparison(comparison, console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def of_pair(problem: rw.Problem) -> tuple[PoseLike, PoseLike]:
    """A solver of one pair that is right: this library's."""
    ((target, sensor),) = problem.pairs
    solution = rw.solve(problem)
    return solution.X[target], solution.Y[sensor]


def test_the_tree_has_the_pairs_with_most_measurements() -> None:
    problem, solution = of_counts(COUNTS)
    found = chained("certified alone", of_pair, problem, solution)
    # From the heaviest pair on, always the heaviest that reaches a new frame.
    tree = [("target0", "sensor1"), ("target0", "sensor0"), ("target1", "sensor0"), ("target2", "sensor1")]
    assert found.tree == tuple(Pair(*pair) for pair in tree)
    assert (found.failed, found.unreached) == ({}, ())
    assert found.estimate is not None
    assert found.estimate.cost > solution.cost
    alone = rw.solve(problem.with_measurements({Pair(*tree[2]): problem.measurements(*tree[2])}))
    np.testing.assert_array_equal(found.X["target1"].matrix(), alone.X["target1"].matrix())
    off_m = [np.linalg.norm(solution.X[t].between(T).translation()) for t, T in found.X.items()]
    off_m += [np.linalg.norm(solution.Y[s].between(T).translation()) for s, T in found.Y.items()]
    assert found.off_mm == pytest.approx(1e3 * max(off_m))


def test_where_a_pair_fails_the_tree_avoids_it_and_frames_that_nothing_reaches_are_named() -> None:
    problem, solution = of_counts(COUNTS)

    def some(of: rw.Problem) -> tuple[PoseLike, PoseLike]:
        if of.pairs in ((Pair("target0", "sensor0"),), (Pair("target2", "sensor1"),)):
            raise UnderdeterminedError("not this one")
        return of_pair(of)

    found = chained("some", some, problem, solution)
    assert found.tree == tuple(
        Pair(*p) for p in (("target0", "sensor1"), ("target1", "sensor1"), ("target1", "sensor0"))
    )
    assert found.failed == {Pair(*p): "not this one" for p in (("target0", "sensor0"), ("target2", "sensor1"))}
    assert found.unreached == ("target2",)
    assert found.estimate is None
    assert "target2" not in found.X
    text = printed(Comparison((), solution, chained=(found,)))
    assert "some: the tree avoids target0-sensor0, target2-sensor1: not this one" in text
    assert "some: no pair that can be used has target2." in text


def test_pairs_that_are_not_determined_alone_are_in_no_tree() -> None:
    problem, _ = of_counts(COUNTS | {("target2", "sensor1"): 2, ("target2", "sensor0"): 12})
    result = rw.methods.compare(problem, methods=QUICK)
    assert result.undetermined == (Pair("target2", "sensor1"),)
    assert all(Pair("target2", "sensor1") not in row.tree for row in result.chained)
    assert "No tree takes target2-sensor1: their own measurements do not determine their frames." in printed(result)


def test_all_are_the_truth_without_noise_and_dearer_than_the_joint_answer_with_it() -> None:
    exact, joint = of_counts(COUNTS, None)
    result = rw.methods.compare(exact, methods=[*QUICK, *PAIR_SOLVERS])
    assert {row.method for row in result.chained} == {"shah2013", "li2010_dq", *PAIR_SOLVERS}
    for row in result.chained:
        assert row.off_mm < 1e-4, row.method
        assert row.off_deg < 1e-5, row.method
    noisy, joint = of_counts(COUNTS)
    result = rw.methods.compare(noisy, methods=[*QUICK, *PAIR_SOLVERS])
    costs = [row.estimate.cost for row in result.chained if row.estimate is not None]
    assert len(costs) == len(PAIR_SOLVERS) + 2
    assert costs == sorted(costs)
    assert costs[0] > 1.01 * joint.cost
    text = printed(result)
    for words in ("times joint", "off mm", "off°", f"{costs[0] / joint.cost:.3g}"):
        assert words in text
    fields = comparison_fields(result)
    assert json.loads(json.dumps(fields, allow_nan=False))["chained"][0]["cost"] == costs[0]


def test_one_pair_has_no_tree() -> None:
    pair = general(1, 1, seed=1, number_of_measurements=20, noise=NOISE).problem
    assert rw.methods.compare(pair, methods=QUICK).chained == ()


def test_the_real_dataset(utias_folder: object) -> None:
    """Pair by pair is far from what all say together: the reason for this library."""
    problem = rw.read_csv(str(utias_folder), "known", 1.0, 1.0)
    result = rw.methods.compare(problem, methods=("shah2013", "li2010_kronecker"))
    assert result.solution is not None
    assert 0 < len(result.undetermined) < len(problem.pairs)
    for row in result.chained:
        assert (len(row.tree), row.unreached) == (16 + 8 - 1, ())
        assert row.estimate is not None
        assert row.estimate.cost > 10.0 * result.solution.cost
        assert row.off_mm > 100.0
