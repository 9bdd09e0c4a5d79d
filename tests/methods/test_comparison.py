"""Methods side by side: who applies, gaps to the certified bound, the report and the file."""

from __future__ import annotations

import io
import json
import math
import re

import numpy as np
import pytest
from method_problems import four_targets, general_pair, one_pair
from rich.console import Console

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CountError, FileFormatError, OptionError, UnderdeterminedError
from gtsam_rwhec.geometry.poses import PoseLike
from gtsam_rwhec.methods import METHODS, compare, run
from gtsam_rwhec.methods.comparison import PAIR_SOLVERS, Comparison, chained, comparison_fields, write_comparison
from gtsam_rwhec.methods.comparison_report import print_comparison
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.simulate import Noise, general

QUICK = ("shah2013", "wang2022", "dornaika1998", "lom", "certified", "zhuang1994")


def printed(comparison: Comparison, width: int = 200) -> str:
    console = Console(file=io.StringIO(), width=width, highlight=False, no_color=True)
    print_comparison(comparison, console)
    text = console.file
    assert isinstance(text, io.StringIO)
    return text.getvalue()


def test_every_method_has_one_line_and_the_certified_one_is_first() -> None:
    problem = general_pair().problem
    called: list[str] = []
    result = compare(problem, progress=called.append)
    assert sorted(row.method.name for row in result.rows) == sorted(METHODS)
    assert called[0] == "certified"
    answers = [row for row in result.rows if row.estimate is not None]
    assert {row.method.name for row in answers} >= set(QUICK)
    assert answers[0].method.name == "certified"
    costs = [row.estimate.cost for row in answers if row.estimate is not None]
    assert costs == sorted(costs)
    for row in result.rows:
        assert (row.estimate is None) == (row.error is not None)


def test_gaps_are_those_of_certify() -> None:
    problem = general_pair().problem
    result = compare(problem, methods=QUICK)
    for row in result.rows:
        assert row.estimate is not None
        alone = rw.certify(problem, row.estimate.X, row.estimate.Y, row.estimate.scale)
        gap = result.gap(row)
        assert gap is not None
        assert gap == pytest.approx(alone.gap, rel=1e-6, abs=1e-6)
        assert result.is_optimal(row) == alone.is_optimal == (row.method.name == "certified")


def test_five_ways_to_the_minimum_with_all_weights_one_meet() -> None:
    """Penalties, a manifold, and three relaxations: of one cost, so the answers are one."""
    problem = general_pair().problem
    costs = [run(name, problem).cost for name in ("tabb2017_c1", "wise2020", "heller2014_matrix", "heller2014")]
    np.testing.assert_allclose(costs, run("dornaika1998", problem).cost, rtol=1e-5)


def test_residuals_are_pooled_over_measurements() -> None:
    problem = four_targets().problem
    row = next(row for row in compare(problem, methods=["wang2022"]).rows)
    estimate = run("wang2022", problem)
    squares, angles, count = 0.0, 0.0, 0
    for target, sensor in problem.pairs:
        raw = problem.measurements(target, sensor)
        left, right = raw.A @ estimate.X[target].matrix(), estimate.Y[sensor].matrix() @ raw.B
        squares += ((left - right)[:, :3, 3] ** 2).sum()
        chord = ((left - right)[:, :3, :3] ** 2).sum()
        angles += chord / 2.0
        count += len(left)
    assert row.translation_rms_m == pytest.approx(math.sqrt(squares / count), rel=1e-6)
    assert row.rotation_rms_rad == pytest.approx(math.sqrt(angles / count), rel=0.02)  # chords for angles


def test_without_a_certified_answer_there_is_no_gap_and_the_reason_is_said() -> None:
    """Lengths of the wrong sign: the scale comes out negative."""
    raw = one_pair(monocular=True).problem.measurements("camera", "marker")
    B = raw.B.copy()
    B[:, :3, 3] *= -1.0
    mirrored = rw.Problem("shared")
    mirrored.add("camera", "marker", raw.A, B, 0.01, 125.0)
    result = compare(mirrored, methods=["lom", "certified"])
    assert result.solution is None
    assert all(result.gap(row) is None for row in result.rows)
    assert "scale" in str(result.error)
    assert " ".join(str(result.error).split()) in " ".join(printed(result).split())
    assert comparison_fields(result)["lower_bound"] is None
    json.dumps(comparison_fields(result), allow_nan=False)


