"""Daniilidis' method, nonlinear least squares and the certified AX = XB behind ``solve_hand_eye``."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from method_requests import pose, request_of
from simulated import distance, hand_held, planar

from gtsam_rwhec.errors import OptionError, ScaleError
from gtsam_rwhec.methods.certified import certified_motions
from gtsam_rwhec.methods.dq_descent import chordal_residuals, chvecopt
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


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), alpha=st.floats(0.2, 5.0))
def test_its_cost_is_eq_30_and_its_bound_meets_it(seed, alpha):
    data = hand_held(40, seed)
    weights = np.random.default_rng(seed).uniform(0.5, 2.0, 40)
    request = request_of(data.C, data.H, alpha, weights=weights)
    answer = certified_motions(request)
    rotation, translation = chordal_residuals(request.motions, answer.X, weights)
    assert answer.cost == pytest.approx(rotation + alpha**2 * translation, rel=1e-8)
    assert answer.lower_bound <= answer.cost * (1.0 + 1e-12)
    assert answer.cost - answer.lower_bound <= 1e-6 * answer.cost
    assert answer.cost <= chvecopt(request).cost * (1.0 + 1e-9)


def test_weights_of_zero_leave_motions_out():
    data = hand_held(20, 3)
    weights = np.ones(20)
    weights[5:9] = 0.0
    kept = weights > 0.0
    first = certified_motions(request_of(data.C, data.H, weights=weights)).X
    np.testing.assert_allclose(first, certified_motions(request_of(data.C[kept], data.H[kept])).X, atol=1e-9)


@pytest.mark.parametrize("scale", [0.5, 1.0, 20.0])
def test_an_unknown_scale_is_found(scale):
    data = hand_held(60, 5, 1e-3, 1e-3)
    C = data.C.copy()
    C[:, :3, 3] *= scale
    answer = certified_motions(request_of(C, data.H, scale="unknown"))
    assert answer.scale == pytest.approx(scale, rel=0.01)
    angle, length = distance(pose(answer.X), data.X)
    assert angle < 2e-3
    assert length < 5e-3


def test_a_scale_that_is_not_positive_is_refused():
    data = hand_held(60, 5, 1e-3, 1e-3)
    C = data.C.copy()
    C[:, :3, 3] *= -1.0
    with pytest.raises(ScaleError):
        certified_motions(request_of(C, data.H, scale="unknown"))


def test_free_directions_are_named_and_warn_nobody(recwarn):
    data = planar(40, 1, 1e-9, 1e-9, jitter_rad=0.0)
    answer = certified_motions(request_of(data.C, data.H))
    assert answer.free_directions
    assert not recwarn.list
