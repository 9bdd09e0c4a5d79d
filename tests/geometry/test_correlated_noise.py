"""Noise that is correlated in time: its weights against dense matrices, and its likelihood."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.geometry.correlated_noise import CorrelatedNoise, likeliest

SECONDS = np.sort(np.random.default_rng(0).uniform(0.0, 20.0, 300))


@pytest.mark.parametrize(("share", "constant"), [(0.0, 1.0), (0.3, 0.5), (0.95, 5.0), (0.9999, 200.0)])
def test_weights_are_the_inverse_of_the_covariance(share: float, constant: float) -> None:
    noise = CorrelatedNoise(share, constant)
    covariance = share * np.exp(-np.abs(SECONDS[:, None] - SECONDS) / constant) + (1.0 - share) * np.eye(300)
    columns = np.random.default_rng(1).normal(size=(300, 2))
    weighted, determinant = noise.weighted(SECONDS, columns)
    np.testing.assert_allclose(covariance @ weighted, columns, atol=1e-7)
    assert determinant == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-9, abs=1e-9)


def test_tracks_are_independent_of_one_another() -> None:
    noise, columns, track = (
        CorrelatedNoise(0.9, 5.0),
        np.random.default_rng(1).normal(size=(300, 2)),
        np.arange(300) // 150,
    )
    parts = [noise.weighted(SECONDS[track == k], columns[track == k]) for k in range(2)]
    weighted, determinant = noise.weighted(SECONDS, columns, track)
    np.testing.assert_allclose(weighted, np.concatenate([part[0] for part in parts]), rtol=1e-9)
    assert determinant == pytest.approx(parts[0][1] + parts[1][1])


def test_equal_stamps_are_no_division_by_zero() -> None:
    weighted, determinant = CorrelatedNoise(0.5, 1.0).weighted(np.zeros(4), np.eye(4))
    assert np.isfinite(weighted).all()
    assert np.isfinite(determinant)


def test_the_likeliest_noise() -> None:
    generator = np.random.default_rng(2)
    white = generator.normal(size=(300, 3))
    walk = np.cumsum(generator.normal(size=(300, 3)) * np.sqrt(np.r_[0.0, np.diff(SECONDS)])[:, None], axis=0)
    one, two = np.zeros(300), np.repeat([0.0, 1.0], 300)
    assert likeliest(SECONDS, white, one)[0].share == 0.0
    found = likeliest(np.tile(SECONDS, 2), np.concatenate([walk, walk[:, ::-1]]), two)[0]
    assert found.share > 0.9
    assert found.time_constant_s >= 20.0
    both = likeliest(SECONDS, 0.3 * white + walk, one)[0]
    assert 0.0 < both.share < 1.0
