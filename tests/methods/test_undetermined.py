"""Poses that leave one method's answer free, not every method's: OpenCV returns a rotation of rounding there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gtsam_rwhec.errors import OptionError, PoseError, UnderdeterminedError
from gtsam_rwhec.methods import opencv as cv2


def stations(turns: np.ndarray, places: np.ndarray) -> list[np.ndarray]:
    """Rotations and translations of a gripper, and of the target that its camera sees."""
    G, X, W = (
        _transforms(*of) for of in ((turns, places), ([[0.4, -0.2, 0.9]], [[0.1, 0.2, 0.3]]), ([[1, 2, 3]],) * 2)
    )
    C = np.linalg.inv(X) @ np.linalg.inv(G) @ W
    return [G[:, :3, :3], G[:, :3, 3], C[:, :3, :3], C[:, :3, 3]]


def _transforms(turns: object, places: object) -> np.ndarray:
    T = np.tile(np.eye(4), (len(np.asarray(turns)), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(turns).as_matrix(), places
    return T


RNG = np.random.default_rng(0)
TURNS, PLACES = RNG.normal(size=(12, 3)), RNG.normal(size=(12, 3))


def test_andreff_and_li_refuse_a_gripper_that_only_turns() -> None:
    R_G, t_G, R_C, t_C = stations(TURNS, np.zeros((12, 3)))
    with pytest.raises(UnderdeterminedError, match="Andreff's"):
        cv2.calibrateHandEye(R_G, t_G, R_C, t_C, method=cv2.CALIB_HAND_EYE_ANDREFF)
    with pytest.raises(UnderdeterminedError, match="Li's"):
        cv2.calibrateRobotWorldHandEye(R_C, t_C, R_G.transpose(0, 2, 1), t_G, method=cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI)
    R, t = cv2.calibrateHandEye(R_G, t_G, R_C, t_C, method=cv2.CALIB_HAND_EYE_PARK)
    np.testing.assert_allclose(R, Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(t.ravel(), [0.1, 0.2, 0.3], atol=1e-12)


def test_tsai_refuses_one_axis_among_the_motions_that_it_uses() -> None:
    """About z within its range, about x beyond it."""
    turns = np.array([[0, 0, 0], [0, 0, 1.0], [0, 0, 0], [2.8, 0, 0]])
    with pytest.raises(UnderdeterminedError, match="rotate about one axis"):
        cv2.calibrateHandEye(*stations(turns, PLACES[:4]), method=cv2.CALIB_HAND_EYE_TSAI)


@pytest.mark.parametrize("method", [[1], np.array(1), None, 99])
def test_methods(method: object) -> None:
    given = stations(TURNS, PLACES)
    for call in (cv2.calibrateHandEye, cv2.calibrateRobotWorldHandEye):
        with pytest.raises(OptionError, match="is not one of CALIB_"):
            call(*given, method=method)


def test_complex_numbers() -> None:
    R_G, t_G, R_C, t_C = stations(TURNS, PLACES)
    with pytest.raises(PoseError, match="complex"):
        cv2.calibrateHandEye(R_G * 1j, t_G, R_C, t_C)
