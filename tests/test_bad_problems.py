"""Problems, options and answers that are bad as a whole: the class of the error, and what it says."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from stated_input import EYE, X_TRUE, Y_TRUE, A, B, of_one, says, with_

import gtsam_rwhec as rw
from gtsam_rwhec import errors
from gtsam_rwhec.errors import (
    CountError,
    FrameError,
    OptionError,
    PoseError,
    PriorError,
    ScaleError,
    UnderdeterminedError,
)
from gtsam_rwhec.simulate import Noise, general

WHOLE: dict[str, tuple[Callable[[], rw.Problem], type[Exception], str]] = {
    "empty problem": (rw.Problem, CountError, "the problem is empty|problem.add("),
    "one measurement": (
        lambda: of_one(1),
        UnderdeterminedError,
        "tag0, cam0|1 measurements give 6 equations for 12 unknowns|measure more, or fix a frame",
    ),
    "two for 13 unknowns": (
        lambda: of_one(2, "shared"),
        UnderdeterminedError,
        "12 equations for 13 unknowns|measure more",
    ),
    "two for 13 unknowns, a scale each": (
        lambda: of_one(2, "per_target"),
        UnderdeterminedError,
        "12 equations for 13 unknowns",
    ),
    "one part too small": (
        lambda: with_(of_one(8), lambda p: p.add("tag1", "cam1", A[:1], B[:1])),
        UnderdeterminedError,
        "tag1, cam1|6 equations for 12",
    ),
    "a fixed frame that nobody saw": (
        lambda: with_(of_one(8), lambda p: p.fix("tag7", EYE)),
        FrameError,
        "'tag7' is fixed|no measurement mentions it|tag0, cam0",
    ),
    "a prior of a frame that nobody saw": (
        lambda: with_(of_one(8), lambda p: p.add_prior("cam7", EYE, sigma=1.0)),
        FrameError,
        "'cam7' is given a prior|tag0, cam0",
    ),
    "a size of a target that nobody saw": (
        lambda: with_(of_one(8, "per_target"), lambda p: p.fix_scale("tag7")),
        FrameError,
        "'tag7' is scaled|tag0, cam0",
    ),
    "a size of a sensor": (
        lambda: with_(of_one(8, "per_target"), lambda p: p.fix_scale("cam0")),
        ScaleError,
        "the scale of cam0|nothing measures cam0's size",
    ),
    "a fixed target of unknown size": (
        lambda: with_(of_one(8, "per_target"), lambda p: p.fix("tag0", X_TRUE)),
        PriorError,
        "tag0|fix the scale too (fix_scale)|add_prior",
    ),
}


@pytest.mark.parametrize("case", WHOLE)
@pytest.mark.parametrize(
    "call", [rw.solve, partial(rw.certify, X={"tag0": EYE}, Y={"cam0": EYE})], ids=["solve", "certify"]
)
def test_a_problem_that_cannot_be_solved_is_refused(case: str, call: Callable[[rw.Problem], Any]) -> None:
    make, error, said = WHOLE[case]
    problem = make()
    with says(error, said):
        call(problem)


NEGATIVE = r"the scale.* is -(1|0\.99999).* at the optimum.*frame convention"


@pytest.mark.parametrize(
    ("scale", "factor", "words"),
    [
        ("shared", -1.0, NEGATIVE),
        ("per_target", -1.0, NEGATIVE),
        ("shared", 0.0, r"the scale is -?[0-9.e-]+ at the optimum"),
    ],
)
def test_a_scale_that_is_not_positive_at_the_optimum_is_an_error(scale: Any, factor: float, words: str) -> None:
    """Lengths of the wrong sign, or a sensor that measures none: the best scale is -1 or 0, and there is no answer."""
    problem = rw.Problem(scale)
    wrong = B.copy()
    wrong[:, :3, 3] *= factor
    problem.add("tag0", "cam0", A, wrong, 0.01, 100.0)
    with pytest.raises(ScaleError, match=words):
        rw.solve(problem)


TRUE = ({"tag0": X_TRUE}, {"cam0": Y_TRUE}, 1.0)
SOLVE_OPTIONS: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "method": (dict(method="newton"), OptionError, "'newton'|'auto', 'sdp', 'local'"),
    "local without a start": (dict(method="local"), OptionError, "'local'|initial=(X, Y, scale)"),
    "a start for auto": (dict(method="auto", initial=TRUE), OptionError, "'auto'|for method='local'"),
    "a start without a frame": (
        dict(method="local", initial=({}, TRUE[1], 1.0)),
        FrameError,
        "X has no pose of 'tag0'|none",
    ),
    "a start without a sensor": (
        dict(method="local", initial=(TRUE[0], {"cam1": EYE}, 1.0)),
        FrameError,
        "Y has no pose of 'cam0'|'cam1'",
    ),
    "a start that is no pose": (
        dict(method="local", initial=({"tag0": 2.0 * EYE}, TRUE[1], 1.0)),
        PoseError,
        "X['tag0']|last row",
    ),
    "nonnegative scale of a known one": (
        dict(options=rw.SolveOptions(nonnegative_scale=True)),
        OptionError,
        "nonnegative_scale|'known'",
    ),
}


@pytest.mark.parametrize("case", SOLVE_OPTIONS)
def test_options_of_solve(case: str) -> None:
    arguments, error, said = SOLVE_OPTIONS[case]
    with says(error, said):
        rw.solve(of_one(8), **arguments)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("relative_tolerance", 0.0),
        ("relative_tolerance", np.nan),
        ("max_descent_iterations", -1),
        ("max_dense_frames", 0),
        ("random_starts", -1),
        ("relaxation_tolerance", np.inf),
    ],
)
def test_solver_options_are_checked(name: str, value: Any) -> None:
    with pytest.raises(OptionError, match=rf"SolveOptions\.{name}=.*must be positive and finite"):
        rw.SolveOptions(**{name: value})


ANSWERS: dict[str, tuple[Callable[[], rw.Problem], dict[str, Any], type[Exception], str]] = {
    "no target": (lambda: of_one(8), dict(X={}, Y=TRUE[1]), FrameError, "X has no pose of 'tag0'"),
    "no sensor": (lambda: of_one(8), dict(X=TRUE[0], Y={"tag0": EYE}), FrameError, "Y has no pose of 'cam0'|'tag0'"),
    "no pose": (lambda: of_one(8), dict(X=TRUE[0], Y={"cam0": np.eye(3)}), PoseError, "Y['cam0']|(3, 3)"),
    "a scale where it is known": (lambda: of_one(8), dict(X=TRUE[0], Y=TRUE[1], scale=0.5), ScaleError, "0.5|known"),
    "a negative scale": (
        lambda: of_one(8, "shared"),
        dict(X=TRUE[0], Y=TRUE[1], scale=-1.0),
        ScaleError,
        "-1.0|give a positive number",
    ),
    "scales by name for one scale": (
        lambda: of_one(8, "shared"),
        dict(X=TRUE[0], Y=TRUE[1], scale={"tag0": 1.0}),
        ScaleError,
        "{'tag0': 1.0}",
    ),
    "no scale of a target": (
        lambda: of_one(8, "per_target"),
        dict(X=TRUE[0], Y=TRUE[1], scale={"tag1": 1.0}),
        ScaleError,
        "tag0",
    ),
    "another scale than the fixed one": (
        lambda: with_(of_one(8, "per_target"), lambda p: p.fix_scale("tag0", 1.0)),
        dict(X=TRUE[0], Y=TRUE[1], scale={"tag0": 2.0}),
        ScaleError,
        "tag0|2.0|fixed at 1.0",
    ),
    "another pose than the fixed one": (
        lambda: with_(of_one(8), lambda p: p.fix("tag0", X_TRUE)),
        dict(X={"tag0": EYE}, Y=TRUE[1]),
        PriorError,
        "X['tag0']|fixed|apart",
    ),
}


@pytest.mark.parametrize("case", ANSWERS)
def test_answers_that_cannot_be_certified(case: str) -> None:
    make, answer, error, said = ANSWERS[case]
    with says(error, said):
        rw.certify(make(), **answer)


def test_a_frame_fixed_by_the_problem_need_not_be_given() -> None:
    problem = with_(of_one(8), lambda p: p.fix("tag0", X_TRUE))
    assert rw.certify(problem, X={}, Y=TRUE[1]).is_certified


def test_noise_warnings_reach_the_caller() -> None:
    problem = general(1, 1, seed=0, motion="planar", noise=Noise(0.01, 500.0)).problem
    with pytest.warns(errors.NotUniqueWarning, match="one axis only") as caught:
        rw.solve(problem)
    assert caught[0].filename == __file__
