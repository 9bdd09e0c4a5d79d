"""The joint likelihood's residuals, derivatives, noise and information; the joint form's cost and its bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drives_with_sensors import drive
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry import OdometryTrack
from gtsam_rwhec.odometry.joint_cost import JointForm, joint_form, solved, star_starts
from gtsam_rwhec.odometry.residual_noise import deletion_squares, found_variances
from gtsam_rwhec.odometry.window_likelihood import (
    Layout,
    State,
    eliminated,
    information_of_noise,
    linearised,
    predicted,
    weights,
)
from gtsam_rwhec.odometry.window_motions import SampledTrack, WindowMotions, first_rotation_variances
from gtsam_rwhec.simulate.drives import Drive
from gtsam_rwhec.solver.rotations import random_rotations, vec


def windows_of(driven: Drive, every: int) -> WindowMotions:
    samples = [
        SampledTrack(OdometryTrack(name, stamps, T), 0, 0.0, np.ones(len(stamps) - 1, dtype=bool))
        for name, (stamps, T) in driven.tracks.items()
    ]
    return WindowMotions.of(samples, driven.stamps_ns[::every] * 1e-9, 0.5)


def truth(driven: Drive, windows: WindowMotions, every: int) -> tuple[State, Array]:
    """The true state and variances (m, 2)."""
    T = np.array([driven.T("lidar", name) for name in driven.sensors])
    scale = np.array([sensor.scale for sensor in driven.sensors.values()])
    at = (driven.T_world_vehicle @ driven.sensors["lidar"].T_vehicle_sensor)[::every]
    motion = (se3.inverse(at[:-1]) @ at[1:])[: len(windows)]
    sigma = np.array(
        [(s.rotation_rad_per_sqrt_s, s.translation_m_per_sqrt_s * s.scale) for s in driven.sensors.values()]
    )
    return State(T, scale, np.zeros(len(T)), motion, np.zeros(2), 0.0), sigma**2


@pytest.fixture(scope="module")
def hilly() -> Drive:
    return drive("3d", 7)


SCALED = np.array([False, False, False, True])


def test_derivatives_are_those_of_the_residuals(hilly: Drive) -> None:
    windows = windows_of(hilly, 10)
    state, _ = truth(hilly, windows, 10)
    # At exact measurements, so that the residual's own Jacobian is the identity.
    windows = replace(windows, M=predicted(state))
    layout = Layout.of(SCALED, clocks=True, has_ground=False)
    linear = linearised(windows, state)
    np.testing.assert_allclose(linear.r, 0.0, atol=1e-12)
    still = np.zeros((len(windows), 6))
    for i in range(layout.size):
        step = np.zeros(layout.size)
        step[i] = 1e-6
        moved = linearised(windows, state.moved(layout, step, still)).r
        expected = -np.einsum("mnij,mj->mni", linear.J, layout.spread(step))
        np.testing.assert_allclose(moved, expected, atol=1e-10)
    shift = np.random.default_rng(0).normal(0.0, 1e-6, (len(windows), 6))
    moved = linearised(windows, state.moved(layout, np.zeros(layout.size), shift)).r
    np.testing.assert_allclose(moved, -np.einsum("mnij,nj->mni", linear.B, shift), atol=1e-9)


def test_residuals_at_the_truth_have_the_covariance_that_grows_with_the_window(hilly: Drive) -> None:
    windows = windows_of(hilly, 5)
    state, variances = truth(hilly, windows, 5)
    linear, W = linearised(windows, state), weights(windows, *variances.T)
    squares = np.einsum("mni,mnij,mnj->m", linear.r, W, linear.r) / (6.0 * windows.used.sum(axis=1))
    np.testing.assert_allclose(squares, 1.0, atol=5.0 * np.sqrt(2.0 / (6.0 * len(windows))))
    # With the windows' motions eliminated three of the four sensors' numbers are left.
    layout = Layout.of(SCALED, clocks=False, has_ground=False)
    step = np.zeros(layout.size)
    normal = eliminated(linear, W, layout)
    left = linear.r - np.einsum("mnij,nj->mni", linear.B, normal.motions(step))
    assert np.einsum("mni,mnij,mnj->", left, W, left) == pytest.approx(18.0 * len(windows), rel=0.15)
    by_deletion = deletion_squares(linear, W)
    assert by_deletion.mean() == pytest.approx(6.0, rel=0.1)


def test_the_noise_of_each_sensor_is_found(hilly: Drive) -> None:
    windows = windows_of(hilly, 5)
    state, variances = truth(hilly, windows, 5)
    start = np.tile(np.median(variances, axis=0), (4, 1))
    nobody = np.zeros(4, dtype=bool)
    found = found_variances(windows, linearised(windows, state), start, nobody, state.scale, 0)
    np.testing.assert_allclose(np.sqrt(found / variances), 1.0, atol=0.35)
    stated = np.array([True, False, False, False])
    kept = found_variances(windows, linearised(windows, state), start, stated, state.scale, 0)
    np.testing.assert_array_equal(kept[0], start[0])
    rough = np.sqrt(first_rotation_variances(windows) / variances[:, 0])
    assert (rough < 3.0).all()


def test_what_noise_alone_adds_to_the_information(hilly: Drive) -> None:
    """H at motions that are off by their own noise, minus H at the true ones, is N on average."""
    windows = windows_of(hilly, 5)
    state, variances = truth(hilly, windows, 5)
    variances = variances * 400.0  # so that it shows
    layout = Layout.of(SCALED, clocks=False, has_ground=False)
    W = weights(windows, *variances.T)
    at_truth = eliminated(linearised(windows, state), W, layout)
    N = information_of_noise(linearised(windows, state), W, layout, state, at_truth.D, np.linalg.inv(at_truth.D))
    generator = np.random.default_rng(1)
    root = np.linalg.inv(np.swapaxes(np.linalg.cholesky(at_truth.D), 1, 2))
    added = np.zeros_like(N)
    for _ in range(10):
        noise = np.einsum("nij,nj->ni", root, generator.standard_normal((len(windows), 6)))
        for sign in (1.0, -1.0):  # what is linear in the noise cancels
            off = state.moved(layout, np.zeros(layout.size), sign * noise)
            added += (eliminated(linearised(windows, off), W, layout).H - at_truth.H) / 20
    unit = 1.0 / np.sqrt(np.diagonal(N))
    np.testing.assert_allclose(np.diagonal(added) * unit**2, 1.0, atol=0.3)


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
