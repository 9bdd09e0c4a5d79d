"""Conversions of covariances, against samples and against one another."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.geometry import pose_covariances as convert

GENERATOR = np.random.default_rng(5)
FACTOR = GENERATOR.standard_normal((6, 6)) * np.r_[np.full(3, 0.3), np.full(3, 2.0)][:, None]
COVARIANCE = 1e-6 * FACTOR @ FACTOR.T
T = gtsam.Pose3.Expmap(np.array([0.4, -1.1, 0.7, 2.0, -3.0, 0.5]))
S = gtsam.Pose3.Expmap(np.array([-0.9, 0.2, 1.3, -0.4, 0.6, 1.5]))


def sampled(function, count: int = 20_000) -> np.ndarray:
    """Covariance of function(xi) over samples of xi with COVARIANCE."""
    xi = np.random.default_rng(0).multivariate_normal(np.zeros(6), COVARIANCE, count)
    return np.cov(np.array([function(x) for x in xi]).T)


def close(got: np.ndarray, expected: np.ndarray) -> None:
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(got / scale, expected / scale, atol=0.04)  # 20,000 samples: 0.01 of one


def test_left_is_what_samples_say() -> None:
    inverse = T.inverse()
    close(sampled(lambda x: gtsam.Pose3.Logmap(T.retract(x).compose(inverse))), convert.left_of_right(T, COVARIANCE))


def test_inverse_is_what_samples_say() -> None:
    close(sampled(lambda x: gtsam.Pose3.Logmap(T.compose(T.retract(x).inverse()))), convert.of_inverse(T, COVARIANCE))


def test_composition_is_what_samples_say() -> None:
    whole = T.compose(S)
    close(
        sampled(lambda x: gtsam.Pose3.Logmap(whole.inverse().compose(T.retract(x).compose(S)))),
        convert.of_composition(S, COVARIANCE, np.zeros((6, 6))),
    )
    close(
        sampled(lambda x: gtsam.Pose3.Logmap(whole.inverse().compose(T.compose(S.retract(x))))),
        convert.of_composition(S, np.zeros((6, 6)), COVARIANCE),
    )


def test_ros_has_position_first_along_fixed_axes() -> None:
    def position_and_fixed_axis_rotation(x: np.ndarray) -> np.ndarray:
        noisy = T.retract(x)
        turned = noisy.rotation().compose(T.rotation().inverse())
        return np.r_[noisy.translation() - T.translation(), gtsam.Rot3.Logmap(turned)]

    close(sampled(position_and_fixed_axis_rotation), convert.ros_of_right(T, COVARIANCE))


def test_relative_jacobian_is_the_numerical_one() -> None:
    J = convert.relative_jacobian(T, S)
    relative = T.between(S)
    for column in range(12):
        xi = np.zeros(12)
        xi[column] = 1e-6
        moved = [T.retract(s * xi[:6]).between(S.retract(s * xi[6:])) for s in (1.0, -1.0)]
        ends = [gtsam.Pose3.Logmap(relative.inverse().compose(m)) for m in moved]
        np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, J[:, column], atol=1e-8)


def test_there_and_back() -> None:
    np.testing.assert_allclose(convert.right_of_left(T, convert.left_of_right(T, COVARIANCE)), COVARIANCE, rtol=1e-9)
    np.testing.assert_allclose(convert.right_of_ros(T, convert.ros_of_right(T, COVARIANCE)), COVARIANCE, rtol=1e-9)
    np.testing.assert_allclose(
        convert.of_inverse(T.inverse(), convert.of_inverse(T, COVARIANCE)), COVARIANCE, rtol=1e-9
    )


def test_standard_deviations_in_degrees_and_millimetres() -> None:
    degrees, millimetres = convert.standard_deviations(np.diag([1.0, 4.0, 9.0, 1e-6, 4e-6, 9e-6]))
    np.testing.assert_allclose(degrees, np.degrees([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(millimetres, [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("covariance", "words"),
    [
        (np.eye(3), "6 x 6"),
        (-np.eye(6), "has variances"),
        (np.diag([np.nan] * 6), "has variances"),
        (np.diag([np.inf, 1, 1, 1, 1, 1]), "infinite along a free direction"),
    ],
)
def test_invalid_covariances_are_refused(covariance: np.ndarray, words: str) -> None:
    with pytest.raises(rw.errors.NoiseError, match=words):
        convert.left_of_right(T, covariance)
