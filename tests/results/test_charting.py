"""The chart of one series: false alarms, the date and the frame of a planted change, a return, a drift."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.results.control_chart import Alarm, Chart
from gtsam_rwhec.results.nights import Nights, Spread, SpreadPool

GROUPS = {"cam": slice(0, 6), "board": slice(6, 12)}


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
