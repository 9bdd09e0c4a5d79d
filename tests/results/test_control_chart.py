"""The control chart: its statistic against likelihoods written out, false alarms, the date and frame of a change."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag, cho_factor, cho_solve

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.results.control_chart import Alarm, Chart, checked_rate, drifts, judge_night, limit_of, shifts, steps
from gtsam_rwhec.results.nights import MOST_NIGHTS, Nights, Spread, SpreadPool

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


def alarms_of(x: np.ndarray, rate: float = 1e-3, groups: dict[str, slice] = GROUPS) -> list[tuple[int, Alarm]]:
    chart, found = Chart(Nights.none(groups)), []
    one = np.eye(x.shape[1])
    for night, numbers in enumerate(x):
        chart, _, alarm = chart.next(float(night), numbers, one, Spread(), rate)
        if alarm is not None:
            found.append((night, alarm))
    return found


def moved(first: int, size: float, nights: int = 20, seed: int = 0, rows: slice = GROUPS["cam"]) -> np.ndarray:
    x = np.random.default_rng(seed).standard_normal((nights, 12))
    x[first:, rows] += size / np.sqrt(rows.stop - rows.start)
    return x


@pytest.mark.parametrize(
    ("robots", "fewest", "most"), [(12, 0, 9), pytest.param(60, 6, 26, marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_false_alarms_are_as_many_as_stated(robots: int, fewest: int, most: int) -> None:
    x = np.random.default_rng(7).standard_normal((robots, 26, 6))
    alarms = sum(not alarm.is_back for robot in x for _, alarm in alarms_of(robot, 0.01, {"cam": slice(0, 6)}))
    assert fewest <= alarms <= most  # 15 are expected of 1,500 nights; benchmarks/fleet_drift.py counts many more


def test_a_step_has_its_date_its_frame_and_its_size() -> None:
    [(night, alarm)] = alarms_of(moved(14, 8.0))
    found = alarm.found
    assert (night, alarm.nights.days[found.first], found.groups, found.is_of_all) == (14, 14.0, ("cam",), False)
    assert not alarm.is_back
    assert np.linalg.norm(found.change["cam"]) == pytest.approx(8.0, abs=2.5)
    assert found.deviations["cam"] == pytest.approx(8.0, abs=2.5)


def test_a_small_step_is_dated_from_later_nights() -> None:
    [(night, alarm)] = alarms_of(moved(10, 3.0, seed=1))
    assert night > 10
    assert abs(alarm.nights.days[alarm.found.first] - 10.0) <= 1.0
    assert alarm.found.earliest <= alarm.found.first <= alarm.found.latest


def test_all_frames_that_move_are_named() -> None:
    [(_, alarm)] = alarms_of(moved(12, 12.0, rows=slice(0, 12)))
    assert set(alarm.found.groups) == {"cam", "board"}
    assert alarm.found.is_of_all


def test_a_drift_is_told_from_a_step() -> None:
    x = np.random.default_rng(3).standard_normal((30, 12))
    x[10:, :6] += 0.25 * np.arange(1, 21)[:, None]
    first = alarms_of(x)[0][1]
    assert first.found.kind == "drift"
    assert first.found.groups == ("cam",)
    assert alarms_of(moved(14, 4.0, seed=5))[0][1].found.kind != "drift"


def test_nights_that_were_off_end_with_a_return() -> None:
    x = moved(14, 9.0, nights=24)
    x[17:, :6] -= 9.0 / np.sqrt(6.0)
    (first, alarm), (second, back) = alarms_of(x)
    assert (first, second) == (14, 17)
    assert (alarm.is_back, back.is_back) == (False, True)


def test_the_spread_of_nights_is_found_beside_what_was_stated() -> None:
    generator = np.random.default_rng(0)
    pool, one = SpreadPool(), np.eye(6)
    for robot in range(40):
        errors = generator.standard_normal((20, 6))
        for i in range(1, 20):
            errors[i] = 0.5 * errors[i - 1] + np.sqrt(0.75) * errors[i]
        errors *= np.sqrt(3.0)
        errors[10:] += 30.0  # one step, which does not count
        for lag in (1, 2):
            for i in range(lag, 20):
                pool.add(robot, lag, errors[i] - errors[i - lag], 2.0 * one)
    found = pool.found()
    assert found.variance == pytest.approx(3.0, rel=0.12)
    assert found.correlation == pytest.approx(0.5, abs=0.06)
    spread = found.of_robot(3)
    assert spread.variance == pytest.approx(3.0, rel=0.12)
    assert spread.freedom > 50.0


def test_without_nights_the_stated_covariances_rule() -> None:
    found = SpreadPool().found()
    assert (found.variance, found.correlation) == (1.0, 0.0)
    assert found.of_robot(0).freedom < 10.0
