"""The linear model of evidence: against differences, its own sums, and a true refit without a measurement."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from refinement_problems import rig

import gtsam_rwhec as rw
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.contribution import contribution_of
from gtsam_rwhec.results.linear_model import LinearModel, MeasuredRows, inverse_of, measured_rows
from gtsam_rwhec.results.residual_evidence import residuals_of


@pytest.fixture(scope="module")
def calibrated() -> tuple[rw.Calibration, dict[Pair, MeasuredRows]]:
    problem = rig().problem
    calibration = rw.calibrate(problem)
    return calibration, dict(measured_rows(problem, calibration))


def model_of(calibrated: tuple[rw.Calibration, dict[Pair, MeasuredRows]]) -> LinearModel:
    model = LinearModel.of(calibrated[1], calibrated[0])
    assert model is not None
    return model


def residual(calibration: rw.Calibration, of: MeasuredRows, i: int, X: gtsam.Pose3, Y: gtsam.Pose3) -> np.ndarray:
    predicted = Y.inverse().compose(gtsam.Pose3(of.A[i])).compose(X)
    assert isinstance(calibration.scale, float)
    predicted = gtsam.Pose3(predicted.rotation(), calibration.scale * predicted.translation())
    return np.asarray(gtsam.Pose3.Logmap(predicted.between(gtsam.Pose3(of.B[i]))))


def test_residuals_and_derivatives_are_those_by_differences(
    calibrated: tuple[rw.Calibration, dict[Pair, MeasuredRows]],
) -> None:
    calibration, rows = calibrated
    model = model_of(calibrated)
    for number, pair in enumerate(model.pairs):
        X, Y, of = calibration.X[pair.target], calibration.Y[pair.sensor], rows[pair]
        at = np.flatnonzero(model.pair == number)[0]
        there = residual(calibration, of, 0, X, Y)
        np.testing.assert_allclose(model.residual[at], there, atol=1e-12)
        for k in range(6):
            step = 1e-6 * np.eye(6)[k]
            by_X = (residual(calibration, of, 0, X.retract(step), Y) - there) / 1e-6
            by_Y = (residual(calibration, of, 0, X, Y.retract(step)) - there) / 1e-6
            # To first order in the residual itself too.
            np.testing.assert_allclose(-model.J[at, :, k], by_X, atol=3.0 * np.abs(there).max())
            np.testing.assert_allclose(-model.J[at, :, 6 + k], by_Y, atol=3.0 * np.abs(there).max() * 2.0)


def test_shares_add_up_to_one_and_curves_fall(calibrated: tuple[rw.Calibration, dict[Pair, MeasuredRows]]) -> None:
    found = contribution_of(model_of(calibrated))
    assert found is not None
    assert sum(found.shares) == pytest.approx(1.0, abs=1e-5)
    assert list(found.shares) == sorted(found.shares, reverse=True)
    assert (np.diff(found.curve) <= 1e-9).all()
    assert found.curve[-1] == pytest.approx(0.0, abs=1e-3)
    assert [one.bundles for one in found.fewer] == sorted((one.bundles for one in found.fewer), reverse=True)


def test_what_an_image_moves_is_what_a_refit_without_it_moves(
    calibrated: tuple[rw.Calibration, dict[Pair, MeasuredRows]],
) -> None:
    """One linear step with all, and one without the image: the difference is what leave-one-out says."""
    model = model_of(calibrated)
    found = contribution_of(model)
    assert found is not None
    one = found.influential[0]
    assert model.stamps_ns is not None
    mine = model.used & (model.stamps_ns == one.stamp_ns)
    mine &= np.array([pair.sensor == one.sensor for pair in model.pairs])[model.pair]
    r, J = model.whitened()
    whole = inverse_of(model.information(J, model.used)) @ model.gradient(J, r, model.used)
    rest = model.used & ~mine
    without = inverse_of(model.information(J, rest)) @ model.gradient(J, r, rest)
    # The formula is about the optimum; the answer is near it, so the step with all is taken off first.
    at_optimum = r - np.einsum("nij,nj->ni", J, np.append(whole, 0.0)[model.places])
    moved = inverse_of(model.information(J, rest)) @ model.gradient(J, at_optimum, rest)
    np.testing.assert_allclose(without - whole, moved, atol=1e-12)
    by = moved[model.frames[one.moved_frame]]
    assert 1e3 * np.linalg.norm(by[3:]) == pytest.approx(one.moved_mm, rel=0.5)
    covariance = inverse_of(model.information(J, model.used)), inverse_of(model.information(J, rest))
    growth = np.sqrt(np.diagonal(covariance[1]) / np.diagonal(covariance[0])).max() - 1.0
    assert growth == pytest.approx(one.growth, rel=1e-9)


def test_residuals_are_as_large_as_their_noise(calibrated: tuple[rw.Calibration, dict[Pair, MeasuredRows]]) -> None:
    found = residuals_of(model_of(calibrated), calibrated[0])
    assert 0.9 < found.spread < 1.1
    assert found.beyond_3 < 0.02
    assert sum(pair.used for pair in found.pairs) == found.measurements
    for one in found.hold_out:
        assert one.held_out_mm > one.fitted_mm
        assert one.held_out_deg > 0.95 * one.fitted_deg


def test_without_covariances_there_is_no_model(calibrated: tuple[rw.Calibration, dict[Pair, MeasuredRows]]) -> None:
    calibration, rows = calibrated
    assert LinearModel.of(rows, replace(calibration, refined=None)) is None
