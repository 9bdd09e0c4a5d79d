"""Priors on poses, scales and offsets, one of them on a pose that a time offset moves: residuals and Jacobians."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import S, X, Y
from hypothesis import given, settings
from hypothesis import strategies as st
from numeric_jacobians import check_jacobians, values_of
from rwhec_factors import (
    direction_prior_factor,
    dual_quaternion_prior_factor,
    hand_eye_factor,
    log_scale_prior_factor,
    pose_prior_factor,
    position_along_prior_factor,
    position_prior_factor,
    robot_world_hand_eye_factor,
    rotation_prior_factor,
    shifted_pose_prior_factor,
)

noiseModel = gtsam.noiseModel  # noqa: N816
SIGMAS = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
COVARIANCE = np.diag(SIGMAS**2) + 0.005
ISOTROPIC = np.repeat([0.1, 0.4], 3)
A_WEIGHT, B_WEIGHT = 3.0, 0.7
Make = Callable[[gtsam.Pose3], gtsam.CustomFactor]
#: Factor around a pose, and its rows' sigmas.
PRIORS: dict[str, tuple[Make, np.ndarray]] = {
    "pose": (lambda T: pose_prior_factor(X(0), T, noiseModel.Diagonal.Sigmas(SIGMAS)), SIGMAS),
    "pose, chordal": (
        lambda T: pose_prior_factor(X(0), T, noiseModel.Diagonal.Sigmas(ISOTROPIC), residual="chordal"),
        np.repeat([np.sqrt(2.0) * 0.1, 0.4], [9, 3]),
    ),
    "rotation": (
        lambda T: rotation_prior_factor(X(0), T.rotation(), noiseModel.Diagonal.Sigmas(SIGMAS[:3])),
        SIGMAS[:3],
    ),
    "rotation, chordal": (
        lambda T: rotation_prior_factor(X(0), T.rotation(), noiseModel.Isotropic.Sigma(3, 0.1), residual="chordal"),
        np.full(9, np.sqrt(2.0) * 0.1),
    ),
    "position": (
        lambda T: position_prior_factor(X(0), T.translation(), noiseModel.Diagonal.Sigmas(SIGMAS[3:])),
        SIGMAS[3:],
    ),
    "along": (
        lambda T: position_along_prior_factor(X(0), [1.0, 2.0, -1.0], AXIS @ T.translation(), 0.2),
        np.array([0.2]),
    ),
    "direction": (
        lambda T: direction_prior_factor(X(0), [1.0, 2.0, -1.0], T.rotation().rotate(AXIS), 0.2),
        np.full(2, 0.2),
    ),
    "dual quaternion": (lambda T: dual_quaternion_prior_factor(X(0), T, A_WEIGHT, B_WEIGHT), np.ones(8)),
    "dual quaternion, imaginary": (
        lambda T: dual_quaternion_prior_factor(X(0), T, A_WEIGHT, B_WEIGHT, rotation="imaginary"),
        np.ones(7),
    ),
}
AXIS = np.array([1.0, 2.0, -1.0]) / np.sqrt(6.0)


def pose(seed: int, size: float = 1.0) -> gtsam.Pose3:
    return gtsam.Pose3.Expmap(size * np.random.default_rng(seed).standard_normal(6))


def with_angle(seed: int, angle_rad: float) -> gtsam.Pose3:
    omega = np.random.default_rng(seed).standard_normal(3)
    return gtsam.Pose3(gtsam.Rot3.Expmap(angle_rad * omega / np.linalg.norm(omega)), pose(seed + 100).translation())


@pytest.mark.parametrize("size", [1.0, 0.1, 1e-6, 0.0, None], ids=str)
@pytest.mark.parametrize("name", PRIORS)
def test_jacobians_are_the_numeric_ones(name: str, size: float | None) -> None:
    """None: almost half a turn away."""
    make, sigmas = PRIORS[name]
    for seed in range(6):
        T_0 = pose(seed)
        T = T_0.compose(with_angle(seed, 3.0) if size is None else pose(seed + 50, 0.7 * size))
        check_jacobians(make(T_0), values_of({X(0): T}), sigmas, **({"atol": 1e-6} if size is None else {}))


@pytest.mark.parametrize("name", PRIORS)
@pytest.mark.parametrize("angle", [0.5, 2.0, 3.1])
def test_an_optimiser_reaches_the_prior(name: str, angle: float) -> None:
    T_0 = pose(2)
    factor = PRIORS[name][0](T_0)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    start = T_0.compose(with_angle(3, angle))
    # What the prior says nothing of stays where it is.
    graph.add(gtsam.PriorFactorPose3(X(0), start, noiseModel.Isotropic.Sigma(6, 1e4)))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values_of({X(0): start})).optimize()
    assert factor.error(result) < 1e-6


def test_pose_prior_is_gtsams_own() -> None:
    T_0, T = pose(3), pose(4)
    noise = noiseModel.Gaussian.Covariance(COVARIANCE)
    values = values_of({X(0): T})
    ours = pose_prior_factor(X(0), T_0, noise).error(values)
    residual = gtsam.Pose3.Logmap(T_0.between(T))
    assert ours == pytest.approx(0.5 * residual @ np.linalg.solve(COVARIANCE, residual), rel=1e-10)


def test_chordal_priors_are_the_certified_cost_terms() -> None:
    T_0, T = pose(5), pose(6)
    values = values_of({X(0): T})
    kappa, sigma = 0.5 / 0.1**2, 0.4
    rotation = 0.5 * kappa * np.sum((T.rotation().matrix() - T_0.rotation().matrix()) ** 2)
    position = 0.5 * np.sum((T.translation() - T_0.translation()) ** 2) / sigma**2
    assert PRIORS["pose, chordal"][0](T_0).error(values) == pytest.approx(rotation + position, rel=1e-12)
    assert PRIORS["rotation, chordal"][0](T_0).error(values) == pytest.approx(rotation, rel=1e-12)


def quaternion_product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Of [imaginary, scalar], the paper's order."""
    return np.append(p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3]), p[3] * q[3] - p[:3] @ q[:3])


