"""Carriers that are exchanged are told from those that are not, also at a few stations."""

from __future__ import annotations

import numpy as np
import pytest
from board_by_camera import problem_of
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import Exchange, exchange_of
from gtsam_rwhec.simulate.simulated_noise import random_poses


def at_stations(number: int, *, exchanged: bool, seed: int = 0, turn: float = 1.0) -> rw.Problem:
    """A camera on a hand over a board: 0.1 degree and 1 mm, turned by up to a radian or so."""
    rng = np.random.default_rng(seed)
    X, Y = random_poses(2, 1.0, rng)
    A = se3.expmap(turn * rng.normal(size=(number, 6)) * np.repeat([1.0, 0.3], 3))
    B = np.linalg.inv(Y) @ A @ X @ se3.expmap(rng.normal(size=(number, 6)) * np.repeat([2e-3, 1e-3], 3))
    return problem_of(np.linalg.inv(A) if exchanged else A, B)


@pytest.mark.parametrize("number", [6, 12])
def test_an_exchange_is_named_and_what_is_right_is_not(number: int) -> None:
    for seed in range(5):
        found = exchange_of(at_stations(number, exchanged=True, seed=seed)).misreading
        assert found is not None
        assert found.likely.startswith("A is inverted")
        assert found.rotation_deg[1] < 0.3 < found.rotation_deg[0]
        assert exchange_of(at_stations(number, exchanged=False, seed=seed)) == Exchange()


def test_three_stations_do_not_tell() -> None:
    for exchanged in (False, True):
        assert exchange_of(at_stations(3, exchanged=exchanged)) == Exchange(is_open=True)


def test_without_a_motion_that_tells_nothing_is_said() -> None:
    """Of many stations that hardly move either reading fits: that the poses are not determined is said elsewhere."""
    assert exchange_of(at_stations(30, exchanged=True, turn=1e-4)) == Exchange()
