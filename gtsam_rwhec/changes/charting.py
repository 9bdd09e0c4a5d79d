"""The control chart of one series, night by night: alarms, and a new beginning after each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.changes.change_found import EXPLAINED, ChangeFound, change_of
from gtsam_rwhec.changes.chart_limits import RATE
from gtsam_rwhec.changes.control_chart import NightTest, Spread, judge_night, shifts
from gtsam_rwhec.changes.nights import Nights
from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True, eq=False)
class Alarm:
    """An alarm.

    Attributes
    ----------
    found : ChangeFound
        When it was, what moved, and how; its indices are of `nights`.
    nights : Nights
        Those of the chart at the alarm.
    is_back : bool
        Whether the frames are where they were before the alarm before this one: a few nights were off, and are over.
    """

    found: ChangeFound
    nights: Nights
    is_back: bool


@dataclass(frozen=True, eq=False)
class Chart:
    """The chart of one series as it stands.

    Attributes
    ----------
    nights : Nights
        Since the last change; the first of them are the reference.
    before : Nights or None
        Those between the change before it and the last one.
    """

    nights: Nights
    before: Nights | None = None

    def next(
        self, day: float, x: Array, information: Array, spread: Spread, rate: float = RATE
    ) -> tuple[Chart, NightTest, Alarm | None]:
        """The chart with one more night, what it says of it, and the alarm if there is one.

        Parameters
        ----------
        day : float
            When, days; not before the last night.
        x, information : (m,) and (m, m) arrays
            As in `Nights`.
        spread : Spread
            What the nights before this one say.
        rate : float
            False alarms a night.
        """
        nights = self.nights.with_night(day, x, information)
        test = judge_night(nights, spread, rate)
        if not test.is_alarm:
            return Chart(nights, self.before), test, None
        found = change_of(nights, test, spread)
        now = nights.after(found.first if found.kind != "drift" else max(found.first, test.moment))
        back = None if self.before is None else _joined(self.before, now, spread)
        if back is not None:
            return Chart(back), test, Alarm(found, nights, is_back=True)
        return Chart(now, nights.until(found.first)), test, Alarm(found, nights, is_back=False)


def _joined(before: Nights, now: Nights, spread: Spread) -> Nights | None:
    """Both series as one, if nothing lies between them but chance."""
    joined = before
    for day, x, information in zip(now.days, now.x, now.information, strict=True):
        joined = joined.with_night(day, x, information)
    n = len(joined)
    step = (np.arange(n) >= n - len(now)).astype(float)[None]
    found = shifts(joined, step, spread.correlation)
    ratio, size = found.ratios()
    return joined if size[0] and float(found.chances(ratio, size, spread)[0]) >= EXPLAINED else None
