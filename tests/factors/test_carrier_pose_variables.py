from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import P, S, X, Y
from numeric_jacobians import check_jacobians, values_of
from rwhec_factors import (
    hand_eye_factor,
    pose_hand_eye_factor,
    pose_robot_world_hand_eye_factor,
    robot_world_hand_eye_factor,
    two_pose_robot_world_hand_eye_factor,
)

NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.1, 0.1, 0.3, 0.3, 0.3]))
SIGMAS = {"geodesic": np.repeat([0.1, 0.3], 3), "chordal": np.repeat([np.sqrt(2.0) * 0.1, 0.3], [9, 3])}
INVERSE, STRAIGHT = "sensorcarrier_in_targetcarrier", "targetcarrier_in_sensorcarrier"
Make = Callable[..., gtsam.CustomFactor]
#: Factor from (B, noise, options), its pose keys in order, and B as those poses have it in true metres.
FACTORS: dict[str, tuple[Make, list[int], Callable[..., gtsam.Pose3]]] = {
    "pose": (
        lambda B, noise, **options: pose_robot_world_hand_eye_factor(P(0), X(0), Y(0), B, noise, **options),
        [P(0), X(0), Y(0)],
        lambda p, x, y: y.inverse().compose(p.inverse()).compose(x),
    ),
    "inverse pose": (
        lambda B, noise, **options: pose_robot_world_hand_eye_factor(
            P(0), X(0), Y(0), B, noise, pose=STRAIGHT, **options
        ),
        [P(0), X(0), Y(0)],
        lambda p, x, y: y.inverse().compose(p).compose(x),
    ),
    "two poses": (
        lambda B, noise, **options: two_pose_robot_world_hand_eye_factor(P(0), P(1), X(0), Y(0), B, noise, **options),
        [P(0), P(1), X(0), Y(0)],
        lambda s, t, x, y: y.inverse().compose(s.inverse()).compose(t).compose(x),
    ),
    "two poses of one carrier": (
        lambda B, noise, **options: pose_hand_eye_factor(P(0), P(1), Y(0), B, noise, **options),
        [P(0), P(1), Y(0)],
        lambda i, j, y: y.inverse().compose(i.inverse()).compose(j).compose(y),
    ),
    "hand-eye": (
        lambda B, noise, **options: hand_eye_factor(Y(0), MOTION, B, noise, **options),
        [Y(0)],
        lambda y: y.inverse().compose(MOTION).compose(y),
    ),
}
MOTION = gtsam.Pose3.Expmap(np.array([0.4, -0.7, 0.2, 0.5, 1.0, -0.8]))


def setting(
    name: str, seed: int, size: float, residual: str, scaled: bool, deviation: float = 1.0
) -> tuple[gtsam.CustomFactor, gtsam.Values, np.ndarray]:
    """A factor, values, and the right perturbation of B between them, of size ``deviation``."""
    generator = np.random.default_rng(seed)
    make, keys, predict = FACTORS[name]
    poses = [gtsam.Pose3.Expmap(size * generator.standard_normal(6)) for _ in keys]
    scale = 0.7 if scaled else 1.0
    predicted = predict(*poses)
    measured = gtsam.Pose3(predicted.rotation(), scale * predicted.translation())
    xi = deviation * size * generator.standard_normal(6)
    options: dict[str, Any] = {"residual": residual, **({"scale_key": S(0)} if scaled else {})}
    factor = make(measured.compose(gtsam.Pose3.Expmap(-xi)), NOISE, **options)
    return factor, values_of(dict(zip(keys, poses, strict=True)) | ({S(0): scale} if scaled else {})), xi


@pytest.mark.parametrize("scaled", [False, True], ids=["true size", "scaled"])
@pytest.mark.parametrize("residual", ["geodesic", "chordal"])
@pytest.mark.parametrize("size", [1.0, 0.1, 1e-6])
@pytest.mark.parametrize("name", FACTORS)
def test_jacobians_are_the_numeric_ones(name: str, size: float, residual: str, scaled: bool) -> None:
    for seed in range(4):
        factor, values, _ = setting(name, seed, size, residual, scaled, deviation=0.6)
        check_jacobians(factor, values, SIGMAS[residual])
        assert list(factor.keys()) == FACTORS[name][1] + ([S(0)] if scaled else [])


@pytest.mark.parametrize("scaled", [False, True], ids=["true size", "scaled"])
@pytest.mark.parametrize("name", FACTORS)
def test_residual_is_the_perturbation_of_b(name: str, scaled: bool) -> None:
    factor, values, xi = setting(name, 5, 1.0, "geodesic", scaled, deviation=0.3)
    np.testing.assert_allclose(factor.unwhitenedError(values), xi, atol=1e-12)


@pytest.mark.parametrize("name", FACTORS)
def test_chordal_residual_is_the_equation_of_the_certified_cost(name: str) -> None:
    factor, values, xi = setting(name, 6, 1.0, "chordal", scaled=True)
    poses = [values.atPose3(key) for key in FACTORS[name][1]]
    X_, Y_ = (poses[-2], poses[-1]) if X(0) in FACTORS[name][1] else (poses[-1], poses[-1])
    predicted = FACTORS[name][2](*poses)
    A = Y_.compose(predicted).compose(X_.inverse())
    B = gtsam.Pose3(predicted.rotation(), 0.7 * predicted.translation()).compose(gtsam.Pose3.Expmap(-xi))
    R_Y = Y_.rotation().matrix()
    rotation = A.rotation().matrix() @ X_.rotation().matrix() - R_Y @ B.rotation().matrix()
    translation = (
        0.7 * (A.rotation().matrix() @ X_.translation() + A.translation() - Y_.translation()) - R_Y @ B.translation()
    )
    expected = np.concatenate([rotation.ravel(order="F"), translation])
    np.testing.assert_allclose(factor.unwhitenedError(values), expected, atol=1e-12)
    J = 0.5 * (0.5 / 0.1**2 * (rotation**2).sum() + (translation**2).sum() / 0.3**2)  # kappa = 1 / (2 sigma_R^2)
    assert factor.error(values) == pytest.approx(J, rel=1e-12)


