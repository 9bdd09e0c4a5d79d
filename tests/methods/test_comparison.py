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
from gtsam_rwhec.errors import CountError, FileFormatError, OptionError
from gtsam_rwhec.methods import METHODS, Comparison, compare, run
from gtsam_rwhec.methods.comparison import comparison_fields, write_comparison
from gtsam_rwhec.report.comparison_report import print_comparison

QUICK = ("shah2013", "wang2022", "dornaika1998", "lom", "certified", "zhuang1994")


def printed(comparison: Comparison, width: int = 160) -> str:
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
    """A and B inverted by mistake: the scale comes out negative, or all is free."""
    simulation = one_pair(monocular=True)
    raw = simulation.problem.measurements("camera", "marker")
    planar = rw.Problem("shared")
    planar.add("camera", "marker", raw.A[:4], np.linalg.inv(raw.B[:4]), 0.01, 125.0)
    result = compare(planar, methods=["lom", "certified"])
    if result.solution is None:
        assert all(result.gap(row) is None for row in result.rows)
        assert str(result.error) in printed(result)
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


@pytest.mark.parametrize("width", [40, 80, 200])
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
