"""Invalid arguments are refused by name, and every unit of length gives the same answer."""

from __future__ import annotations

import re

import numpy as np
import pytest
from simulated import distance, hand_held

from gtsam_rwhec.errors import NoiseError, OptionError, PriorError
from gtsam_rwhec.methods import DualQuaternionPrior
from gtsam_rwhec.methods.hand_eye import solve_hand_eye

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