def dual_quaternion(T: gtsam.Pose3) -> tuple[np.ndarray, np.ndarray]:
    """(q, q') of a pose, [imaginary, scalar]: q' = t q / 2."""
    q = T.rotation().toQuaternion().coeffs()
    return q, 0.5 * quaternion_product(np.append(T.translation(), 0.0), q)


def paper_prior(T_0: gtsam.Pose3, T: gtsam.Pose3, sign: float) -> tuple[float, float]:
    """Eqs. 25 and 26 from the deviation of eq. 27, with Q of either sign."""
    conjugate = np.array([-1.0, -1.0, -1.0, 1.0])
    (q_0, dual_0), (q, dual) = dual_quaternion(T_0), dual_quaternion(T)
    q, dual = sign * q, sign * dual
    dq = quaternion_product(conjugate * q_0, q)
    dq_dual = quaternion_product(conjugate * dual_0, q) + quaternion_product(conjugate * q_0, dual)
    G = np.diag([1.0, 1.0, 1.0, 0.0])
    one = np.array([0.0, 0.0, 0.0, 1.0])
    far = B_WEIGHT * dq_dual @ dq_dual
    return A_WEIGHT * (one - dq) @ (one - dq) + far, A_WEIGHT * dq @ G @ dq + far


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 3.14))
def test_dual_quaternion_prior_is_the_papers(seed: int, angle: float) -> None:
    T_0 = pose(seed)
    T = T_0.compose(with_angle(seed + 1, angle))
    values = values_of({X(0): T})
    # Q and -Q are one pose: eq. 25 must mean the nearer one, eq. 26 is the same for both.
    (near, imaginary), (far, imaginary_too) = (paper_prior(T_0, T, sign) for sign in (1.0, -1.0))
    assert imaginary == pytest.approx(imaginary_too, rel=1e-12)
    assert PRIORS["dual quaternion"][0](T_0).error(values) == pytest.approx(min(near, far), rel=1e-9, abs=1e-12)
    ours = PRIORS["dual quaternion, imaginary"][0](T_0).error(values)
    assert ours == pytest.approx(imaginary, rel=1e-9, abs=1e-12)


def test_dual_quaternion_weights_are_sigmas_near_the_prior() -> None:
    """a and b are sigmas of sqrt(2 / a) rad and sqrt(2 / b) m."""
    T_0 = pose(10)
    sigmas = np.repeat([np.sqrt(2.0 / A_WEIGHT), np.sqrt(2.0 / B_WEIGHT)], 3)
    for name in ("dual quaternion", "dual quaternion, imaginary"):
        J = PRIORS[name][0](T_0).linearize(values_of({X(0): T_0})).jacobian()[0]
        np.testing.assert_allclose(J.T @ J, np.diag(sigmas**-2.0), atol=1e-12)


