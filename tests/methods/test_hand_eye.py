"""Daniilidis' method, nonlinear least squares and the certified solution behind ``solve``."""

import numpy as np
import pytest
from simulated import distance, hand_held, planar

from gtsam_rwhec.errors import CountError, OptionError, UnderdeterminedError
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms
from gtsam_rwhec.methods.hand_eye import HAND_EYE_METHODS, solve_hand_eye
from gtsam_rwhec.methods.hand_eye_request import DualQuaternionPrior
from gtsam_rwhec.solver.free_directions import FreeKind

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
    assert HAND_EYE_METHODS[name].assumes
    assert HAND_EYE_METHODS[name].source


@pytest.mark.parametrize("name", NAMES)
def test_signs_of_the_callers_quaternions_do_not_matter(name):
    data = hand_held(30, 2)
    rows = [np.empty((30, 7)) for _ in range(2)]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (2, 30))
    for row, T, sign in zip(rows, (data.C, data.H), signs, strict=True):
        q, _ = from_transforms(T)
        row[:, :4], row[:, 4:] = sign[:, None] * q, T[:, :3, 3]
    plain = solve_hand_eye(data.C, data.H, method=name, rng=0).X.matrix()
    turned = solve_hand_eye(*rows, method=name, order="xyzw", rng=0).X.matrix()
    np.testing.assert_allclose(turned, plain, atol=1e-9)


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
    with pytest.raises(CountError):
        solve_hand_eye(data.C[:1], data.H[:1], method=name)


@pytest.mark.parametrize("name", NAMES)
def test_motions_about_one_axis_have_named_free_directions_or_are_refused(name):
    data = planar(40, 1, 0.0, 0.0, jitter_rad=0.0)
    if name == "dan":
        with pytest.raises(UnderdeterminedError, match="parallel axes"):
            solve_hand_eye(data.C, data.H, method=name)
    else:
        result = solve_hand_eye(data.C, data.H, method=name, rng=0)
        assert any(FreeKind.TRANSLATION is free.kind for free in result.free_directions)


@pytest.mark.parametrize("name", NAMES)
def test_no_motion_at_all_is_refused(name):
    with pytest.raises(UnderdeterminedError, match="identity"):
        solve_hand_eye(np.tile(np.eye(4), (5, 1, 1)), np.tile(np.eye(4), (5, 1, 1)), method=name)
