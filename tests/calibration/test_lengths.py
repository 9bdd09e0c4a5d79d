"""Lengths that no rig has are found, and what no data can tell is said."""

from __future__ import annotations

import numpy as np
import pytest
from misread_problems import KINDS_OF_GRAPHS, Kind, in_millimetres, misread

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import misreadings
from gtsam_rwhec.calibration.other_readings import Mistake
from gtsam_rwhec.calibration.sizes import doubted_lengths, undetectable
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(0.003, 0.5 / np.radians(0.3) ** 2)
BOTH = Kind("both in millimetres", Mistake.UNIT, "", in_millimetres, in_millimetres)


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.UnitsWarning", "ignore::gtsam_rwhec.errors.WeightsWarning")
def test_millimetres_in_both_are_seen_in_the_lengths_alone() -> None:
    good = general(2, 1, seed=0, noise=NOISE).problem
    assert not doubted_lengths(good, rw.solve(good))
    wrong = misread(good, BOTH)
    solution = rw.solve(wrong)
    assert misreadings(wrong, solution) == ()
    found = doubted_lengths(wrong, solution)
    assert found.startswith("targets are seen from ")
    assert " m and targets and sensors are " in found
    assert "divide both by 1000" in found


def test_a_distant_origin_is_no_doubt() -> None:
    good = general(2, 1, seed=0, noise=NOISE).problem
    far = rw.Problem()
    T = np.eye(4)
    T[:3, 3] = [2e5, -1e6, 3e5]
    for pair in good.pairs:
        raw = good.measurements(*pair)
        far.add(*pair, raw.A @ T, raw.B, raw.sigma, raw.kappa)
    assert not doubted_lengths(far, rw.solve(far))


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.WeightsWarning")
def test_one_pair_cannot_tell_whether_both_are_inverted_and_two_can() -> None:
    one = general(1, 1, seed=0, noise=NOISE).problem
    assert any("both inverted" in each for each in undetectable(one))
    inverted = misread(one, KINDS_OF_GRAPHS[0])
    assert misreadings(inverted, rw.solve(inverted)) == ()
    two = general(1, 2, seed=0, noise=NOISE).problem
    assert not any("both inverted" in each for each in undetectable(two))
    assert all("data cannot tell" in each for each in undetectable(two))