def test_dual_quaternion_prior_is_blind_at_half_a_turn_only_when_imaginary() -> None:
    T_0 = pose(11)
    values = values_of({X(0): T_0.compose(gtsam.Pose3(gtsam.Rot3.Rx(np.pi - 1e-9), np.zeros(3)))})
    gradients = {}
    for name in ("dual quaternion", "dual quaternion, imaginary"):
        J, b = PRIORS[name][0](T_0).linearize(values).jacobian()
        gradients[name] = np.linalg.norm(J.T @ b)
    assert gradients["dual quaternion, imaginary"] < 1e-8
    assert gradients["dual quaternion"] > 0.4 * A_WEIGHT


@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-9, np.pi - 1e-4])
def test_a_direction_prior_leaves_the_opposite_direction(angle: float) -> None:
    T_0 = gtsam.Pose3(gtsam.Rot3.Rx(angle), np.array([1.0, 2.0, 3.0]))
    factor = direction_prior_factor(X(0), [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], 0.01)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    graph.add(gtsam.PriorFactorPose3(X(0), T_0, noiseModel.Isotropic.Sigma(6, 1e4)))
    values = values_of({X(0): T_0})
    np.testing.assert_allclose(np.linalg.norm(factor.unwhitenedError(values)), angle, atol=1e-9)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert factor.error(result) < 1e-6


def test_a_direction_prior_measures_the_angle_between_the_axes_and_ignores_turns_about_the_axis() -> None:
    factor = direction_prior_factor(X(0), [0.0, 0.0, 5.0], [0.0, 0.0, 2.0], 1.0)
    for tilt in (0.0, 0.3, 1.5, 3.0):
        for turn in (0.0, 1.0, -2.0):
            R = gtsam.Rot3.Rz(turn).compose(gtsam.Rot3.Rx(tilt)).compose(gtsam.Rot3.Rz(-0.4))
            error = factor.unwhitenedError(values_of({X(0): gtsam.Pose3(R, np.zeros(3))}))
            np.testing.assert_allclose(np.linalg.norm(error), tilt, atol=1e-12)


@pytest.mark.parametrize("scale", [0.4, 1.0, 3.0])
def test_log_scale_prior(scale: float) -> None:
    factor = log_scale_prior_factor(S(0), 0.8, 0.01)
    values = values_of({S(0): scale})
    check_jacobians(factor, values, np.array([0.01]))
    assert factor.error(values) == pytest.approx(0.5 * (np.log(scale / 0.8) / 0.01) ** 2)


@pytest.mark.parametrize("scale", [0.0, -0.3, np.nan])
def test_a_scale_without_logarithm_is_a_clear_error(scale: float) -> None:
    factor = log_scale_prior_factor(S(0), 1.0, 0.01)
    with pytest.raises(ValueError, match=rf"the scale s0 is {scale}; it must be positive"):
        factor.error(values_of({S(0): scale}))


def four_axis_robot(generator: np.random.Generator) -> gtsam.NonlinearFactorGraph:
    """Motions about z and along all three axes, A Y = Y B, without noise."""
    graph = gtsam.NonlinearFactorGraph()
    for _ in range(15):
        A = gtsam.Pose3(gtsam.Rot3.Rz(generator.uniform(-2.0, 2.0)), generator.uniform(-0.5, 0.5, 3))
        B = MOUNTING.inverse().compose(A).compose(MOUNTING)
        graph.add(hand_eye_factor(Y(0), A, B, noiseModel.Isotropic.Sigma(6, 0.01)))
    return graph


MOUNTING = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.0), np.array([0.1, -0.05, 0.4]))


