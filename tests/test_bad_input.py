"""Bad input: the class of the error, and a message with the place, the value and what to do. Nothing half done."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import gtsam
import numpy as np
import pytest
from rwhec_factors.se3 import inverse, pose

import gtsam_rwhec as rw
from gtsam_rwhec import errors
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.simulate.transforms import random_poses

GENERATOR = np.random.default_rng(5)
X_TRUE, Y_TRUE = random_poses(2, 1.0, GENERATOR)
A = random_poses(8, 1.0, GENERATOR)
B = inverse(Y_TRUE) @ A @ X_TRUE
ROWS = np.concatenate([np.tile([1.0, 0.0, 0.0, 0.0], (8, 1)), A[:, :3, 3]], axis=1)
EYE = np.eye(4)


def stated() -> rw.Problem:
    """A good problem, which bad input must leave as it is."""
    problem = rw.Problem()
    problem.add("tag0", "cam0", A, B, 0.01, 100.0)
    problem.add_prior("cam0", Y_TRUE, sigma=0.1, kappa=100.0)
    problem.fix("tag0", X_TRUE)
    return problem


def spoilt(values: np.ndarray, index: Any, value: Any) -> np.ndarray:
    bad = values.copy()
    bad[index] = value
    return bad


def mirrored() -> np.ndarray:
    bad = A.copy()
    bad[4, :3, 0] *= -1.0
    return bad


def add(*arguments: Any, **options: Any) -> Callable[[rw.Problem], None]:
    return lambda problem: problem.add("tag0", "cam0", *arguments, **options, source="log.csv")


COVARIANCE = np.eye(6)

# What is said: the place, the value, and what to do.
BAD: dict[str, tuple[Callable[[rw.Problem], Any], type[Exception], list[str]]] = {
    "NaN in A": (
        add(spoilt(A, (3, 0, 1), np.nan), B),
        errors.PoseError,
        ["A of tag0-cam0 (log.csv)", "measurement 3", "nan", "leave the measurement out"],
    ),
    "NaN in a translation of B": (
        add(A, spoilt(B, (0, 2, 3), np.nan)),
        errors.PoseError,
        ["B of tag0-cam0", "measurement 0", "nan", "leave the measurement out"],
    ),
    "infinite entry": (
        add(spoilt(A, (7, 1, 3), -np.inf), B),
        errors.PoseError,
        ["A of tag0-cam0", "measurement 7", "-inf", "leave the measurement out"],
    ),
    "too large to square": (
        add(spoilt(A, (3, 0, 3), 1e200), B),
        errors.PoseError,
        ["A of tag0-cam0", "measurement 3", "too large", "e+200", "leave the measurement out"],
    ),
    "NaN in a row": (
        add(spoilt(ROWS, (2, 6), np.nan), ROWS, order="wxyz"),
        errors.PoseError,
        ["A of tag0-cam0", "measurement 2", "nan", "leave the measurement out"],
    ),
    "not a rotation": (
        add(A, spoilt(B, (5, 1, 1), 3.0)),
        errors.PoseError,
        ["B of tag0-cam0", "measurement 5", "is off by", "0.001", "check"],
    ),
    "zero rotation": (
        add(A, spoilt(B, (5, slice(3), slice(3)), 0.0)),
        errors.PoseError,
        ["B of tag0-cam0", "measurement 5", "off by 1", "check"],
    ),
    "left-handed": (
        add(mirrored(), B),
        errors.PoseError,
        ["A of tag0-cam0", "measurement 4", "left-handed", "-1.000000", "check the axis convention"],
    ),
    "transposed": (
        add(A.transpose(0, 2, 1), B),
        errors.PoseError,
        ["A of tag0-cam0", "last row of measurement", "transposed?"],
    ),
    "zero quaternion": (
        add(ROWS, spoilt(ROWS, (6, slice(4)), 0.0), order="wxyz"),
        errors.PoseError,
        ["B of tag0-cam0", "measurement 6", "norm 0", "normalise it, or check"],
    ),
    "quaternion of norm 2": (
        add(2.0 * ROWS, ROWS, order="wxyz"),
        errors.PoseError,
        ["A of tag0-cam0", "measurement 0", "norm 2", "normalise it, or check"],
    ),
    "order not named": (add(ROWS, ROWS), errors.PoseError, ["A of tag0-cam0", "None", "order='wxyz' or order='xyzw'"]),
    "order unknown": (
        add(ROWS, ROWS, order="wzyx"),
        errors.PoseError,
        ["A of tag0-cam0", "'wzyx'", "order='wxyz' or order='xyzw'"],
    ),
    "order of matrices": (
        add(A, B, order="wxyz"),
        errors.PoseError,
        ["A of tag0-cam0", "order='wxyz'", "leave order out"],
    ),
    "shape (N, 3, 3)": (add(A[:, :3, :3], B), errors.PoseError, ["A of tag0-cam0", "(8, 3, 3)", "(N, 4, 4), (N, 7)"]),
    "shape (N, 6)": (add(A, ROWS[:, :6]), errors.PoseError, ["B of tag0-cam0", "(8, 6)", "(N, 4, 4), (N, 7)"]),
    "ragged": (
        add([[1.0, 2.0], [3.0]], B),
        errors.PoseError,
        ["A of tag0-cam0", "cannot be read as numbers", "give (N,4,4)"],
    ),
    "text": (add([["a"] * 7], B), errors.PoseError, ["A of tag0-cam0", "'a'", "give (N,4,4)"]),
    "masked": (
        add(np.ma.masked_greater(A, 0.9), B),
        errors.PoseError,
        ["A of tag0-cam0", "masked", "leave masked measurements out"],
    ),
    "complex": (add(A, B.astype(complex)), errors.PoseError, ["B of tag0-cam0", "complex", "give real numbers"]),
    "two kinds in a list": (
        add([gtsam.Pose3(), EYE], B),
        errors.PoseError,
        ["A of tag0-cam0", "entry 1", "ndarray", "one kind of pose"],
    ),
    "different counts": (add(A, B[:7]), errors.CountError, ["tag0-cam0 (log.csv)", "8 poses in A and 7 in B", "pairs"]),
    "empty edge": (add(A[:0], B[:0]), errors.CountError, ["tag0-cam0", "no measurements", "leave the pair out"]),
    "empty lists": (add([], []), errors.CountError, ["tag0-cam0", "no measurements", "leave the pair out"]),
    "sigma of zero": (
        add(A, B, sigma=0.0),
        errors.NoiseError,
        ["tag0-cam0", "sigma is 0.0", "must be positive and finite"],
    ),
    "negative sigma": (
        add(A, B, sigma=spoilt(np.ones(8), 3, -2.0)),
        errors.NoiseError,
        ["tag0-cam0", "sigma of measurement 3 is -2.0", "must be positive"],
    ),
    "kappa of NaN": (
        add(A, B, kappa=spoilt(np.ones(8), 7, np.nan)),
        errors.NoiseError,
        ["tag0-cam0", "kappa of measurement 7 is nan", "must be positive"],
    ),
    "infinite kappa": (
        add(A, B, kappa=np.inf),
        errors.NoiseError,
        ["tag0-cam0", "kappa is inf", "must be positive and finite"],
    ),
    "sigma of text": (add(A, B, sigma="1 cm"), errors.NoiseError, ["tag0-cam0", "'1 cm'", "give a number"]),
    "count of sigma": (
        add(A, B, sigma=np.ones(7)),
        errors.CountError,
        ["tag0-cam0", "sigma has shape (7,)", "one for each of 8"],
    ),
    "count of kappa": (
        add(A, B, kappa=np.ones((8, 1))),
        errors.CountError,
        ["tag0-cam0", "kappa has shape (8, 1)", "one for each of 8"],
    ),
    "stamps that go back": (
        add(A, B, stamps_ns=[0, 1, 2, 5, 4, 6, 7, 8]),
        errors.StampError,
        ["tag0-cam0", "stamp 4 (4 ns) is before", "(5 ns)", "Sort"],
    ),
    "count of stamps": (add(A, B, stamps_ns=[1, 2]), errors.CountError, ["tag0-cam0", "(2,)", "8"]),
    "stamps in seconds": (
        add(A, B, stamps_ns=np.arange(8) * 0.1),
        errors.CountError,
        ["tag0-cam0", "float64", "integer nanoseconds"],
    ),
    "shape of covariances": (
        add(A, B, covariances=np.eye(3)),
        errors.CountError,
        ["tag0-cam0", "(3, 3)", "give (6, 6) or (8, 6, 6)"],
    ),
    "indefinite covariance": (
        add(A, B, covariances=np.array([COVARIANCE] * 6 + [-COVARIANCE, COVARIANCE])),
        errors.NoiseError,
        ["tag0-cam0", "covariance of measurement 6", "-1", "give"],
    ),
    "asymmetric covariance": (
        add(A, B, covariances=COVARIANCE + np.eye(6, k=1)),
        errors.NoiseError,
        ["tag0-cam0", "covariance of measurement 0", "symmetric", "give"],
    ),
    "covariance of NaN": (
        add(A, B, covariances=np.nan * COVARIANCE),
        errors.NoiseError,
        ["tag0-cam0", "covariance of measurement 0", "finite", "give"],
    ),
    "a target named as a sensor": (
        lambda p: p.add("cam0", "cam1", A, B),
        errors.FrameError,
        ["'cam0' is a sensor already", "names are unique"],
    ),
    "a sensor named as a target": (
        lambda p: p.add("tag1", "tag0", A, B),
        errors.FrameError,
        ["'tag0' is a target already", "names are unique"],
    ),
    "one name for both": (
        lambda p: p.add("tag1", "tag1", A, B),
        errors.FrameError,
        ["'tag1'", "target and as sensor", "unique"],
    ),
    "motions of a target": (
        lambda p: p.add_motion("tag0", A, B),
        errors.FrameError,
        ["'tag0' is a target", "only sensors"],
    ),
    "empty name": (lambda p: p.add("", "cam0", A, B), errors.FrameError, ["target's name is ''", "give a string"]),
    "a number as a name": (
        lambda p: p.add("tag0", 3, A, B),
        errors.FrameError,
        ["sensor's name is 3", "give a string"],
    ),
    "bad motions": (
        lambda p: p.add_motion("cam0", A, spoilt(B, (1, 0, 0), np.nan)),
        errors.PoseError,
        ["B of the motions of cam0", "measurement 1", "nan", "leave the measurement out"],
    ),
    "fixed at no pose": (
        lambda p: p.fix("cam0", np.diag([1.0, 1.0, -1.0, 1.0])),
        errors.PoseError,
        ["the pose at which cam0 is fixed", "left-handed", "check"],
    ),
    "fixed at two poses": (
        lambda p: p.fix("cam0", A[:2]),
        errors.PoseError,
        ["the pose at which cam0 is fixed", "2 poses where one is expected", "give one"],
    ),
    "fixed twice": (
        lambda p: p.fix("tag0", X_TRUE @ pose(np.eye(3), [0.0, 0.05, 0.0])),
        errors.PriorError,
        ["tag0 is fixed already", "50 mm and 0 deg apart", "remove one"],
    ),
    "fixed against a prior": (
        lambda p: p.fix("cam0", pose(np.eye(3), [1.0, 0.0, 0.0]) @ Y_TRUE),
        errors.PriorError,
        ["cam0", "1000 mm", "100 mm", "remove one"],
    ),
    "a prior against a fixed frame": (
        lambda p: p.add_prior("tag0", pose(np.eye(3), [0.0, 0.5, 0.0]) @ X_TRUE, sigma=0.01),
        errors.PriorError,
        ["tag0", "500 mm", "10 mm", "remove one"],
    ),
    "priors that contradict in translation": (
        lambda p: p.add_prior("cam0", pose(np.eye(3), [2.0, 0.0, 0.0]) @ Y_TRUE, sigma=0.1),
        errors.PriorError,
        ["cam0", "2000 mm", "100 mm", "remove one"],
    ),
    "priors that contradict in rotation": (
        lambda p: p.add_prior("cam0", Y_TRUE @ pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)), kappa=200.0),
        errors.PriorError,
        ["cam0", "180 deg apart", "kappa of 100 and 200", "remove one"],
    ),
    "a prior without sigma and kappa": (
        lambda p: p.add_prior("cam0", Y_TRUE),
        errors.PriorError,
        ["the prior of cam0", "neither sigma nor kappa", "give sigma, kappa or both"],
    ),
    "a prior of negative sigma": (
        lambda p: p.add_prior("cam0", Y_TRUE, sigma=-1.0),
        errors.NoiseError,
        ["the prior of cam0", "sigma is -1.0", "must be positive"],
    ),
    "a prior with many kappas": (
        lambda p: p.add_prior("cam0", Y_TRUE, kappa=[1.0, 2.0]),
        errors.CountError,
        ["the prior of cam0", "kappa has shape (2,)", "give one number"],
    ),
    "a prior with no kappa in a list": (
        lambda p: p.add_prior("cam0", Y_TRUE, kappa=[]),
        errors.CountError,
        ["the prior of cam0", "kappa has shape (0,)", "give one number"],
    ),
    "a known scale in a known problem": (
        lambda p: p.fix_scale("tag0", 2.0),
        errors.ScaleError,
        ["fix_scale('tag0')", "scale='per_target'", "'known'"],
    ),
    "another scale mode joined": (
        lambda p: p + rw.Problem("shared"),
        errors.OptionError,
        ["'known'", "'shared'", "cannot join"],
    ),
    "names crossed when joining": (
        lambda p: p + crossed(),
        errors.FrameError,
        ["'cam0' is a target in one", "sensor in the other", "rename one"],
    ),
}


def crossed() -> rw.Problem:
    problem = rw.Problem()
    problem.add("cam0", "tag0", A, B)
    return problem


@pytest.mark.parametrize("case", BAD)
def test_it_is_refused_with_place_value_and_advice_and_nothing_changes(case: str) -> None:
    call, error, said = BAD[case]
    problem = stated()
    before = pickle.dumps(problem)
    with pytest.raises(error) as caught:
        call(problem)
    assert isinstance(caught.value, errors.RwhecError)
    for words in said:
        assert words in str(caught.value)
    assert pickle.dumps(problem) == before


def test_a_refused_first_batch_leaves_no_trace() -> None:
    problem = rw.Problem("per_target")
    before = pickle.dumps(problem)
    with pytest.raises(errors.PoseError):
        problem.add("tag0", "cam0", spoilt(A, (7, 0, 0), 9.0), B, 0.1, 1.0)
    assert pickle.dumps(problem) == before
    assert problem.targets == ()


def test_a_warning_made_an_error_leaves_no_trace() -> None:
    problem = stated()
    before = pickle.dumps(problem)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(errors.UnitsWarning):
            problem.add("tag0", "cam0", A, spoilt(B, (slice(None), 0, 3), 500.0))
        with pytest.raises(errors.RotationsProjectedWarning):
            problem.add("tag0", "cam0", A.astype(np.float32), B)
    assert pickle.dumps(problem) == before


@pytest.mark.parametrize(
    ("scale", "said"), [("unknown", ["'unknown'", "'known', 'shared', 'per_target'"]), (None, ["None", "'shared'"])]
)
def test_a_scale_mode_that_is_none(scale: Any, said: list[str]) -> None:
    with pytest.raises(errors.OptionError) as caught:
        rw.Problem(scale=scale)
    for words in said:
        assert words in str(caught.value)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf, "2"])
def test_scales_of_known_size_must_be_positive(scale: Any) -> None:
    problem = rw.Problem("per_target")
    with pytest.raises(errors.ScaleError, match=r"the scale of tag0 is .*; give a positive number"):
        problem.fix_scale("tag0", scale)
    assert problem.fixed_scales == {}


@pytest.mark.parametrize("scale", [2, np.int64(2), np.float32(2.0), np.float64(2.0)])
def test_scales_of_known_size_are_any_number(scale: Any) -> None:
    problem = rw.Problem("per_target")
    problem.fix_scale("tag0", scale)
    assert problem.fixed_scales == {"tag0": 2.0}
    with pytest.raises(errors.ScaleError, match=r"tag0 is fixed at 2\.0 already, and now at 3"):
        problem.fix_scale("tag0", 3.0)


# -- what only the whole problem shows --------------------------------------------------------------


def of_one(count: int, scale: Any = "known") -> rw.Problem:
    problem = rw.Problem(scale)
    problem.add("tag0", "cam0", A[:count], B[:count], 0.01, 100.0)
    return problem


def with_(problem: rw.Problem, *calls: Callable[[rw.Problem], None]) -> rw.Problem:
    for call in calls:
        call(problem)
    return problem


WHOLE: dict[str, tuple[Callable[[], rw.Problem], type[Exception], list[str]]] = {
    "empty problem": (rw.Problem, errors.CountError, ["the problem is empty", "problem.add("]),
    "one measurement": (
        lambda: of_one(1),
        errors.UnderdeterminedError,
        ["tag0, cam0", "1 measurements give 6 equations for 12 unknowns", "measure more, or fix a frame"],
    ),
    "two for 13 unknowns": (
        lambda: of_one(2, "shared"),
        errors.UnderdeterminedError,
        ["12 equations for 13 unknowns", "measure more"],
    ),
    "two for 13 unknowns, a scale each": (
        lambda: of_one(2, "per_target"),
        errors.UnderdeterminedError,
        ["12 equations for 13 unknowns", "measure more"],
    ),
    "one part too small": (
        lambda: with_(of_one(8), lambda p: p.add("tag1", "cam1", A[:1], B[:1])),
        errors.UnderdeterminedError,
        ["tag1, cam1", "6 equations for 12", "measure more"],
    ),
    "a fixed frame that nobody saw": (
        lambda: with_(of_one(8), lambda p: p.fix("tag7", EYE)),
        errors.FrameError,
        ["'tag7' is fixed", "no measurement mentions it", "tag0, cam0"],
    ),
    "a prior of a frame that nobody saw": (
        lambda: with_(of_one(8), lambda p: p.add_prior("cam7", EYE, sigma=1.0)),
        errors.FrameError,
        ["'cam7' is given a prior", "tag0, cam0"],
    ),
    "a size of a target that nobody saw": (
        lambda: with_(of_one(8, "per_target"), lambda p: p.fix_scale("tag7")),
        errors.FrameError,
        ["'tag7' is scaled", "tag0, cam0"],
    ),
    "a size of a sensor": (
        lambda: with_(of_one(8, "per_target"), lambda p: p.fix_scale("cam0")),
        errors.ScaleError,
        ["the scale of cam0", "nothing measures cam0's size"],
    ),
    "a fixed target of unknown size": (
        lambda: with_(of_one(8, "per_target"), lambda p: p.fix("tag0", X_TRUE)),
        errors.PriorError,
        ["tag0", "fix the scale too (fix_scale)", "add_prior"],
    ),
}


@pytest.mark.parametrize("case", WHOLE)
@pytest.mark.parametrize(
    "call", [rw.solve, partial(rw.certify, X={"tag0": EYE}, Y={"cam0": EYE})], ids=["solve", "certify"]
)
def test_a_problem_that_cannot_be_solved_is_refused(case: str, call: Callable[[rw.Problem], Any]) -> None:
    make, error, said = WHOLE[case]
    problem = make()
    with pytest.raises(error) as caught:
        call(problem)
    for words in said:
        assert words in str(caught.value)


@pytest.mark.parametrize("scale", ["shared", "per_target"])
def test_a_negative_scale_at_the_optimum_is_an_error(scale: Any) -> None:
    """Lengths of the wrong sign: the best scale is -1, and no answer is returned."""
    problem = rw.Problem(scale)
    mirrored_B = B.copy()
    mirrored_B[:, :3, 3] *= -1.0
    problem.add("tag0", "cam0", A, mirrored_B, 0.01, 100.0)
    with pytest.raises(errors.ScaleError, match=r"the scale.* is -(1|0\.99999).* at the optimum.*frame convention"):
        rw.solve(problem)


def test_a_scale_of_zero_at_the_optimum_is_an_error() -> None:
    """A sensor that measures no lengths at all."""
    problem = rw.Problem("shared")
    flat = B.copy()
    flat[:, :3, 3] = 0.0
    problem.add("tag0", "cam0", A, flat, 0.01, 100.0)
    with pytest.raises(errors.ScaleError, match=r"the scale is -?[0-9.e-]+ at the optimum"):
        rw.solve(problem)


TRUE = ({"tag0": X_TRUE}, {"cam0": Y_TRUE}, 1.0)
SOLVE_OPTIONS: dict[str, tuple[dict[str, Any], type[Exception], list[str]]] = {
    "method": (dict(method="newton"), errors.OptionError, ["'newton'", "'auto', 'sdp', 'local'"]),
    "local without a start": (dict(method="local"), errors.OptionError, ["'local'", "initial=(X, Y, scale)"]),
    "a start for auto": (dict(method="auto", initial=TRUE), errors.OptionError, ["'auto'", "for method='local'"]),
    "a start without a frame": (
        dict(method="local", initial=({}, TRUE[1], 1.0)),
        errors.FrameError,
        ["X has no pose of 'tag0'", "none"],
    ),
    "a start without a sensor": (
        dict(method="local", initial=(TRUE[0], {"cam1": EYE}, 1.0)),
        errors.FrameError,
        ["Y has no pose of 'cam0'", "'cam1'"],
    ),
    "a start that is no pose": (
        dict(method="local", initial=({"tag0": 2.0 * EYE}, TRUE[1], 1.0)),
        errors.PoseError,
        ["X['tag0']", "last row"],
    ),
    "nonnegative scale of a known one": (
        dict(options=rw.SolveOptions(nonnegative_scale=True)),
        errors.OptionError,
        ["nonnegative_scale", "'known'"],
    ),
}


@pytest.mark.parametrize("case", SOLVE_OPTIONS)
def test_options_of_solve(case: str) -> None:
    arguments, error, said = SOLVE_OPTIONS[case]
    with pytest.raises(error) as caught:
        rw.solve(of_one(8), **arguments)
    for words in said:
        assert words in str(caught.value)


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
    with pytest.raises(errors.OptionError, match=rf"SolveOptions\.{name}=.*must be positive and finite"):
        rw.SolveOptions(**{name: value})


ANSWERS: dict[str, tuple[Callable[[], rw.Problem], dict[str, Any], type[Exception], list[str]]] = {
    "no target": (lambda: of_one(8), dict(X={}, Y=TRUE[1]), errors.FrameError, ["X has no pose of 'tag0'"]),
    "no sensor": (
        lambda: of_one(8),
        dict(X=TRUE[0], Y={"tag0": EYE}),
        errors.FrameError,
        ["Y has no pose of 'cam0'", "'tag0'"],
    ),
    "no pose": (lambda: of_one(8), dict(X=TRUE[0], Y={"cam0": np.eye(3)}), errors.PoseError, ["Y['cam0']", "(3, 3)"]),
    "a scale where it is known": (
        lambda: of_one(8),
        dict(X=TRUE[0], Y=TRUE[1], scale=0.5),
        errors.ScaleError,
        ["0.5", "known"],
    ),
    "a negative scale": (
        lambda: of_one(8, "shared"),
        dict(X=TRUE[0], Y=TRUE[1], scale=-1.0),
        errors.ScaleError,
        ["-1.0", "give a positive number"],
    ),
    "scales by name for one scale": (
        lambda: of_one(8, "shared"),
        dict(X=TRUE[0], Y=TRUE[1], scale={"tag0": 1.0}),
        errors.ScaleError,
        ["{'tag0': 1.0}", "give a positive number"],
    ),
    "no scale of a target": (
        lambda: of_one(8, "per_target"),
        dict(X=TRUE[0], Y=TRUE[1], scale={"tag1": 1.0}),
        errors.ScaleError,
        ["tag0", "give a positive number"],
    ),
    "another scale than the fixed one": (
        lambda: with_(of_one(8, "per_target"), lambda p: p.fix_scale("tag0", 1.0)),
        dict(X=TRUE[0], Y=TRUE[1], scale={"tag0": 2.0}),
        errors.ScaleError,
        ["tag0", "2.0", "fixed at 1.0"],
    ),
    "another pose than the fixed one": (
        lambda: with_(of_one(8), lambda p: p.fix("tag0", X_TRUE)),
        dict(X={"tag0": EYE}, Y=TRUE[1]),
        errors.PriorError,
        ["X['tag0']", "fixed", "apart"],
    ),
}


@pytest.mark.parametrize("case", ANSWERS)
def test_answers_that_cannot_be_certified(case: str) -> None:
    make, answer, error, said = ANSWERS[case]
    with pytest.raises(error) as caught:
        rw.certify(make(), **answer)
    for words in said:
        assert words in str(caught.value)


def test_a_frame_fixed_by_the_problem_need_not_be_given() -> None:
    problem = with_(of_one(8), lambda p: p.fix("tag0", X_TRUE))
    assert rw.certify(problem, X={}, Y=TRUE[1]).is_certified


def test_noise_warnings_reach_the_caller() -> None:
    problem = general(1, 1, seed=0, motion="planar", noise=Noise(0.01, 500.0)).problem
    with pytest.warns(errors.NotUniqueWarning, match="one axis only") as caught:
        rw.solve(problem)
    assert caught[0].filename == __file__
