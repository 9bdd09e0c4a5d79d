"""Invalid arguments are refused by name, and every unit of length gives the same answer."""

from __future__ import annotations

import re

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import distance, hand_held, pair, poses

from gtsam_rwhec.errors import CountError, NoiseError, OptionError, PoseError, PriorError
from gtsam_rwhec.methods import DualQuaternionPrior
from gtsam_rwhec.methods import dual_quaternion_cost as cost_module
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms, residuals
from gtsam_rwhec.methods.hand_eye import solve_hand_eye
from gtsam_rwhec.methods.motions import motions_of


def test_pose3_and_quaternion_rows_are_the_same_motions() -> None:
    s = hand_held(10, 1)
    rows = motions_of(s.C, s.H).rows
    assert motions_of([gtsam.Pose3(T) for T in s.C], [gtsam.Pose3(T) for T in s.H]).rows == pytest.approx(rows)
    for order, columns in (("xyzw", [0, 1, 2, 3]), ("wxyz", [3, 0, 1, 2])):
        both = [np.hstack([Rotation.from_matrix(T[:, :3, :3]).as_quat()[:, columns], T[:, :3, 3]]) for T in (s.C, s.H)]
        assert motions_of(*both, order=order).rows == pytest.approx(rows)


def test_the_callers_signs_do_not_matter() -> None:
    s = hand_held(60, 2, largest_rad=np.pi)
    rng = np.random.default_rng(3)
    given = [np.hstack([Rotation.from_matrix(T[:, :3, :3]).as_quat(), T[:, :3, 3]]) for T in (s.C, s.H)]
    first = solve_hand_eye(*given, order="xyzw")
    for _ in range(5):
        signs = rng.choice([-1.0, 1.0], (2, 60, 1))
        again = solve_hand_eye(
            *[np.hstack([sign * rows[:, :4], rows[:, 4:]]) for sign, rows in zip(signs, given, strict=True)],
            order="xyzw",
        )
        assert again.X.equals(first.X, 1e-12)
        assert again.cost == pytest.approx(first.cost, rel=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_half_turns_get_the_sign_that_agrees_with_the_rest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(40, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    angles = np.where(np.arange(40) < 20, np.pi, rng.uniform(0.3, 2.0, 40))
    s = pair(poses(axes * angles[:, None], rng.uniform(-1, 1, (40, 3))), rng, 0.01, 0.01)
    rows = motions_of(s.C, s.H).rows
    (q,), (q_dual,) = from_transforms(s.X[None])
    assert np.linalg.norm(residuals(rows, q, q_dual), axis=0).max() < 0.2


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("count", [3, 10])
def test_half_turns_only(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3))
    axes *= np.pi / np.linalg.norm(axes, axis=1)[:, None]
    s = pair(poses(axes, rng.uniform(-1, 1, (count, 3))), rng, 1e-4, 1e-4)
    angle, length = distance(solve_hand_eye(s.C, s.H).X, s.X)
    assert angle < 0.01
    assert length < 0.01


def test_numbers_that_do_not_match() -> None:
    s = hand_held(5, 0)
    with pytest.raises(CountError, match="C has 5 motions and H has 4"):
        motions_of(s.C, s.H[:4])
    with pytest.raises(CountError, match="1 motion given; AX = XB needs two"):
        motions_of(s.C[:1], s.H[:1])
    with pytest.raises(CountError, match="0 motions given"):
        motions_of([], [])


def test_what_is_no_pose_is_refused_with_its_place() -> None:
    s = hand_held(5, 0)
    bad = s.H.copy()
    bad[3, 0, 3] = np.nan
    with pytest.raises(PoseError, match=r"H: measurement 3 has an entry that is NaN"):
        motions_of(s.C, bad)
    with pytest.raises(PoseError, match="C: rows of 7 need the order of the quaternion"):
        motions_of(np.ones((3, 7)), np.ones((3, 7)))


def test_blocks_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    s = hand_held(50, 4, largest_rad=np.pi)
    whole = motions_of(s.C, s.H).rows
    monkeypatch.setattr(cost_module, "BLOCK", 16)
    assert np.array_equal(motions_of(s.C, s.H).rows, whole)
    bad = s.C.copy()
    bad[40, :3, :3] *= 1.1
    with pytest.raises(PoseError, match="C: the rotation of measurement 40 is off"):
        motions_of(bad, s.H)


MOTIONS = hand_held(30, 1)


@pytest.mark.parametrize("alpha", [0, -1, np.inf, np.nan, "x", None, 1e300, 1e-300, [1.0, 2.0], np.ones(2), 1j])
def test_alpha(alpha: object) -> None:
    with pytest.raises(OptionError, match="alpha="):
        solve_hand_eye(MOTIONS.C, MOTIONS.H, alpha=alpha)


@pytest.mark.parametrize(
    "weights", ["abc", ["a"] * 30, [[1], [1, 2]], np.full(30, 1j), np.full(30, 1e300), [None] * 30]
)
def test_weights(weights: object) -> None:
    with pytest.raises(NoiseError, match="weight"):
        solve_hand_eye(MOTIONS.C, MOTIONS.H, weights=weights)


@pytest.mark.parametrize("covariances", ["abc", [[1.0, 2.0], [3.0]], 1j * np.eye(8), -np.eye(8), np.nan * np.eye(8)])
def test_covariances(covariances: object) -> None:
    with pytest.raises(NoiseError, match="covariance"):
        solve_hand_eye(MOTIONS.C, MOTIONS.H, covariances=covariances)


@pytest.mark.parametrize("weight", ["a", None, 1j, np.ones(2), [1.0], -1.0, np.nan, 1e300])
def test_a_priors_weights(weight: object) -> None:
    with pytest.raises(PriorError, match=re.escape("the prior's a=")):
        DualQuaternionPrior(np.eye(4), weight, 1.0)
    with pytest.raises(PriorError, match=re.escape("the prior's b=")):
        DualQuaternionPrior(np.eye(4), 1.0, weight)


@pytest.mark.parametrize("prior", ["near", np.eye(4)])
def test_a_prior_of_another_type(prior: object) -> None:
    with pytest.raises(PriorError, match="DualQuaternionPrior"):
        solve_hand_eye(MOTIONS.C, MOTIONS.H, prior=prior)


@pytest.mark.parametrize("rng", ["a", -1, 1.5])
def test_random_numbers(rng: object) -> None:
    with pytest.raises(OptionError, match="rng="):
        solve_hand_eye(MOTIONS.C, MOTIONS.H, method="dqnloptrnd", rng=rng)


@pytest.mark.parametrize("method", ["DQOPT", "", None, 3, ["dqopt"]])
def test_names(method: object) -> None:
    with pytest.raises(OptionError, match="choose one of dqopt"):
        solve_hand_eye(MOTIONS.C, MOTIONS.H, method=method)


@pytest.mark.parametrize("method", ["dqopt", "dqnlopt", "chvecopt", "quatvecopt", "certified"])
@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e9])
@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.UnitsWarning")
def test_any_unit(method: str, unit: float) -> None:
    """With 1 / alpha in the same unit the answer is the same."""
    C, H = MOTIONS.C.copy(), MOTIONS.H.copy()
    C[:, :3, 3] *= unit
    H[:, :3, 3] *= unit
    expected = solve_hand_eye(MOTIONS.C, MOTIONS.H, method=method).X.matrix()
    expected[:3, 3] *= unit
    angle, length = distance(solve_hand_eye(C, H, method=method, alpha=1.0 / unit).X, expected)
    assert angle < 1e-7
    assert length < 1e-7 * unit
