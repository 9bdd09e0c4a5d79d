from __future__ import annotations

import gtsam
import numpy as np
import pytest
from simulated import Simulated, distance, hand_held, pair, planar, poses

from gtsam_rwhec.errors import CountError, UnderdeterminedError
from gtsam_rwhec.methods import DualQuaternionPrior, Estimate
from gtsam_rwhec.methods.hand_eye import HAND_EYE_METHODS, solve_hand_eye
from gtsam_rwhec.solver.free_directions import FreeKind

HEIGHT = "translation of h along its own z axis: the motion turned about one axis only"
#: Not turned, so that c's axes have the names of h's.
UPRIGHT = poses(np.zeros((1, 3)), np.array([[0.1, 0.2, 0.3]]))[0]
DUAL_QUATERNION = ["dqopt", "dq2steps", "dqconvrlx", "dq2ndord", "dq2ndord_lambda", "dqitr"]
#: Those that need axes that are not parallel, or noise.
REFUSED = ["dan", "dq2steps", "dqoptpoly_resultant", "dqoptpoly_sturm"]

#: Those whose rotation is noise on a cart.
FROM_ROTATIONS_ALONE = ["dq2steps", "dan"]


def words(estimate: Estimate[gtsam.Pose3]) -> list[str]:
    return list(map(str, estimate.free_directions))


def cart(count: int, seed: int, sigma_rad: float, sigma_m: float) -> Simulated:
    rng = np.random.default_rng(seed)
    H = poses(np.outer(rng.uniform(-0.5, 0.5, count), [0, 0, 1.0]), rng.normal(size=(count, 3)) * [0.3, 0.3, 0.0])
    return pair(H, rng, sigma_rad, sigma_m, UPRIGHT)


@pytest.mark.parametrize("seed", range(30))
def test_noise_is_not_taken_for_motion(seed: int) -> None:
    """A cart: M has full rank from noise alone, at every level of it, and the height is free all the same."""
    sigma = 10.0 ** np.random.default_rng(seed).uniform(-5, -1.5)
    s = cart(80, seed, sigma, sigma)
    assert words(solve_hand_eye(s.C, s.H)) == [HEIGHT]


@pytest.mark.parametrize("seed", range(30))
def test_motion_is_not_taken_for_noise(seed: int) -> None:
    """Turns about all axes of several times the noise."""
    rng = np.random.default_rng(seed)
    s = hand_held(int(rng.integers(10, 200)), seed, 0.01, 0.01, largest_rad=float(rng.uniform(0.1, 3.0)))
    assert solve_hand_eye(s.C, s.H).free_directions == ()


@pytest.mark.parametrize(("tilt_rad", "free"), [(0.0, 1.0), (0.001, 1.0), (0.01, 0.0)])
def test_the_line_is_drawn_where_signal_is_significant(tilt_rad: float, free: float) -> None:
    """200 motions with noise of 0.01 rad on both: tilts of a tenth of it are lost, as large ones tell the height."""
    said = [HEIGHT in words(solve_hand_eye(*_tilted(seed, tilt_rad))) for seed in range(20)]
    assert np.mean(said) == free