def information(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> np.ndarray:
    return graph.linearize(values).hessian()[0]


def test_a_known_height_determines_what_a_four_axis_robot_leaves_free() -> None:
    graph = four_axis_robot(np.random.default_rng(12))
    truth = values_of({Y(0): MOUNTING})
    eigenvalues, eigenvectors = np.linalg.eigh(information(graph, truth))
    assert eigenvalues[0] < 1e-10 * eigenvalues[1]
    free = MOUNTING.rotation().rotate(eigenvectors[3:, 0])  # in the carrier's axes
    np.testing.assert_allclose(np.abs(np.r_[eigenvectors[:3, 0], free]), [0, 0, 0, 0, 0, 1], atol=1e-6)

    graph.add(position_along_prior_factor(Y(0), [0.0, 0.0, 1.0], 0.4, 0.002))
    start = values_of({Y(0): MOUNTING.compose(pose(13, 0.2))})
    result = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    assert result.atPose3(Y(0)).equals(MOUNTING, 1e-6)
    covariance = gtsam.Marginals(graph, result).marginalCovariance(Y(0))
    R = MOUNTING.rotation().matrix()
    assert np.sqrt((R @ covariance[3:, 3:] @ R.T)[2, 2]) == pytest.approx(0.002, rel=1e-6)


def test_a_known_rotation_determines_what_a_cartesian_robot_leaves_free() -> None:
    """Without turning the motion determines the rotation, but not the position, with or without a target."""
    generator = np.random.default_rng(14)
    T_target = pose(15)
    graph = gtsam.NonlinearFactorGraph()
    for _ in range(12):
        A = gtsam.Pose3(gtsam.Rot3(), np.r_[generator.uniform(-0.5, 0.5), 0.0, 0.0])  # a single rail
        B = MOUNTING.inverse().compose(A).compose(T_target)
        graph.add(robot_world_hand_eye_factor(X(0), Y(0), A, B, noiseModel.Isotropic.Sigma(6, 0.01)))
    truth = values_of({X(0): T_target, Y(0): MOUNTING})
    eigenvalues = np.linalg.eigvalsh(information(graph, truth))
    assert np.sum(eigenvalues < 1e-10 * eigenvalues[-1]) == 4  # the common position, and turning about the rail
    graph.add(rotation_prior_factor(Y(0), MOUNTING.rotation(), noiseModel.Isotropic.Sigma(3, 0.01)))
    eigenvalues = np.linalg.eigvalsh(information(graph, truth))
    assert np.sum(eigenvalues < 1e-10 * eigenvalues[-1]) == 3
    graph.add(position_prior_factor(Y(0), MOUNTING.translation(), noiseModel.Isotropic.Sigma(3, 0.01)))
    start = values_of({X(0): T_target.compose(pose(16, 0.1)), Y(0): MOUNTING.compose(pose(17, 0.1))})
    result = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    assert result.atPose3(Y(0)).equals(MOUNTING, 1e-6)
    assert result.atPose3(X(0)).equals(T_target, 1e-6)


def test_arguments_that_are_not_valid_are_refused() -> None:
    T, unit3, unit6 = gtsam.Pose3(), noiseModel.Unit.Create(3), noiseModel.Unit.Create(6)
    anisotropic = noiseModel.Diagonal.Sigmas(np.array([0.1, 0.1, 0.2]))
    cases: list[tuple[Callable[[], object], type[Exception], str]] = [
        (lambda: pose_prior_factor(X(0), T, unit3), ValueError, "dimension 3"),
        (lambda: pose_prior_factor(X(0), np.eye(4), unit6), TypeError, "ndarray"),
        (lambda: pose_prior_factor(X(0), T, unit6, residual="log"), ValueError, "'log'"),
        (
            lambda: pose_prior_factor(X(0), T, noiseModel.Diagonal.Sigmas(SIGMAS), residual="chordal"),
            ValueError,
            "geodesic",
        ),
        (lambda: rotation_prior_factor(X(0), T.rotation(), unit6), ValueError, "dimension 6"),
        (lambda: rotation_prior_factor(X(0), T, unit3), TypeError, "Rot3"),
        (lambda: rotation_prior_factor(X(0), T.rotation(), anisotropic, residual="chordal"), ValueError, "anisotropic"),
        (lambda: position_prior_factor(X(0), [1.0, 2.0], unit3), ValueError, "t_m is .*finite numbers of shape"),
        (lambda: position_prior_factor(X(0), [1.0, 2.0, np.nan], unit3), ValueError, "t_m is .*finite numbers"),
        (lambda: position_along_prior_factor(X(0), [0.0, 0.0, 0.0], 1.0, 1.0), ValueError, "no direction"),
        (lambda: position_along_prior_factor(X(0), [0.0, 0.0, 1.0], np.inf, 1.0), ValueError, "value_m is inf"),
        (lambda: position_along_prior_factor(X(0), [0.0, 0.0, 1.0], 1.0, 0.0), ValueError, "sigma_m is 0"),
        (lambda: direction_prior_factor(X(0), [0.0, 0.0, 1.0], [0.0] * 3, 1.0), ValueError, "axis_carrier"),
        (lambda: direction_prior_factor(X(0), [0.0, 0.0, 1.0], [1.0] * 3, -1.0), ValueError, "sigma_rad is -1"),
        (lambda: dual_quaternion_prior_factor(X(0), T, 0.0, 1.0), ValueError, "a is 0"),
        (lambda: dual_quaternion_prior_factor(X(0), T, 1.0, np.nan), ValueError, "b is nan"),
        (lambda: dual_quaternion_prior_factor(X(0), T, 1.0, 1.0, rotation="G"), ValueError, "'G'"),
        (lambda: log_scale_prior_factor(S(0), -1.0, 0.01), ValueError, "scale is -1"),
        (lambda: log_scale_prior_factor(S(0), 1.0, 0.0), ValueError, "sigma_log is 0"),
    ]
    for build, error, words in cases:
        with pytest.raises(error, match=words):
            build()


@pytest.mark.parametrize("name", PRIORS)
def test_a_missing_key_or_a_wrong_type_is_named(name: str) -> None:
    factor = PRIORS[name][0](pose(19))
    with pytest.raises(KeyError, match=r"x0 is not in the values; it should be .*Pose3"):
        factor.error(gtsam.Values())
    with pytest.raises(TypeError, match=r"x0 should be .*Pose3"):
        factor.error(values_of({X(0): 1.0}))


def test_a_scale_must_be_a_one_vector() -> None:
    factor = log_scale_prior_factor(S(0), 1.0, 0.01)
    with pytest.raises(KeyError, match=r"s0 is not in the values.*1-vector"):
        factor.error(gtsam.Values())
    values = gtsam.Values()
    values.insert(S(0), 1.0)
    with pytest.raises(TypeError, match=r"s0 should be .*1-vector.*not a float"):
        factor.error(values)


POSE, OFFSET = gtsam.symbol("p", 0), gtsam.symbol("d", 0)
NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]))
TWIST = np.array([0.4, -0.7, 0.2, 0.5, 0.1, -0.3])
numbers = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)


