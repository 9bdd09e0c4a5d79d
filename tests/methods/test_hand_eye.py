"""Daniilidis' method, nonlinear least squares and the certified solution behind ``solve``."""

import numpy as np
import pytest
from simulated import distance, hand_held

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.methods.hand_eye import solve_hand_eye
from gtsam_rwhec.methods.hand_eye_request import DualQuaternionPrior

NAMES = ["dan", "dqnlopt", "dqnloptrnd", "chvecopt", "quatvecopt", "certified"]


@pytest.mark.parametrize("name", NAMES)
def test_the_call_gives_a_pose_near_the_truth(name):
    data = hand_held(60, 1, largest_rad=2.5)
    result = solve_hand_eye(data.C, data.H, method=name, rng=1)
    angle, length = distance(result.X, data.X)
    assert angle < 0.02
    assert length < 0.02
    assert result.method == name
    assert result.cost > 0.0
    assert result.free_directions == ()


def test_costs_have_names_and_only_proven_ones_bounds():
    data = hand_held(60, 3)
    results = {name: solve_hand_eye(data.C, data.H, method=name, rng=0) for name in [*NAMES, "dqopt"]}
    for name in ("dan", "dqnlopt", "dqnloptrnd"):
        assert results[name].cost_name == results["dqopt"].cost_name
        assert results[name].cost >= results["dqopt"].cost * (1.0 - 1e-12)
        assert results[name].is_optimal is None
    assert results["certified"].cost == pytest.approx(results["chvecopt"].cost, rel=1e-9)
    assert results["certified"].is_optimal
    assert results["certified"].cost_name == results["chvecopt"].cost_name != results["quatvecopt"].cost_name


@pytest.mark.parametrize("name", ["dan", "chvecopt", "quatvecopt", "certified"])
def test_what_a_method_cannot_take_is_refused(name):
    data = hand_held(10, 4)
    with pytest.raises(OptionError, match=f"{name}.*prior"):
        solve_hand_eye(data.C, data.H, method=name, prior=DualQuaternionPrior(np.eye(4), 1.0, 1.0))
    with pytest.raises(OptionError, match=f"{name}.*covariances"):
        solve_hand_eye(data.C, data.H, method=name, covariances=np.eye(8))


@pytest.mark.parametrize("name", [name for name in NAMES if name != "certified"])
def test_only_the_certified_one_finds_a_scale(name):
    data = hand_held(10, 4)
    with pytest.raises(OptionError, match="unknown"):
        solve_hand_eye(data.C, data.H, method=name, scale="unknown")