def _tilted(seed: int, tilt_rad: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    turns = np.outer(rng.uniform(-0.5, 0.5, 200), [0, 0, 1.0]) + rng.normal(0, tilt_rad, (200, 3)) * [1, 1, 0]
    s = pair(poses(turns, rng.normal(size=(200, 3)) * [0.3, 0.3, 0.0]), rng, 0.01, 0.01, UPRIGHT)
    return s.C, s.H


@pytest.mark.parametrize("method", [*DUAL_QUATERNION, "dan"])
def test_all_name_the_height(method: str) -> None:
    s = cart(80, 1, 0.003, 0.003)
    free = words(solve_hand_eye(s.C, s.H, method=method))
    assert HEIGHT in free
    assert len(free) == 1 + (method in FROM_ROTATIONS_ALONE)


@pytest.mark.parametrize("method", list(HAND_EYE_METHODS))
def test_every_method_solves_or_refuses_a_cart_without_noise(method: str) -> None:
    s = cart(20, 2, 0.0, 0.0)
    if method in REFUSED:
        with pytest.raises(UnderdeterminedError, match="method='dqopt'"):  # the error names a method that solves it
            solve_hand_eye(s.C, s.H, method=method, rng=0)
        return
    r = solve_hand_eye(s.C, s.H, method=method, rng=0)
    assert distance(r.X, s.X)[0] < 1e-5
    assert np.linalg.norm(r.X.translation()[:2] - [0.1, 0.2]) < 1e-5
    assert any(free.kind is FreeKind.TRANSLATION for free in r.free_directions), words(r)


@pytest.mark.parametrize("method", list(HAND_EYE_METHODS))
def test_every_method_solves_or_refuses_motion_that_does_not_turn(method: str) -> None:
    rng = np.random.default_rng(3)
    s = pair(poses(np.zeros((10, 3)), rng.normal(size=(10, 3))), rng, 0.0, 0.0, UPRIGHT)
    if method in REFUSED:
        with pytest.raises(UnderdeterminedError, match="method='dqopt'"):  # the error names a method that solves it
            solve_hand_eye(s.C, s.H, method=method, rng=0)
        return
    r = solve_hand_eye(s.C, s.H, method=method, rng=0)
    assert distance(r.X, s.X)[0] < 1e-5
    assert [free.kind for free in r.free_directions].count(FreeKind.TRANSLATION) == 3, words(r)


@pytest.mark.parametrize("method", list(HAND_EYE_METHODS))
def test_every_method_refuses_one_motion_and_none(method: str) -> None:
    s = hand_held(1, 4)
    with pytest.raises(CountError):
        solve_hand_eye(s.C, s.H, method=method)
    still = np.tile(np.eye(4), (3, 1, 1))
    with pytest.raises(UnderdeterminedError, match="all 3 motions are the identity"):
        solve_hand_eye(still, still, method=method)


@pytest.mark.parametrize("method", FROM_ROTATIONS_ALONE)
def test_a_rotation_that_is_noise_is_named(method: str) -> None:
    """Parallel axes with noise: DQOpt has the rotation from the translations; these have it from noise."""
    s = cart(80, 1, 0.003, 0.003)
    free = words(solve_hand_eye(s.C, s.H, method=method))
    assert free[0].startswith("rotation of h about its own z axis")
    assert free[1] == HEIGHT
    rng = np.random.default_rng(3)
    still = pair(poses(np.zeros((200, 3)), rng.normal(size=(200, 3))), rng, 0.01, 0.01)
    kinds = [free.kind for free in solve_hand_eye(still.C, still.H, method=method).free_directions]
    assert kinds == [FreeKind.ROTATION] * 3 + [FreeKind.TRANSLATION] * 3
    turning = hand_held(30, 1)
    assert solve_hand_eye(turning.C, turning.H, method=method).free_directions == ()


def test_a_prior_completes_it() -> None:
    s = cart(80, 5, 0.003, 0.003)
    near = UPRIGHT.copy()
    near[2, 3] = 0.31
    r = solve_hand_eye(s.C, s.H, prior=DualQuaternionPrior(near, 0.01, 0.05))
    assert r.free_directions == ()
    assert r.X.translation()[2] == pytest.approx(0.31, abs=0.01)


def test_planar_with_jitter_is_solved() -> None:
    s = planar(300, 6, 0.002, 0.002, jitter_rad=0.05)
    r = solve_hand_eye(s.C, s.H)
    assert r.free_directions == ()
    assert max(distance(r.X, s.X)) < 0.05


def test_a_free_direction_costs_nothing() -> None:
    """Along each direction, with its rotation and its translation, the residuals grow by no more than noise."""
    rng = np.random.default_rng(3)
    X = poses(np.array([[0.3, -0.2, 0.5]]), np.array([[0.1, 0.2, 0.3]]))[0]
    H = poses(np.outer(rng.uniform(-0.5, 0.5, 40), [0, 0, 1.0]), np.outer(rng.normal(size=40), [0, 0, 0.3]))
    s = pair(H, rng, 1e-4, 1e-4, X)
    r = solve_hand_eye(s.C, s.H)
    assert [free.kind for free in r.free_directions] == [FreeKind.ROTATION, FreeKind.TRANSLATION]
    for free in r.free_directions:
        moved = r.X.retract(0.01 * np.array(free.frames["h"]) / np.linalg.norm(free.frames["h"])).matrix()
        off = np.linalg.norm(s.C @ moved - moved @ s.H, axis=(1, 2)).mean()
        at_answer = np.linalg.norm(s.C @ r.X.matrix() - r.X.matrix() @ s.H, axis=(1, 2)).mean()
        assert off < 2.0 * at_answer