@pytest.mark.parametrize("residual", ["geodesic", "chordal"])
def test_factors_with_carrier_variables_agree_with_known_carriers(residual: str) -> None:
    generator = np.random.default_rng(7)
    P_s, P_t, X_, Y_, B = (gtsam.Pose3.Expmap(generator.standard_normal(6)) for _ in range(5))
    A = P_s.inverse().compose(P_t)
    values = values_of({P(0): P_s, P(1): P_t, P(2): A, P(3): A.inverse(), X(0): X_, Y(0): Y_, S(0): 1.3})
    for options in ({}, {"scale_key": S(0)}):
        known = robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, residual=residual, **options)
        for factor in (
            two_pose_robot_world_hand_eye_factor(P(0), P(1), X(0), Y(0), B, NOISE, residual=residual, **options),
            pose_robot_world_hand_eye_factor(P(2), X(0), Y(0), B, NOISE, residual=residual, pose=STRAIGHT, **options),
            pose_robot_world_hand_eye_factor(P(3), X(0), Y(0), B, NOISE, residual=residual, pose=INVERSE, **options),
            pose_robot_world_hand_eye_factor(P(3), X(0), Y(0), B, NOISE, residual=residual, **options),
        ):
            np.testing.assert_allclose(factor.unwhitenedError(values), known.unwhitenedError(values), atol=1e-12)


def test_pose_hand_eye_is_hand_eye_between_the_poses() -> None:
    generator = np.random.default_rng(8)
    P_i, P_j, Y_, B = (gtsam.Pose3.Expmap(generator.standard_normal(6)) for _ in range(4))
    values = values_of({P(0): P_i, P(1): P_j, Y(0): Y_})
    between = hand_eye_factor(Y(0), P_i.between(P_j), B, NOISE)
    factor = pose_hand_eye_factor(P(0), P(1), Y(0), B, NOISE)
    np.testing.assert_allclose(factor.unwhitenedError(values), between.unwhitenedError(values), atol=1e-12)


@pytest.mark.parametrize("name", FACTORS)
def test_a_missing_key_and_a_wrong_type_are_named_and_what_it_should_be(name: str) -> None:
    factor, values, _ = setting(name, 9, 1.0, "geodesic", scaled=True)
    for key in list(factor.keys()):
        incomplete, named = gtsam.Values(values), gtsam.DefaultKeyFormatter(key)
        incomplete.erase(key)
        what = "1-vector" if key == S(0) else "T_.*Pose3"
        with pytest.raises(KeyError, match=rf"{named} is not in the values.*{what}"):
            factor.error(incomplete)
        for wrong in (np.zeros(3), 1.5, gtsam.Pose2()):
            mixed = gtsam.Values(incomplete)
            mixed.insert(key, wrong)
            with pytest.raises(TypeError, match=rf"{named} should be .*{what}"):
                factor.linearize(mixed)


@pytest.mark.parametrize("name", FACTORS)
def test_noise_that_these_factors_cannot_hold_is_refused(name: str) -> None:
    make = FACTORS[name][0]
    sigmas = np.array([0.1, 0.2, 0.1, 0.3, 0.3, 0.3])
    with pytest.raises(ValueError, match="dimension 3"):
        make(gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(3, 1.0))
    with pytest.raises(ValueError, match="geodesic"):
        make(gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(sigmas), residual="chordal")
    with pytest.raises(ValueError, match="'chorda'"):
        make(gtsam.Pose3(), NOISE, residual="chorda")
    with pytest.raises(TypeError, match="ndarray"):
        make(np.eye(4), NOISE)
    assert make(gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(sigmas)).dim() == 6


def test_equal_keys_are_refused() -> None:
    B = gtsam.Pose3()
    for build in (
        lambda: pose_robot_world_hand_eye_factor(P(0), X(0), X(0), B, NOISE),
        lambda: pose_robot_world_hand_eye_factor(P(0), X(0), Y(0), B, NOISE, scale_key=P(0)),
        lambda: two_pose_robot_world_hand_eye_factor(P(0), P(0), X(0), Y(0), B, NOISE),
        lambda: pose_hand_eye_factor(P(0), P(0), Y(0), B, NOISE),
        lambda: hand_eye_factor(Y(0), B, B, NOISE, scale_key=Y(0)),
    ):
        with pytest.raises(ValueError, match="not all different"):
            build()


def test_an_unknown_pose_convention_is_refused() -> None:
    with pytest.raises(ValueError, match=f"{INVERSE}.*{STRAIGHT}"):
        pose_robot_world_hand_eye_factor(P(0), X(0), Y(0), gtsam.Pose3(), NOISE, pose="T_world_body")


def test_a_known_motion_must_be_a_pose() -> None:
    with pytest.raises(TypeError, match="A is a ndarray"):
        hand_eye_factor(Y(0), np.eye(4), gtsam.Pose3(), NOISE)
