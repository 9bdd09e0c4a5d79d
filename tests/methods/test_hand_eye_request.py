"""."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from rwhec_factors import dual_quaternion_prior_factor
from scipy.optimize import minimize
from simulated import Simulated, distance, hand_held, pair, poses

from gtsam_rwhec.errors import CountError, OptionError, PoseError, PriorError, UnderdeterminedError
from gtsam_rwhec.methods import DualQuaternionPrior, Estimate, cost_of, motions_of
from gtsam_rwhec.methods.dqopt import on_sphere
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms
from gtsam_rwhec.methods.hand_eye import HAND_EYE_METHODS, solve_hand_eye
from gtsam_rwhec.solver.free_directions import FreeKind

FORMS = ["imaginary", "distance"]


def gtsam_value(prior: DualQuaternionPrior, X: gtsam.Pose3) -> float:
    """The same prior as a factor of this project has it, written apart from this."""
    factor = dual_quaternion_prior_factor(0, gtsam.Pose3(prior.T), prior.a, prior.b, rotation=prior.form)
    values = gtsam.Values()
    values.insert(0, X)
    return factor.error(values)


@pytest.mark.parametrize("form", FORMS)
def test_value_is_the_factors(form: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        T, X = (gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))
        prior = DualQuaternionPrior(T, 1.3, 0.6, form)
        (q,), (q_dual,) = from_transforms(X.matrix()[None])
        for sign in (1.0, -1.0):
            assert prior.value(sign * q, sign * q_dual) == pytest.approx(gtsam_value(prior, X), rel=1e-9)


def test_eq_29_is_eq_26() -> None:
    """S, W and M with the prior give the cost plus the prior, the constant that the paper drops included."""
    s = hand_held(10, 1)
    cost = cost_of(motions_of(s.C, s.H), 0.7)
    prior = DualQuaternionPrior(poses(np.array([[0.4, -1, 0.3]]), np.array([[1.0, 2, 3]]))[0], 5.0, 4.0)
    with_prior = prior.added_to(cost)
    T = poses(np.array([[1.0, 0.2, 0.3]]), np.array([[-1.0, 0.5, 0.1]]))
    (q,), (q_dual,) = from_transforms(T)
    assert with_prior.value(q, q_dual) == pytest.approx(cost.value(q, q_dual) + prior.value(q, q_dual))


def total(
    result: Estimate[gtsam.Pose3], C: np.ndarray, H: np.ndarray, prior: DualQuaternionPrior, xi: np.ndarray
) -> float:
    X = result.X.retract(xi)
    motions = motions_of(C, H)
    (q,), (q_dual,) = from_transforms(X.matrix()[None])
    return cost_of(motions).value(q, q_dual) + gtsam_value(prior, X)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(3))
def test_no_local_search_does_better(form: str, seed: int) -> None:
    s = hand_held(10, seed, 0.1, 0.1)
    rng = np.random.default_rng(seed)
    prior = DualQuaternionPrior(gtsam.Pose3(s.X).retract(0.5 * rng.normal(size=6)), 20.0, 10.0, form)
    r = solve_hand_eye(s.C, s.H, prior=prior)
    assert r.is_optimal
    assert r.lower_bound <= r.cost
    assert r.cost == pytest.approx(total(r, s.C, s.H, prior, np.zeros(6)), rel=1e-10)
    assert r.cost_name == {"imaginary": "eq. 26", "distance": "eq. 25"}[form]
    for size in (0.0, 1.0, 1.0, 2.0):
        start = size * rng.normal(size=6)
        found = minimize(lambda xi: total(r, s.C, s.H, prior, xi), start, method="BFGS")
        assert found.fun >= r.cost * (1 - 1e-11)


@pytest.mark.parametrize("form", FORMS)
def test_weights_from_none_to_all(form: str) -> None:
    s = hand_held(20, 2, 0.05, 0.05)
    T = gtsam.Pose3(s.X).retract(np.array([0.2, -0.1, 0.3, 0.1, 0.2, -0.4]))
    free, weak, strong = (
        solve_hand_eye(s.C, s.H, prior=DualQuaternionPrior(T, w, w, form) if w else None) for w in (0.0, 1e-8, 1e10)
    )
    assert weak.X.equals(free.X, 1e-7)
    assert strong.X.equals(T, 1e-6)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_planar_motion_is_completed(form: str, noise: float) -> None:
    rng = np.random.default_rng(3)
    H = poses(np.outer(rng.uniform(-1, 1, 200), [0, 0, 1.0]), rng.normal(size=(200, 3)) * [1, 1, 0])
    X = poses(np.array([[0.0, 0.0, 0.4]]), np.array([[0.1, 0.2, 0.3]]))[0]
    s = pair(H, rng, noise, noise, X)
    assert solve_hand_eye(s.C, s.H).free_directions[0].kind is FreeKind.TRANSLATION
    prior = DualQuaternionPrior(poses(np.array([[0.0, 0.0, 0.38]]), np.array([[0.0, 0.0, 0.31]]))[0], 0.1, 0.5, form)
    r = solve_hand_eye(s.C, s.H, prior=prior)
    assert r.is_optimal
    assert r.X.translation()[2] == pytest.approx(0.31, abs=0.02 if noise else 1e-3)
    assert distance(r.X, s.X)[1] < 0.03


def test_one_axis_without_moving_and_a_linear_prior() -> None:
    rng = np.random.default_rng(4)
    s = pair(poses(np.outer(rng.uniform(-1, 1, 20), [1.0, 0, 0]), np.zeros((20, 3))), rng, 0.0, 0.0, np.eye(4))
    T = poses(np.array([[0.3, 0, 0]]), np.array([[0.7, 0.0, 0.0]]))[0]
    r = solve_hand_eye(s.C, s.H, prior=DualQuaternionPrior(T, 1.0, 0.0, "distance"))
    assert distance(r.X, T)[0] < 1e-7
    assert r.is_optimal
    (free,) = r.free_directions
    assert str(free) == "translation of h along its own x axis: the motion turned about one axis only"
    assert solve_hand_eye(s.C, s.H, prior=DualQuaternionPrior(T, 1.0, 1.0, "distance")).X.matrix() == pytest.approx(
        T, abs=1e-7
    )


def test_the_sphere() -> None:
    rng = np.random.default_rng(5)
    for size in (1e-6, 1e-3, 1.0, 100.0):
        Z = rng.normal(size=(4, 4))
        Z = Z + Z.T
        pull = size * rng.normal(size=4)
        q, lam = on_sphere(Z, pull)
        assert q @ q == pytest.approx(1.0)
        assert Z @ q - lam * q == pytest.approx(pull, abs=1e-9 * (1 + size))
        assert lam <= np.linalg.eigvalsh(Z)[0] + 1e-12
        others = rng.normal(size=(500, 4))
        others /= np.linalg.norm(others, axis=1)[:, None]
        assert (np.einsum("ni,ij,nj->n", others, Z, others) - 2 * others @ pull).min() >= q @ Z @ q - 2 * q @ pull
    # The hard case: nothing of the smallest eigenvector in the pull.
    q, lam = on_sphere(np.diag([0.0, 1.0, 2.0, 3.0]), np.array([0.0, 0.1, 0.0, 0.0]))
    assert lam == pytest.approx(0.0, abs=1e-12)
    assert np.abs(q) == pytest.approx([np.sqrt(0.99), 0.1, 0.0, 0.0])


def test_priors_that_are_none() -> None:
    with pytest.raises(PriorError, match="a=-1"):
        DualQuaternionPrior(np.eye(4), -1.0, 1.0)
    with pytest.raises(PriorError, match="b=nan"):
        DualQuaternionPrior(np.eye(4), 1.0, float("nan"))
    with pytest.raises(PriorError, match="both 0"):
        DualQuaternionPrior(np.eye(4), 0.0, 0.0)
    with pytest.raises(PriorError, match="form='angle'"):
        DualQuaternionPrior(np.eye(4), 1.0, 1.0, "angle")
    with pytest.raises(PoseError, match="the prior's pose"):
        DualQuaternionPrior(2 * np.eye(4), 1.0, 1.0)
    s = hand_held(5, 0)
    with pytest.raises(OptionError, match="'dq2ndord' cannot take a prior of the form 'distance'"):
        solve_hand_eye(s.C, s.H, method="dq2ndord", prior=DualQuaternionPrior(np.eye(4), 1.0, 1.0, "distance"))
    with pytest.raises(OptionError, match="'dq2steps' cannot take a prior"):
        solve_hand_eye(s.C, s.H, method="dq2steps", prior=DualQuaternionPrior(np.eye(4), 1.0, 1.0))


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


def without_turning() -> Simulated:
    rng = np.random.default_rng(3)
    return pair(poses(np.zeros((10, 3)), rng.normal(size=(10, 3))), rng, 0.0, 0.0, UPRIGHT)


@pytest.mark.parametrize(
    ("s", "known_m", "free"),
    [(cart(20, 2, 0.0, 0.0), [0.1, 0.2], 1), (without_turning(), [], 3)],
    ids=["cart", "no turn"],
)
@pytest.mark.parametrize("method", list(HAND_EYE_METHODS))
def test_every_method_solves_or_refuses_exact_motion_that_leaves_translations_free(
    method: str, s: Simulated, known_m: list[float], free: int
) -> None:
    if method in REFUSED:
        with pytest.raises(UnderdeterminedError, match="method='dqopt'"):  # the error names a method that solves it
            solve_hand_eye(s.C, s.H, method=method, rng=0)
        return
    r = solve_hand_eye(s.C, s.H, method=method, rng=0)
    assert distance(r.X, s.X)[0] < 1e-5
    assert np.linalg.norm(r.X.translation()[: len(known_m)] - known_m) < 1e-5
    assert [direction.kind for direction in r.free_directions].count(FreeKind.TRANSLATION) == free, words(r)


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
