from __future__ import annotations

import numpy as np
import pytest
from simulated import distance, hand_held, pair, poses

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.methods import cost_of, motions_of
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms
from gtsam_rwhec.methods.hand_eye import solve_hand_eye
from gtsam_rwhec.methods.motions import squared_residuals


@pytest.mark.parametrize("ratio", [0.05, 1.0, 20.0])
def test_alpha_is_the_ratio_of_the_residuals(ratio: float) -> None:
    s = hand_held(400, 0, 0.01, 0.01 / ratio, largest_rad=0.5)
    r = solve_hand_eye(s.C, s.H, alpha="estimate")
    (q,), (q_dual,) = from_transforms(r.X.matrix()[None])
    rotation, translation = squared_residuals(motions_of(s.C, s.H), q, q_dual)
    assert r.alpha == pytest.approx(np.sqrt(rotation / translation), rel=1e-5)
    assert r.is_optimal


def test_alpha_follows_the_unit_and_the_answer_does_not() -> None:
    s = hand_held(50, 1, 0.02, 0.05)
    metres = solve_hand_eye(s.C, s.H, alpha="estimate")
    C, H = s.C.copy(), s.H.copy()
    C[:, :3, 3] *= 1000.0
    H[:, :3, 3] *= 1000.0
    millimetres = solve_hand_eye(C, H, alpha="estimate")
    assert millimetres.alpha == pytest.approx(metres.alpha / 1000.0, rel=1e-6)
    assert millimetres.X.rotation().equals(metres.X.rotation(), 1e-7)
    assert millimetres.X.translation() / 1000.0 == pytest.approx(metres.X.translation(), rel=1e-6)


def test_the_estimate_is_about_as_good_as_the_best_alpha() -> None:
    """Rotations good to 0.06 deg, translations to 20 cm, and the other way round: over 40 recordings."""
    for sigma_rad, sigma_m in ((0.001, 0.2), (0.05, 0.001)):
        errors: dict[object, list[float]] = {key: [] for key in ("estimate", 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0)}
        for seed in range(40):
            s = hand_held(40, seed, sigma_rad, sigma_m, largest_rad=0.4)
            for key, list_ in errors.items():
                list_.append(distance(solve_hand_eye(s.C, s.H, alpha=key).X, s.X)[0])
        medians = {key: np.median(values) for key, values in errors.items()}
        assert medians["estimate"] <= 1.3 * min(medians.values())
        assert medians["estimate"] < 0.8 * max(medians.values())


def test_nothing_to_estimate_from() -> None:
    exact = hand_held(10, 2, 0.0, 0.0)
    assert max(distance(solve_hand_eye(exact.C, exact.H, alpha="estimate").X, exact.X)) < 1e-11
    rng = np.random.default_rng(3)
    turning = pair(poses(rng.normal(size=(10, 3)), np.zeros((10, 3))), rng, 0.0, 0.0, np.eye(4))
    assert solve_hand_eye(turning.C, turning.H, alpha="estimate").alpha == 1.0
    with pytest.raises(OptionError, match="alpha='estimate' and covariances are both given"):
        solve_hand_eye(exact.C, exact.H, alpha="estimate", covariances=np.eye(8))


def test_weights_count() -> None:
    s = hand_held(60, 4, 0.02, 0.05)
    repeats = 1.0 * (np.arange(60) % 3)
    r = solve_hand_eye(s.C, s.H, alpha="estimate", weights=repeats)
    again = solve_hand_eye(
        np.repeat(s.C, repeats.astype(int), axis=0), np.repeat(s.H, repeats.astype(int), axis=0), alpha="estimate"
    )
    assert r.alpha == pytest.approx(again.alpha, rel=1e-6)
    assert r.cost == pytest.approx(
        cost_of(motions_of(s.C, s.H), r.alpha, repeats).value(
            *(part[0] for part in from_transforms(r.X.matrix()[None]))
        )
    )
