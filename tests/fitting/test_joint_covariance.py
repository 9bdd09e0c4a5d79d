"""Covariances with free directions, against the limit of weak priors along them; how unknowns are named."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind, slots_of

A, B, SCALE = (Unknown.of(name) for name in ("a", "b", "scale"))


def information(seed: int, free: np.ndarray) -> np.ndarray:
    J = np.random.default_rng(seed).standard_normal((40, 13))
    if free.shape[1]:
        Q, _ = np.linalg.qr(free)
        J = J - J @ Q @ Q.T
    return J.T @ J


def test_without_free_directions_it_is_the_inverse() -> None:
    Lambda = information(0, np.zeros((13, 0)))
    joint = JointCovariance.of((A, B, SCALE), Lambda, np.zeros((13, 0)), np.ones(13))
    np.testing.assert_allclose(joint.covariance_of(np.eye(13)), np.linalg.inv(Lambda), rtol=1e-10)
    inverse = np.linalg.inv(Lambda)
    np.testing.assert_allclose(joint.covariance_of(joint.selector((B, SCALE))), inverse[6:, 6:], rtol=1e-10)
    np.testing.assert_allclose(joint.information_of((B,)), np.linalg.inv(inverse[6:12, 6:12]), rtol=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), axis=st.integers(0, 5), given_to_it=st.booleans())
def test_one_axis_of_one_frame_is_infinite_and_the_rest_is_the_limit(seed: int, axis: int, given_to_it: bool) -> None:
    """With the direction given or found as a zero of the information, in any units."""
    free = np.zeros((13, 1))
    free[axis] = 1.0
    Lambda = information(seed, free)
    told = free if given_to_it else np.zeros((13, 0))
    unit = np.random.default_rng(seed).uniform(0.1, 10.0, 13)
    joint = JointCovariance.of((A, B, SCALE), Lambda, told, unit)
    covariance = joint.covariance_of(np.eye(13))
    assert covariance[axis, axis] == np.inf
    rest = np.delete(np.arange(13), axis)
    expected = np.linalg.inv(Lambda[np.ix_(rest, rest)])
    np.testing.assert_allclose(covariance[np.ix_(rest, rest)], expected, rtol=1e-7, atol=1e-9)
    marginal = joint.information_of((A,))
    assert np.abs(marginal[axis]).max() < 1e-9
    limit = Lambda + 1e-9 * free @ free.T  # a prior so weak that it is none
    limit = np.linalg.inv(np.linalg.inv(limit)[:6, :6])
    if axis < 3:
        np.testing.assert_allclose(marginal, limit, atol=1e-4)
    else:  # displaced along it, a rotation's error moves the frame across it: no more is known than the limit says
        assert np.linalg.eigvalsh(limit - marginal)[0] > -1e-4


def test_frames_that_move_together_have_a_finite_difference() -> None:
    free = np.zeros((13, 1))
    free[5] = free[11] = 1.0
    joint = JointCovariance.of((A, B, SCALE), information(3, free), free, np.ones(13))
    both = joint.covariance_of(joint.selector((A, B)))
    assert both[5, 5] == both[11, 11] == both[5, 11] == np.inf
    assert np.isfinite(np.delete(np.delete(both, [5, 11], 0), [5, 11], 1)).all()
    difference = joint.selector((B,)) - joint.selector((A,))
    assert np.isfinite(joint.covariance_of(difference)).all()


def test_opposite_movements_have_minus_infinite_covariance() -> None:
    free = np.zeros((13, 1))
    free[5], free[11] = 1.0, -1.0
    joint = JointCovariance.of((A, B, SCALE), information(4, free), free, np.ones(13))
    assert joint.covariance_of(np.eye(13))[5, 11] == -np.inf


def test_information_from_noise_along_a_free_direction_is_ignored() -> None:
    free = np.zeros((13, 1))
    free[5] = 1.0
    Lambda = information(5, free) + 1e-3 * free @ free.T
    covariance = JointCovariance.of((A, B, SCALE), Lambda, free, np.ones(13)).covariance_of(np.eye(13))
    assert covariance[5, 5] == np.inf


def test_without_measurements_every_variance_is_infinite() -> None:
    joint = JointCovariance.of((A,), np.zeros((6, 6)), np.zeros((6, 0)), np.ones(6))
    np.testing.assert_array_equal(np.diag(joint.covariance_of(np.eye(6))), np.inf)
    np.testing.assert_allclose(joint.information_of((A,)), 0.0)


def test_unknown_names_are_refused() -> None:
    joint = JointCovariance.of((A,), np.eye(6), np.zeros((6, 0)), np.ones(6))
    with pytest.raises(rw.errors.FrameError, match="'b' is not among the unknowns; they are a"):
        joint.rows((B,))


@pytest.mark.parametrize(
    ("name", "unknown"),
    [
        ("cam_0", Unknown(UnknownKind.FRAME, "cam_0")),
        ("scale", Unknown(UnknownKind.SCALE)),
        ("scale:tag_0", Unknown(UnknownKind.SCALE, "tag_0")),
        ("time_offset:cam:left", Unknown(UnknownKind.TIME_OFFSET, "cam:left")),
        ("frame:x", Unknown(UnknownKind.FRAME, "frame:x")),
        ("time_offset", Unknown(UnknownKind.FRAME, "time_offset")),
    ],
)
def test_a_name_is_read_and_written_the_same(name: str, unknown: Unknown) -> None:
    assert Unknown.of(name) == unknown
    assert str(unknown) == name
    assert Unknown.of(unknown) is unknown


def test_parameters_stand_one_after_the_other() -> None:
    cam, scale, tag = (Unknown.of(name) for name in ("cam", "scale", "tag"))
    assert slots_of((cam, scale, tag)) == {cam: slice(0, 6), scale: slice(6, 7), tag: slice(7, 13)}
