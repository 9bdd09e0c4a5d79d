"""The test for a change: chances, groups, what is free, and what explains."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, f

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.results.change_test import ChangeTest, change_test

NOTHING_FREE = np.zeros((12, 0))
GROUPS = {"camera": slice(0, 6), "board": slice(6, 12)}


def covariance_of(seed: int, size: int = 12) -> np.ndarray:
    """A covariance with correlations."""
    root = np.random.default_rng(seed).standard_normal((size, size + 2))
    return root @ root.T


def compared(difference: np.ndarray, free: np.ndarray = NOTHING_FREE, freedom: float = np.inf) -> ChangeTest:
    return change_test(difference, (covariance_of(0), covariance_of(1)), free, GROUPS, (freedom, freedom))


def test_the_joint_statistic_is_the_mahalanobis_distance_of_the_difference() -> None:
    difference = np.random.default_rng(2).standard_normal(12)
    found = compared(difference)
    square = difference @ np.linalg.solve(covariance_of(0) + covariance_of(1), difference)
    assert found.deviations**2 == pytest.approx(square)
    assert found.joint_chance == pytest.approx(chi2.sf(square, 12))


def test_a_group_is_compared_by_its_own_covariance_with_its_correlations() -> None:
    difference = np.random.default_rng(2).standard_normal(12)
    own = (covariance_of(0) + covariance_of(1))[6:, 6:]
    assert compared(difference).groups["board"].deviations ** 2 == pytest.approx(
        difference[6:] @ np.linalg.solve(own, difference[6:])
    )


def test_one_group_alone_has_the_chance_of_its_own_square() -> None:
    C = covariance_of(3, 6)
    difference = np.linalg.cholesky(2.0 * C) @ np.r_[4.5, np.zeros(5)]
    found = change_test(difference, (C, C), np.zeros((6, 0)), {"camera": slice(0, 6)}, (np.inf, np.inf))
    assert found.chance == pytest.approx(chi2.sf(4.5**2, 6))
    assert found.has_changed
    assert found.changed == ("camera",)


def test_noise_that_was_estimated_makes_chances_larger() -> None:
    difference = 6.0 * np.random.default_rng(2).standard_normal(12)
    found = compared(difference, freedom=20.0)
    shares = 1.0 / found.degrees_of_freedom
    assert 1.0 / 40.0 <= shares <= 1.0 / 20.0  # Welch and Satterthwaite: between both and one of them
    assert found.joint_chance == pytest.approx(f.sf(found.deviations**2 / 12, 12, found.degrees_of_freedom))
    assert found.joint_chance > compared(difference).joint_chance


def test_a_change_along_a_free_direction_is_none() -> None:
    free = np.random.default_rng(4).standard_normal((12, 2))
    difference = np.random.default_rng(5).standard_normal(12)
    moved = difference + 100.0 * free @ [1.0, -2.0]
    assert compared(moved, free).dimension == 10
    assert compared(moved, free).deviations == pytest.approx(compared(difference, free).deviations, rel=1e-6)


def test_the_group_that_explains_everything_is_named() -> None:
    C = covariance_of(0) + covariance_of(1)
    difference = np.zeros(12)
    difference[:6] = 6.0 * np.linalg.cholesky(C[:6, :6])[:, 0]
    found = compared(difference)
    assert found.changed == ("camera",)
    assert found.groups["camera"].explains
    assert not found.groups["board"].explains


def test_chances_are_corrected_for_their_number_as_holm_does() -> None:
    found = compared(np.random.default_rng(6).standard_normal(12))
    ordered = sorted(found.groups.values(), key=lambda group: group.chance)
    assert ordered[0].corrected == pytest.approx(min(1.0, 2.0 * ordered[0].chance))
    assert ordered[1].corrected == pytest.approx(max(ordered[0].corrected, ordered[1].chance))


def test_the_alarm_is_raised_as_often_as_the_level_says() -> None:
    chance = np.random.default_rng(7)
    C = covariance_of(0) + covariance_of(1)
    drawn = (np.linalg.cholesky(C) @ chance.standard_normal((12, 16))).T
    found = [change_test(d, (C, 0.0 * C), NOTHING_FREE, GROUPS, (np.inf, np.inf), level=0.5) for d in drawn]
    assert 2 <= sum(one.has_changed for one in found) <= 14  # 8 of 16, within three deviations


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1, "0.01", float("nan"), True])
def test_levels_that_are_none_are_refused(level: object) -> None:
    with pytest.raises(OptionError, match="give one between 0 and 1"):
        change_test(np.zeros(12), (covariance_of(0),) * 2, NOTHING_FREE, GROUPS, (np.inf, np.inf), level)  # type: ignore[arg-type]
