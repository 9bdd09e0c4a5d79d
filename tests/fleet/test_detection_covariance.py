"""Covariances of answers from moments hold where detections know some axes far better than others."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fleet.detection_covariance import with_covariances_of_detections
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Noise, general

#: A tag from one metre: its tilt, and its distance along the ray, are known ten times worse than the rest.
TAG = np.diag(np.array([0.03, 0.03, 0.003, 3e-4, 3e-4, 3e-3]) ** 2)
RUNS = 40


def seen(seed: int, covariance: Array) -> tuple[rw.Calibration, dict[str, Array], rw.Calibration]:
    """A calibration from moments, the truth, and the calibration with the measurements' covariances."""
    made = general(2, 1, seed=3, number_of_measurements=30, noise=Noise(1e-9, 1e14))
    rng = np.random.default_rng(seed)
    problem, moments, covariances = rw.Problem(), rw.Problem(keep_measurements=False), {}
    for pair in made.problem.pairs:
        raw = made.problem.measurements(*pair)
        B = raw.B @ se3.expmap(rng.multivariate_normal(np.zeros(6), covariance, len(raw.B)))
        for one in (problem, moments):
            one.add(*pair, raw.A, B)
        covariances[pair] = np.tile(7.0 * covariance, (len(B), 1, 1))  # known up to a factor
    truth = made.X | made.Y
    plain = rw.calibrate(moments)
    return plain, truth, with_covariances_of_detections(plain, problem, covariances)


def squares(found: rw.Calibration, truth: dict[str, Array]) -> Array:
    """Squared errors over their variances along the covariance's own axes, the best known first."""
    refined = found.refined
    assert refined is not None
    poses = {name: pose.matrix() for name, pose in (refined.X | refined.Y).items()}
    error = np.concatenate([se3.logmap(se3.inverse(poses[name][None]) @ truth[name])[0] for name in truth])
    variances, axes = np.linalg.eigh(refined.covariance(*truth))
    result: Array = (axes.T @ error) ** 2 / variances
    return result


def test_each_axis_is_as_far_off_as_the_covariance_says() -> None:
    plain, given = [], []
    for seed in range(RUNS):
        of_moments, truth, found = seen(seed, TAG)
        plain.append(squares(of_moments, truth))
        given.append(squares(found, truth))
    by_axis = np.mean(given, axis=0)  # a chi-square of 40 over 40: a deviation of 0.22
    assert by_axis.max() < 2.0
    assert by_axis.min() > 0.4
    assert 0.8 < by_axis.mean() < 1.25
    alone = np.mean(plain, axis=0)  # of moments alone: the shape is wrong
    assert alone.max() / alone.min() > 5.0


def test_alike_axes_change_nothing_but_the_noise_of_its_estimate() -> None:
    alone, truth, found = seen(1, np.diag(np.r_[np.full(3, 0.01), np.full(3, 0.001)] ** 2))
    assert alone.refined is not None
    assert found.refined is not None
    names = tuple(truth)
    ratio = np.sqrt(np.diagonal(found.refined.covariance(*names)) / np.diagonal(alone.refined.covariance(*names)))
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


def test_without_covariances_of_every_pair_nothing_changes() -> None:
    alone, _, _ = seen(2, TAG)
    assert with_covariances_of_detections(alone, rw.Problem(), {}) is alone