def test_report_has_a_line_for_each(tmp_path: object) -> None:
    result = compare(one_pair(monocular=True).problem)
    text = printed(result)
    for name in METHODS:
        assert len([line for line in text.splitlines() if re.match(rf" {name} |  - (\w+, )*{name}[,:]", line)]) == 1
    assert re.search(r"  - .*shah2013.*: this method takes scale='known'", text)
    assert "Certified globally optimal: the certified answer costs" in text
    assert "Started from wang2022's linear systems, with the scale: lom." in text


@pytest.mark.parametrize("width", [40, 80])
def test_report_fits_terminals(width: int) -> None:
    result = compare(general_pair().problem, methods=QUICK)
    console = Console(file=io.StringIO(), width=width, force_terminal=True, highlight=False, color_system=None)
    print_comparison(result, console)
    assert isinstance(console.file, io.StringIO)
    assert max(len(line) for line in console.file.getvalue().splitlines()) <= width


def test_file_has_every_number(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("comparison") / "comparison.json"
    simulation = four_targets()
    result = compare(simulation.problem, methods=("wang2022", "shah2013", "certified"))
    write_comparison(result, path)
    read = json.loads(path.read_text())
    assert read["format"] == "gtsam-rwhec comparison"
    rows = {row["method"]: row for row in read["methods"]}
    assert rows["shah2013"]["answer"] is None
    assert "4 targets" in rows["shah2013"]["reason"]
    wang = rows["wang2022"]["answer"]
    estimate = run("wang2022", simulation.problem)
    assert wang["cost"] == estimate.cost
    assert wang["targets"][2]["child"] == "camera2"
    np.testing.assert_array_equal(wang["targets"][2]["translation_m"], estimate.X["camera2"].translation())
    assert wang["gap"] == pytest.approx(wang["cost"] - read["lower_bound"])
    assert rows["certified"]["answer"]["is_optimal"]
    assert rows["certified"]["properties"]["multiple"] == "Xs and Ys"
    with pytest.raises(FileFormatError, match="cannot be written"):
        write_comparison(result, path.parent / "nowhere" / "comparison.json")


def test_bad_calls_are_refused() -> None:
    with pytest.raises(OptionError, match="'shah' is not one of"):
        compare(general_pair().problem, methods=["shah"])
    with pytest.raises(CountError, match="empty"):
        compare(rw.Problem())


NOISE = Noise(sigma_m=0.01, kappa=1250.0)
QUICK_CHAINED = ("shah2013", "li2010_dq", "certified", "lom")


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
    result = rw.methods.compare(problem, methods=QUICK_CHAINED)
    assert result.undetermined == (Pair("target2", "sensor1"),)
    assert all(Pair("target2", "sensor1") not in row.tree for row in result.chained)
    assert "No tree takes target2-sensor1: their own measurements do not determine their frames." in printed(result)


def test_all_are_the_truth_without_noise_and_dearer_than_the_joint_answer_with_it() -> None:
    exact, joint = of_counts(COUNTS, None)
    result = rw.methods.compare(exact, methods=[*QUICK_CHAINED, *PAIR_SOLVERS])
    assert {row.method for row in result.chained} == {"shah2013", "li2010_dq", *PAIR_SOLVERS}
    for row in result.chained:
        assert row.off_mm < 1e-4, row.method
        assert row.off_deg < 1e-5, row.method
    noisy, joint = of_counts(COUNTS)
    result = rw.methods.compare(noisy, methods=[*QUICK_CHAINED, *PAIR_SOLVERS])
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
    assert rw.methods.compare(pair, methods=QUICK_CHAINED).chained == ()


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
