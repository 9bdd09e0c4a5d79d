"""The restricted likelihood, the estimate and its covariance against dense matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from noisy_rows import SIGMA, problem_of, rows_of
from rwhec_factors import se3

from gtsam_rwhec.fitting.drift import TRACK, DriftPrior, drift_columns, unit_of
from gtsam_rwhec.fitting.fit_options import About, Component, DriftFrame, Walk
from gtsam_rwhec.fitting.noise_likelihood import NoiseModel, average_information

C = Component


def dense_drift(prior: DriftPrior, sigma: dict[Component, float]) -> np.ndarray:
    """The covariance of all states, step by step."""
    T, s = prior.variance.shape
    unit = np.tile(unit_of(sigma), s // TRACK)
    whole = np.zeros((T, s, T, s))
    for k in range(T):
        own = np.diag(prior.variance[k])
        if k:
            F = prior.transport[k - 1] * (unit / unit[:, None])
            for j in range(k):
                whole[k, :, j] = F @ whole[k - 1, :, j]
                whole[j, :, k] = whole[k, :, j].T
            own = own + F @ whole[k - 1, :, k - 1] @ F.T
        whole[k, :, k] = own
    return whole.reshape(T * s, T * s)


def dense_variance(model: NoiseModel, sigma: dict[Component, float]) -> np.ndarray:
    """V of all rows."""
    rows, side, drift, features = model.rows, model.side, model.drift, model.features
    N = len(rows.residual)
    blocks = np.zeros((N, 6, N, 6))
    blocks[np.arange(N), :, np.arange(N)] = model.white(sigma)
    E = rows.twist[side] * np.repeat([sigma[C.CARRIER_ROTATION], sigma[C.CARRIER_TRANSLATION]], 3)
    same = rows.instants.index[:, None] == rows.instants.index
    blocks += np.einsum("nij,mkj->nimk", E, E) * same[:, None, :, None]
    F = rows.twist[side] * np.repeat([sigma[C.SYSTEMATIC_ROTATION], sigma[C.SYSTEMATIC_TRANSLATION]], 3)
    blocks += np.einsum("nij,mkj->nimk", F, F) * (features @ features.T)[:, None, :, None]
    V = blocks.reshape(6 * N, 6 * N)
    if drift is not None:
        states = dense_drift(drift, sigma).reshape(rows.instants.count, drift.states, rows.instants.count, -1)
        G, at = drift_columns(rows, sigma, drift), rows.instants.index
        states = states[at][:, :, at]
        V = V + np.einsum("nia,namb,mjb->nimj", G, states, G, optimize=True).reshape(6 * N, 6 * N)
    return V


@pytest.mark.parametrize("side", ["targetcarrier", "sensorcarrier"])
@pytest.mark.parametrize("correlation", [None, 0.8, 1.0])
@pytest.mark.parametrize("whose", ["own", "of A"])
@pytest.mark.parametrize(("targets", "sensors", "shared"), [(1, 1, True), (2, 2, True), (2, 1, False), (4, 1, True)])
def test_it_is_that_of_dense_matrices(
    targets: int, sensors: int, shared: bool, whose: str, correlation: float | None, side: About
) -> None:
    rows, *_ = rows_of(problem_of(targets, sensors, 8, scale="shared", shared=shared))
    # without one frame, nothing is free
    size = rows.jacobian.shape[2]
    frame: DriftFrame = side if whose == "of A" else "sensor" if side == "targetcarrier" else "target"
    rows = rows.in_one_track() if whose == "of A" else rows
    drift = None if correlation is None else DriftPrior.of(rows, Walk(correlation, frame))
    chance = np.random.default_rng(1)
    root = chance.normal(size=(size, size))
    prior, gradient = root @ root.T, chance.normal(size=(size,))
    features = rows.features(side)[:, :3]
    model = NoiseModel(rows, side, np.eye(size), prior, gradient, drift, features)
    found = model.evaluate(SIGMA)

    V = dense_variance(model, SIGMA)
    inverse = np.linalg.inv(V)
    J, r = rows.jacobian.reshape(len(V), -1), rows.residual.ravel()
    information = J.T @ inverse @ J + prior
    g = J.T @ inverse @ r + gradient
    expected = np.linalg.slogdet(V)[1] + np.linalg.slogdet(information)[1] + r @ inverse @ r
    expected -= g @ np.linalg.solve(information, g)
    assert found.minus_two_log == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(information), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.step, -np.linalg.solve(information, g), rtol=1e-6, atol=1e-9)


def model_of(targets: int, sensors: int, shared: bool, correlation: float | None, side: About) -> NoiseModel:
    """With covariances stated, full ones, and some measurements of the last instants left out."""
    problem = problem_of(targets, sensors, 9, scale="shared", shared=shared, missing=2)
    rows, *_ = rows_of(problem)
    chance = np.random.default_rng(2)
    skewed = np.eye(6) + 0.2 * chance.normal(size=rows.given.shape)
    rows = replace(rows, given=skewed @ skewed.transpose(0, 2, 1))
    size = rows.jacobian.shape[2]
    root = chance.normal(size=(size, size))
    drift = (
        None
        if correlation is None
        else DriftPrior.of(rows, Walk(correlation, "sensor" if side == "targetcarrier" else "target"))
    )
    # A basis that only scales leaves each row the columns of its own frames.
    basis = np.linalg.qr(root)[0][:, 1:] if targets < 3 else np.diag(chance.uniform(0.5, 2.0, size))
    prior, gradient = np.eye(basis.shape[1]), chance.normal(size=(basis.shape[1],))
    return NoiseModel(rows, side, basis, prior, gradient, drift, rows.features(side)[:, :3])


@pytest.mark.parametrize("side", ["targetcarrier", "sensorcarrier"])
@pytest.mark.parametrize("correlation", [None, 0.8, 1.0])
@pytest.mark.parametrize(("targets", "sensors", "shared"), [(1, 1, True), (2, 2, True), (2, 1, False), (4, 1, True)])
def test_the_gradient_is_that_of_differences(
    targets: int, sensors: int, shared: bool, correlation: float | None, side: About
) -> None:
    model = model_of(targets, sensors, shared, correlation, side)
    active = tuple(c for c in Component if correlation is not None or not c.startswith("drift"))
    sigma = SIGMA | dict.fromkeys(set(Component) - set(active), 0.0)
    gradient = model.eliminated(sigma).gradient_by(active)
    for component, found in zip(active, gradient, strict=True):
        h = 1e-4
        after, before = (model.evaluate(sigma | {component: sigma[component] * np.exp(s)}) for s in (h, -h))
        expected = (after.minus_two_log - before.minus_two_log) / (2.0 * h)
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-6), component


@pytest.mark.parametrize(
    ("correlation", "side"), [(None, "targetcarrier"), (0.8, "targetcarrier"), (1.0, "sensorcarrier")]
)
@pytest.mark.parametrize(("targets", "sensors", "shared"), [(1, 1, True), (2, 2, True), (2, 1, False), (4, 1, True)])
def test_the_average_information_is_that_of_dense_matrices(
    targets: int, sensors: int, shared: bool, correlation: float | None, side: About
) -> None:
    model = model_of(targets, sensors, shared, correlation, side)
    active = tuple(c for c in Component if correlation is not None or not c.startswith("drift"))
    sigma = SIGMA | dict.fromkeys(set(Component) - set(active), 0.0)
    found = average_information(model.eliminated(sigma), active)
    inverse = np.linalg.inv(dense_variance(model, sigma))
    J = model.rows.jacobian.reshape(len(inverse), -1) @ model.basis
    r = model.rows.residual.ravel()
    information = J.T @ inverse @ J + model.prior_information
    step = -np.linalg.solve(information, J.T @ inverse @ r + model.prior_gradient)
    P = inverse - inverse @ J @ np.linalg.solve(information, J.T @ inverse)
    columns = []
    for component in active:
        h = 1e-5
        after, before = (dense_variance(model, sigma | {component: sigma[component] * np.exp(s)}) for s in (h, -h))
        columns.append((after - before) / (2.0 * h) @ inverse @ (r + J @ step))
    expected = np.array(columns) @ P @ np.transpose(columns)
    size = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(found / size[:, None] / size, expected / size[:, None] / size, atol=1e-6)


@pytest.mark.parametrize("correlation", [0.8, 1.0])
@pytest.mark.parametrize("sensors", [1, 2])
def test_the_gradient_goes_to_zero_with_a_component(sensors: int, correlation: float) -> None:
    model = model_of(1, sensors, True, correlation, "targetcarrier")
    effects = tuple(c for c in Component if c not in (C.ROTATION, C.TRANSLATION))
    for size, most in ((1e-6, 1e-3), (1e-12, 1e-9)):
        gradient = model.eliminated(SIGMA | dict.fromkeys(effects, size)).gradient_by(effects)
        np.testing.assert_allclose(gradient, 0.0, atol=most)


def test_a_drift_of_rotation_alone_is_the_limit() -> None:
    """The transport makes translations of rotations: a drift of translation of zero must leave these."""
    model = model_of(1, 1, True, 1.0, "targetcarrier")
    none = model.eliminated(SIGMA | {C.DRIFT_TRANSLATION: 0.0})
    small = model.eliminated(SIGMA | {C.DRIFT_TRANSLATION: 1e-6})
    assert none.estimate.minus_two_log == pytest.approx(small.estimate.minus_two_log, rel=1e-6)
    by_rotation = [each.gradient_by((C.DRIFT_ROTATION,)) for each in (none, small)]
    np.testing.assert_allclose(*by_rotation, rtol=1e-5)


def test_components_may_go_to_zero() -> None:
    rows, *_ = rows_of(problem_of(count=20))
    size = rows.jacobian.shape[2]
    drift = DriftPrior.of(rows, Walk(1.0, "sensor"))
    known = np.eye(size), np.zeros((size, size)), np.zeros(size)
    with_all = NoiseModel(rows, "targetcarrier", *known, drift, rows.features("targetcarrier"))
    white = {component: 0.0 for component in Component} | {C.ROTATION: 0.01, C.TRANSLATION: 0.004}
    tiny = {component: value or 1e-12 for component, value in white.items()}
    plain = replace(with_all, drift=None).evaluate(white)
    assert with_all.evaluate(tiny).minus_two_log == pytest.approx(plain.minus_two_log, rel=1e-9)


@pytest.mark.parametrize("frame", ["sensor", "target"])
def test_a_scale_that_drifts_stretches_the_steps_that_follow_it(frame: DriftFrame) -> None:
    """A trajectory whose steps are too long from its fourth pose on, beside the states that carry this on."""
    rows = rows_of(problem_of(count=12))[0]
    poses, stretch = rows.predicted, 1e-6
    poses = se3.inverse(poses) if frame == "sensor" else poses
    motions = se3.inverse(poses[:-1]) @ poses[1:]
    motions[3:, :3, 3] *= 1.0 + stretch
    stretched = poses.copy()
    state, found = np.append(np.zeros(6), stretch), [np.zeros(6)] * 4
    for k, motion in enumerate(motions):
        stretched[k + 1] = stretched[k] @ motion
        if k >= 3:
            state = DriftPrior.of(rows, Walk(1.0, frame)).transport[k] @ state
            found.append(-state[:6])  # the sign of a scale's logarithm is nobody's
    expected = se3.logmap(se3.inverse(poses) @ stretched)
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())
