"""The joint form is the cost that it is named for, and its bound holds and closes."""

from __future__ import annotations

import numpy as np
import pytest
from drives_with_sensors import drive
from test_window_likelihood import SCALED, truth, windows_of

from gtsam_rwhec.odometry.joint_cost import JointForm, joint_form, solved, star_starts
from gtsam_rwhec.solver.rotations import random_rotations, vec


@pytest.fixture(scope="module")
def form() -> JointForm:
    driven = drive("3d", 7)
    windows = windows_of(driven, 5)
    state, variances = truth(driven, windows, 5)
    return joint_form(windows, state, variances, SCALED)


def test_the_form_is_small_at_the_truth_and_large_elsewhere(form: JointForm) -> None:
    driven = drive("3d", 7)
    windows = windows_of(driven, 5)
    state, _ = truth(driven, windows, 5)
    shifts = state.T[1:, :3, 3] * state.scale[1:, None]
    y = np.r_[vec(state.T[1:, :3, :3]).ravel(), shifts.ravel(), state.scale[SCALED], 1.0]
    # Half a chi-square: of 4 rotation vectors and of 3 metric translations less one each, and one scaled translation.
    expected = 0.5 * len(windows) * (9 + 6 + 3)
    assert y @ form.Q @ y == pytest.approx(expected, rel=0.2)
    T, scale = form.poses(y)
    np.testing.assert_allclose(T, state.T[1:], atol=1e-12)
    np.testing.assert_allclose(scale, state.scale[1:])


def test_no_rotation_costs_less_than_the_bound(form: JointForm) -> None:
    y, certificate = solved(form, [random_rotations(3, np.random.default_rng(3))])
    assert certificate.status == "certified"
    assert certificate.gap <= certificate.tolerance
    assert y @ form.Q @ y == pytest.approx(certificate.cost, rel=1e-9)
    generator = np.random.default_rng(4)
    for _ in range(50):
        R = random_rotations(3, generator)
        other = form.completed(np.append(vec(R), 1.0))
        assert other @ form.Q @ other > certificate.lower_bound


def test_a_mirror_image_is_turned_back() -> None:
    driven = drive("planar", 8)
    windows = windows_of(driven, 5)
    state, variances = truth(driven, windows, 5)
    form = joint_form(windows, state, variances, SCALED)
    starts = star_starts(windows.rotation_vectors(), windows.M[..., :3, 3], windows.used)
    mirrored = [R.copy() for R in starts]
    for R in mirrored:
        R[2] = np.diag([-1.0, -1.0, 1.0]) @ R[2]
    for begin in (starts, mirrored):
        y, certificate = solved(form, begin, axis=np.array([0.0, 0.0, 1.0]))
        assert certificate.is_optimal
        assert form.poses(y)[1][2] == pytest.approx(0.4, rel=0.01)
