from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam import noiseModel
from rwhec_factors import noise_models


def robust(model: noiseModel.Base) -> noiseModel.Robust:
    return noiseModel.Robust.Create(noiseModel.mEstimator.Huber.Create(1.345), model)


REFUSED = {
    "Constrained": (noiseModel.Constrained.All(6), "standard deviation of zero"),
    "a zero sigma": (noiseModel.Diagonal.Sigmas(np.r_[0.0, np.ones(5)]), "standard deviation of zero"),
    "isotropic zero": (noiseModel.Isotropic.Sigma(6, 0.0), "standard deviation of zero"),
    "robust over Constrained": (robust(noiseModel.Constrained.All(6)), "standard deviation of zero"),
    "NaN": (noiseModel.Diagonal.Sigmas(np.r_[np.nan, np.ones(5)]), "entries that are NaN"),
    "infinite sigma": (noiseModel.Diagonal.Sigmas(np.r_[np.inf, np.ones(5)]), "singular"),
    "no information": (noiseModel.Gaussian.SqrtInformation(np.diag([0.0, 1, 1, 1, 1, 1])), "singular"),
    "dimension": (noiseModel.Unit.Create(3), "dimension 3; it should have 6"),
    "robust dimension": (robust(noiseModel.Unit.Create(3)), "dimension 3; it should have 6"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_noise_that_a_factor_cannot_hold_is_refused(name: str) -> None:
    model, words = REFUSED[name]
    with pytest.raises(ValueError, match=words):
        noise_models.checked(model, 6, "B")


@pytest.mark.parametrize("model", [None, 0.1, np.eye(6)])
def test_a_value_that_is_not_a_noise_model_is_a_type_error(model: object) -> None:
    with pytest.raises(TypeError, match=r"give a gtsam\.noiseModel of dimension 6"):
        noise_models.checked(model, 6, "B")


@pytest.mark.parametrize(
    "model",
    [
        noiseModel.Unit.Create(6),
        noiseModel.Isotropic.Sigma(6, 0.1),
        noiseModel.Diagonal.Sigmas(np.r_[1e-6, 1e-6, 1e-6, 1e3, 1e3, 1e3]),
        noiseModel.Gaussian.Covariance(np.eye(6) + 0.3),
        robust(noiseModel.Gaussian.Covariance(np.eye(6) + 0.3)),
    ],
)
def test_valid_noise_is_kept_as_it_is(model: noiseModel.Base) -> None:
    assert noise_models.checked(model, 6, "B") is model


def test_chordal_rows_have_root_two_of_the_rotations_sigma() -> None:
    rows = noise_models.chordal(noiseModel.Diagonal.Sigmas(np.r_[0.1, 0.1, 0.1, 0.3, 0.3, 0.3]), "B")
    np.testing.assert_allclose(rows.sigmas(), np.r_[np.full(9, np.sqrt(2.0) * 0.1), np.full(3, 0.3)])
    with_loss = noise_models.chordal(robust(noiseModel.Isotropic.Sigma(6, 0.2)), "B")
    assert isinstance(with_loss, noiseModel.Robust)
    assert isinstance(with_loss.robust(), noiseModel.mEstimator.Huber)
    np.testing.assert_allclose(with_loss.noise().sigmas(), np.r_[np.full(9, np.sqrt(2.0) * 0.2), np.full(3, 0.2)])


@pytest.mark.parametrize(
    "covariance", [np.diag([1.0, 1.0, 2.0, 1.0, 1.0, 1.0]), np.diag([1.0, 1.0, 1.0, 1.0, 2.0, 1.0]), np.eye(6) + 0.1]
)
def test_anisotropic_noise_is_refused_by_the_chordal_residual(covariance: np.ndarray) -> None:
    with pytest.raises(ValueError, match="anisotropic"):
        noise_models.chordal(noiseModel.Gaussian.Covariance(covariance), "B")


def test_the_factor_that_the_error_advises_exists() -> None:
    assert hasattr(gtsam, "NonlinearEqualityPose3")