@given(numbers, numbers, st.floats(-0.3, 0.3))
def test_jacobians(measured: np.ndarray, off: np.ndarray, offset_s: float) -> None:
    T = gtsam.Pose3.Expmap(measured)
    factor = shifted_pose_prior_factor(POSE, OFFSET, T, TWIST, NOISE)
    check_jacobians(factor, values_of({POSE: T.retract(0.5 * off), OFFSET: offset_s}), NOISE.sigmas(), atol=1e-6)


def test_the_error_is_zero_at_the_shifted_pose() -> None:
    T = gtsam.Pose3.Expmap(np.array([0.3, 0.1, -0.2, 1.0, 2.0, 3.0]))
    then = T.compose(gtsam.Pose3.Expmap(0.05 * TWIST))
    factor = shifted_pose_prior_factor(POSE, OFFSET, T, TWIST, NOISE)
    assert factor.error(values_of({POSE: then, OFFSET: 0.05})) == pytest.approx(0.0, abs=1e-18)
    # Half of the noise's first component is 1/8, along the first axis only.
    off = then.retract(np.array([0.005, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert factor.error(values_of({POSE: off, OFFSET: 0.05})) == pytest.approx(0.125)


def test_bad_arguments() -> None:
    T = gtsam.Pose3()
    with pytest.raises(ValueError, match="twist"):
        shifted_pose_prior_factor(POSE, OFFSET, T, np.full(6, np.nan), NOISE)
    with pytest.raises(ValueError, match="6"):
        shifted_pose_prior_factor(POSE, OFFSET, T, TWIST, gtsam.noiseModel.Isotropic.Sigma(3, 1.0))
    with pytest.raises(TypeError, match="Pose3"):
        shifted_pose_prior_factor(POSE, OFFSET, np.eye(4), TWIST, NOISE)  # type: ignore[arg-type]
