"""Bad input: the class of the error, and a message with the place, the value and what to do. Nothing half done."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from rwhec_factors.se3 import pose
from stated_input import EYE, ROWS, X_TRUE, Y_TRUE, A, B, says

import gtsam_rwhec as rw
from gtsam_rwhec import errors
from gtsam_rwhec.errors import (
    CountError,
    FrameError,
    NoiseError,
    OptionError,
    PoseError,
    PriorError,
    ScaleError,
    StampError,
)


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
BAD: dict[str, tuple[Callable[[rw.Problem], Any], type[Exception], str]] = {
    "NaN in A": (
        add(spoilt(A, (3, 0, 1), np.nan), B),
        PoseError,
        "A of tag0-cam0 (log.csv)|measurement 3|nan|leave the measurement out",
    ),
    "NaN in a translation of B": (add(A, spoilt(B, (0, 2, 3), np.nan)), PoseError, "B of tag0-cam0|measurement 0|nan"),
    "infinite entry": (add(spoilt(A, (7, 1, 3), -np.inf), B), PoseError, "A of tag0-cam0|measurement 7|-inf"),
    "too large to square": (
        add(spoilt(A, (3, 0, 3), 1e200), B),
        PoseError,
        "A of tag0-cam0|measurement 3|too large|e+200",
    ),
    "NaN in a row": (
        add(spoilt(ROWS, (2, 6), np.nan), ROWS, order="wxyz"),
        PoseError,
        "A of tag0-cam0|measurement 2|nan",
    ),
    "not a rotation": (
        add(A, spoilt(B, (5, 1, 1), 3.0)),
        PoseError,
        "B of tag0-cam0|measurement 5|is off by|0.001|check",
    ),
    "zero rotation": (
        add(A, spoilt(B, (5, slice(3), slice(3)), 0.0)),
        PoseError,
        "B of tag0-cam0|measurement 5|off by 1",
    ),
    "left-handed": (
        add(mirrored(), B),
        PoseError,
        "A of tag0-cam0|measurement 4|left-handed|-1.000000|check the axis convention",
    ),
    "transposed": (add(A.transpose(0, 2, 1), B), PoseError, "A of tag0-cam0|last row of measurement|transposed?"),
    "zero quaternion": (
        add(ROWS, spoilt(ROWS, (6, slice(4)), 0.0), order="wxyz"),
        PoseError,
        "B of tag0-cam0|measurement 6|norm 0|normalise it, or check",
    ),
    "quaternion of norm 2": (add(2.0 * ROWS, ROWS, order="wxyz"), PoseError, "A of tag0-cam0|measurement 0|norm 2"),
    "order not named": (add(ROWS, ROWS), PoseError, "A of tag0-cam0|None|order='wxyz' or order='xyzw'"),
    "order unknown": (add(ROWS, ROWS, order="wzyx"), PoseError, "A of tag0-cam0|'wzyx'"),
    "order of matrices": (add(A, B, order="wxyz"), PoseError, "A of tag0-cam0|order='wxyz'|leave order out"),
    "shape (N, 3, 3)": (add(A[:, :3, :3], B), PoseError, "A of tag0-cam0|(8, 3, 3)|(N, 4, 4), (N, 7)"),
    "shape (N, 6)": (add(A, ROWS[:, :6]), PoseError, "B of tag0-cam0|(8, 6)"),
    "ragged": (add([[1.0, 2.0], [3.0]], B), PoseError, "A of tag0-cam0|cannot be read as numbers|give (N,4,4)"),
    "text": (add([["a"] * 7], B), PoseError, "A of tag0-cam0|'a'"),
    "masked": (add(np.ma.masked_greater(A, 0.9), B), PoseError, "A of tag0-cam0|masked|leave masked measurements out"),
    "complex": (add(A, B.astype(complex)), PoseError, "B of tag0-cam0|complex|give real numbers"),
    "two kinds in a list": (add([gtsam.Pose3(), EYE], B), PoseError, "A of tag0-cam0|entry 1|ndarray|one kind of pose"),
    "different counts": (add(A, B[:7]), CountError, "tag0-cam0 (log.csv)|8 poses in A and 7 in B|pairs"),
    "empty edge": (add(A[:0], B[:0]), CountError, "tag0-cam0|no measurements|leave the pair out"),
    "empty lists": (add([], []), CountError, "tag0-cam0|no measurements"),
    "sigma of zero": (add(A, B, sigma=0.0), NoiseError, "tag0-cam0|sigma is 0.0|must be positive and finite"),
    "negative sigma": (
        add(A, B, sigma=spoilt(np.ones(8), 3, -2.0)),
        NoiseError,
        "tag0-cam0|sigma of measurement 3 is -2.0|must be positive",
    ),
    "kappa of NaN": (
        add(A, B, kappa=spoilt(np.ones(8), 7, np.nan)),
        NoiseError,
        "tag0-cam0|kappa of measurement 7 is nan",
    ),
    "infinite kappa": (add(A, B, kappa=np.inf), NoiseError, "tag0-cam0|kappa is inf"),
    "sigma of text": (add(A, B, sigma="1 cm"), NoiseError, "tag0-cam0|'1 cm'|give a number"),
    "count of sigma": (add(A, B, sigma=np.ones(7)), CountError, "tag0-cam0|sigma has shape (7,)|one for each of 8"),
    "count of kappa": (
        add(A, B, kappa=np.ones((8, 1))),
        CountError,
        "tag0-cam0|kappa has shape (8, 1)|one for each of 8",
    ),
    "stamps that go back": (
        add(A, B, stamps_ns=[0, 1, 2, 5, 4, 6, 7, 8]),
        StampError,
        "tag0-cam0|stamp 4 (4 ns) is before|(5 ns)|Sort",
    ),
    "count of stamps": (add(A, B, stamps_ns=[1, 2]), CountError, "tag0-cam0|(2,)|8"),
    "stamps in seconds": (add(A, B, stamps_ns=np.arange(8) * 0.1), CountError, "tag0-cam0|float64|integer nanoseconds"),
    "shape of covariances": (add(A, B, covariances=np.eye(3)), CountError, "tag0-cam0|(3, 3)|give (6, 6) or (8, 6, 6)"),
    "indefinite covariance": (
        add(A, B, covariances=np.array([COVARIANCE] * 6 + [-COVARIANCE, COVARIANCE])),
        NoiseError,
        "tag0-cam0|covariance of measurement 6|-1|give",
    ),
    "asymmetric covariance": (
        add(A, B, covariances=COVARIANCE + np.eye(6, k=1)),
        NoiseError,
        "tag0-cam0|covariance of measurement 0|symmetric",
    ),
    "covariance of NaN": (
        add(A, B, covariances=np.nan * COVARIANCE),
        NoiseError,
        "tag0-cam0|covariance of measurement 0|finite",
    ),
    "a target named as a sensor": (
        lambda p: p.add("cam0", "cam1", A, B),
        FrameError,
        "'cam0' is a sensor already|names are unique",
    ),
    "a sensor named as a target": (lambda p: p.add("tag1", "tag0", A, B), FrameError, "'tag0' is a target already"),
    "one name for both": (lambda p: p.add("tag1", "tag1", A, B), FrameError, "'tag1'|target and as sensor|unique"),
    "motions of a target": (lambda p: p.add_motion("tag0", A, B), FrameError, "'tag0' is a target|only sensors"),
    "empty name": (lambda p: p.add("", "cam0", A, B), FrameError, "target's name is ''|give a string"),
    "a number as a name": (lambda p: p.add("tag0", 3, A, B), FrameError, "sensor's name is 3"),
    "bad motions": (
        lambda p: p.add_motion("cam0", A, spoilt(B, (1, 0, 0), np.nan)),
        PoseError,
        "B of the motions of cam0|measurement 1|nan",
    ),
    "fixed at no pose": (
        lambda p: p.fix("cam0", np.diag([1.0, 1.0, -1.0, 1.0])),
        PoseError,
        "the pose at which cam0 is fixed|left-handed",
    ),
    "fixed at two poses": (
        lambda p: p.fix("cam0", A[:2]),
        PoseError,
        "the pose at which cam0 is fixed|2 poses where one is expected|give one",
    ),
    "fixed twice": (
        lambda p: p.fix("tag0", X_TRUE @ pose(np.eye(3), [0.0, 0.05, 0.0])),
        PriorError,
        "tag0 is fixed already|50 mm and 0 deg apart|remove one",
    ),
    "fixed against a prior": (
        lambda p: p.fix("cam0", pose(np.eye(3), [1.0, 0.0, 0.0]) @ Y_TRUE),
        PriorError,
        "cam0|1000 mm|100 mm",
    ),
    "a prior against a fixed frame": (
        lambda p: p.add_prior("tag0", pose(np.eye(3), [0.0, 0.5, 0.0]) @ X_TRUE, sigma=0.01),
        PriorError,
        "tag0|500 mm|10 mm",
    ),
    "priors that contradict in translation": (
        lambda p: p.add_prior("cam0", pose(np.eye(3), [2.0, 0.0, 0.0]) @ Y_TRUE, sigma=0.1),
        PriorError,
        "cam0|2000 mm|100 mm",
    ),
    "priors that contradict in rotation": (
        lambda p: p.add_prior("cam0", Y_TRUE @ pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)), kappa=200.0),
        PriorError,
        "cam0|180 deg apart|kappa of 100 and 200",
    ),
    "a prior without sigma and kappa": (
        lambda p: p.add_prior("cam0", Y_TRUE),
        PriorError,
        "the prior of cam0|neither sigma nor kappa|give sigma, kappa or both",
    ),
    "a prior of negative sigma": (
        lambda p: p.add_prior("cam0", Y_TRUE, sigma=-1.0),
        NoiseError,
        "the prior of cam0|sigma is -1.0",
    ),
    "a prior with many kappas": (
        lambda p: p.add_prior("cam0", Y_TRUE, kappa=[1.0, 2.0]),
        CountError,
        "the prior of cam0|kappa has shape (2,)|give one number",
    ),
    "a prior with no kappa in a list": (
        lambda p: p.add_prior("cam0", Y_TRUE, kappa=[]),
        CountError,
        "the prior of cam0|kappa has shape (0,)",
    ),
    "a known scale in a known problem": (
        lambda p: p.fix_scale("tag0", 2.0),
        ScaleError,
        "fix_scale('tag0')|scale='per_target'|'known'",
    ),
    "another scale mode joined": (lambda p: p + rw.Problem("shared"), OptionError, "'known'|'shared'|cannot join"),
    "names crossed when joining": (
        lambda p: p + crossed(),
        FrameError,
        "'cam0' is a target in one|sensor in the other|rename one",
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
    with says(error, said):
        call(problem)
    assert pickle.dumps(problem) == before


def test_a_refused_first_batch_leaves_no_trace() -> None:
    problem = rw.Problem("per_target")
    before = pickle.dumps(problem)
    with pytest.raises(PoseError):
        problem.add("tag0", "cam0", spoilt(A, (7, 0, 0), 9.0), B, 0.1, 1.0)
    assert pickle.dumps(problem) == before
    assert problem.targets == ()


def test_a_warning_made_an_error_leaves_no_trace() -> None:
    problem = stated()
    before = pickle.dumps(problem)
    with warnings.catch_warnings(action="error"):
        with pytest.raises(errors.UnitsWarning):
            problem.add("tag0", "cam0", A, spoilt(B, (slice(None), 0, 3), 500.0))
        with pytest.raises(errors.RotationsProjectedWarning):
            problem.add("tag0", "cam0", A.astype(np.float32), B)
    assert pickle.dumps(problem) == before


@pytest.mark.parametrize(
    ("scale", "said"), [("unknown", "'unknown'|'known', 'shared', 'per_target'"), (None, "None|'shared'")]
)
def test_a_scale_mode_that_is_none(scale: Any, said: str) -> None:
    with says(OptionError, said):
        rw.Problem(scale=scale)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf, "2"])
def test_scales_of_known_size_must_be_positive(scale: Any) -> None:
    problem = rw.Problem("per_target")
    with pytest.raises(ScaleError, match=r"the scale of tag0 is .*; give a positive number"):
        problem.fix_scale("tag0", scale)
    assert problem.fixed_scales == {}


@pytest.mark.parametrize("scale", [2, np.int64(2), np.float32(2.0), np.float64(2.0)])
def test_scales_of_known_size_are_any_number(scale: Any) -> None:
    problem = rw.Problem("per_target")
    problem.fix_scale("tag0", scale)
    assert problem.fixed_scales == {"tag0": 2.0}
    with pytest.raises(ScaleError, match=r"tag0 is fixed at 2\.0 already, and now at 3"):
        problem.fix_scale("tag0", 3.0)
