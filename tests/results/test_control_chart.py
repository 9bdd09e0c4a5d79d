"""The control chart's statistic: against the likelihoods written out, in other units, with nights that lack frames."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag, cho_factor, cho_solve

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.results.control_chart import checked_rate, drifts, judge_night, limit_of, shifts, steps
from gtsam_rwhec.results.nights import MOST_NIGHTS, Nights, Spread

GROUPS = {"cam": slice(0, 6), "board": slice(6, 12)}
KNOWN = Spread()


def covariances(n: int, generator: np.random.Generator) -> np.ndarray:
    root = generator.standard_normal((n, 12, 12)) + 3.0 * np.eye(12)
    return root @ root.transpose(0, 2, 1)


def nights_of(x: np.ndarray, C: np.ndarray, groups: dict[str, slice] = GROUPS) -> Nights:
    nights = Nights.none(groups)
    for day, (one, own) in enumerate(zip(x, C, strict=True)):
        nights = nights.with_night(float(day), one, np.linalg.inv(own))
    return nights


def likelihood_ratio(x: np.ndarray, whole: np.ndarray, c: np.ndarray, rows: slice) -> float:
    """Twice the log likelihood that a change of some rows with profile c adds to an unknown baseline."""
    n, m = x.shape
    factor = cho_factor(whole)
    baseline = np.tile(np.eye(m), (n, 1))
    change = np.kron(c[:, None], np.eye(m)[:, rows])

    def squares(design: np.ndarray) -> float:
        solved = cho_solve(factor, design)
        r = x.ravel() - design @ np.linalg.solve(design.T @ solved, solved.T @ x.ravel())
        return float(r @ cho_solve(factor, r))

    return squares(baseline) - squares(np.hstack([baseline, change]))


@pytest.mark.parametrize("correlation", [0.0, 0.4])
def test_the_ratio_is_that_of_the_likelihoods(correlation: float) -> None:
    generator = np.random.default_rng(1)
    sizes = np.ones(7) if correlation else generator.uniform(0.5, 2.0, 7)
    C = sizes[:, None, None] * covariances(1, generator)
    x = generator.standard_normal((7, 12))
    nights = nights_of(x, C)
    serial = correlation ** np.abs(np.subtract.outer(np.arange(7), np.arange(7)))
    whole = np.kron(serial, C[0]) if correlation else block_diag(*C)
    for profiles in (steps(7), drifts(nights.days)):
        found = shifts(nights, profiles, correlation)
        for rows in (slice(0, 12), *GROUPS.values()):
            expected = [likelihood_ratio(x, whole, c, rows) for c in profiles]
            np.testing.assert_allclose(found.ratios(rows)[0], expected, rtol=1e-9)
    assert found.dimensions == 6 * 12


def test_other_axes_and_units_change_nothing() -> None:
    generator = np.random.default_rng(2)
    C, x = covariances(6, generator), generator.standard_normal((6, 12))
    units = np.diag([30.0] * 3 + [0.2] * 3)
    J = block_diag(*(units @ np.linalg.qr(generator.standard_normal((6, 6)))[0] for _ in GROUPS))
    for spread in (KNOWN, Spread(1.3, 40.0, 0.3)):
        first = judge_night(nights_of(x, C), spread, 1e-3)
        other = judge_night(nights_of(x @ J.T + 5.0, J @ C @ J.T), spread, 1e-3)
        assert other.chance == pytest.approx(first.chance, rel=1e-6)
        assert (other.moment, other.group, other.limit) == (first.moment, first.group, first.limit)


def test_the_order_of_frames_changes_nothing() -> None:
    generator = np.random.default_rng(3)
    C, x = covariances(6, generator), generator.standard_normal((6, 12))
    swap = np.r_[6:12, 0:6]
    first = judge_night(nights_of(x, C), KNOWN, 1e-3)
    other = judge_night(
        nights_of(x[:, swap], C[:, swap[:, None], swap], {"board": slice(0, 6), "cam": slice(6, 12)}), KNOWN, 1e-3
    )
    assert (other.chance, other.group) == (pytest.approx(first.chance, rel=1e-9), first.group)


def test_what_a_night_lacks_counts_nothing() -> None:
    generator = np.random.default_rng(4)
    C, x = covariances(5, generator), generator.standard_normal((5, 12))
    both = nights_of(x, C)
    lacking = Nights.none(GROUPS)
    alone = Nights.none({"cam": slice(0, 6)})
    for day in range(5):
        information = np.zeros((12, 12))
        information[:6, :6] = np.linalg.inv(C[day, :6, :6])
        lacking = lacking.with_night(float(day), np.where(np.arange(12) < 6, x[day], 0.0), information)
        alone = alone.with_night(float(day), x[day, :6], information[:6, :6])
    tests = [judge_night(each, KNOWN, 1e-3) for each in (lacking, alone)]
    assert tests[0].chance == pytest.approx(tests[1].chance, rel=1e-9)
    assert (tests[0].moment, tests[0].limit) == (tests[1].moment, tests[1].limit)
    # The board comes at the last night: nothing of it can be compared.
    latest = lacking.until(4).with_night(4.0, x[4], np.linalg.inv(C[4]))
    found = shifts(latest, steps(5))
    assert found.ratios(GROUPS["board"])[1].tolist() == [0, 0, 0, 0]
    assert found.ratios()[1].tolist() == [6, 6, 6, 6]
    assert shifts(both, steps(5)).ratios()[1].tolist() == [12, 12, 12, 12]


def test_old_nights_count_as_one_estimate() -> None:
    generator = np.random.default_rng(5)
    C, x = covariances(MOST_NIGHTS + 3, generator), generator.standard_normal((MOST_NIGHTS + 3, 12))
    joined = nights_of(x, C)
    assert (len(joined), joined.count) == (MOST_NIGHTS, MOST_NIGHTS + 3)
    step = (np.arange(MOST_NIGHTS + 3) >= 50).astype(float)
    found = shifts(joined, step[None, 3:])
    assert found.ratios()[0][0] == pytest.approx(likelihood_ratio(x, block_diag(*C), step, slice(0, 12)), rel=1e-8)
    assert found.dimensions == 12 * (MOST_NIGHTS + 2)


def test_the_first_night_tests_nothing() -> None:
    test = judge_night(nights_of(np.zeros((1, 12)), np.eye(12)[None]), KNOWN, 1e-3)
    assert (test.chance, test.limit, test.is_alarm) == (1.0, 0.0, False)


def test_limits_fall_with_the_moments_that_are_searched() -> None:
    limits = [limit_of(n, 4, 6) for n in (2, 5, 20, 60)]
    assert limits == sorted(limits, reverse=True)
    assert limit_of(2, 1, 6) == pytest.approx(1e-3, rel=0.1)  # one moment, one test
    assert limit_of(61, 4, 6) == limit_of(600, 4, 6)
    assert 0.05 < limit_of(20, 4, 6, 1e-4) / limit_of(20, 4, 6, 1e-3) < 0.1
    assert limit_of(20, 2, 6) > limit_of(20, 3, 6) > limit_of(20, 4, 6)


@pytest.mark.parametrize("nights", [0, -5, 10, 1e9, float("nan"), "1000", None])
def test_rates_that_the_table_does_not_hold_for_are_refused(nights: object) -> None:
    with pytest.raises(OptionError, match="nights between false alarms"):
        checked_rate(nights)
