"""The limits of the control chart, from a table that ``benchmarks/chart_limits.py`` counts by Monte Carlo.

The statistic of a night is the smallest of many chances, of all moments and frames. Its limit is the rate of false
alarms over the number of independent moments that the search is worth: one at the second night, some five at the
sixtieth.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files

import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_real

#: False alarms a night of one robot: one in 1,000 nights.
RATE = 1e-3
#: Rates for which the table holds; it is counted at one in 100 and one in 1,000.
LEAST_RATE, MOST_RATE = 1e-5, 0.02


def checked_rate(nights: object) -> float:
    """The rate of one false alarm in so many nights; OptionError for what the table does not hold for."""
    if not (is_real(nights) and 1.0 / MOST_RATE <= nights <= 1.0 / LEAST_RATE):
        raise OptionError(
            f"nights between false alarms: {brief(nights)}; give {1.0 / MOST_RATE:.0f} to {1.0 / LEAST_RATE:.0f}, "
            f"such as {1.0 / RATE:.0f}"
        )
    return 1.0 / float(nights)


def limit_of(nights: int, frames: int, size: int, rate: float = RATE) -> float:
    """The limit of the statistic of a night.

    Parameters
    ----------
    nights : int
        In the chart, this one with them; at least 2.
    frames : int
        Frames that are tested alone.
    size : int
        Numbers of one frame, at most 6.
    rate : float
        False alarms a night.
    """
    logs = _logs(frames, min(size, 6))
    kept, rates = _table()[0], sorted(logs)
    at = [float(np.interp(np.log(nights), np.log(kept), logs[each])) for each in rates]
    slope = (at[1] - at[0]) / np.log(rates[1] / rates[0])
    return rate * float(np.exp(at[0] + slope * np.log(rate / rates[0])))


@cache
def _logs(frames: int, size: int) -> dict[float, Array]:
    """log(limit / rate) at the nights of the table, by rate: between its numbers of frames, or its sizes of one."""
    _, table = _table()
    found = {}
    for rate, rows in table.items():
        along = {at: row for at, row in rows.items() if at[0] == 1} if frames == 1 else rows
        axis = {(at[1] if frames == 1 else at[0]): row for at, row in along.items() if frames == 1 or at[1] == 6}
        known = sorted(axis)
        wanted = np.clip(np.log(size if frames == 1 else frames), np.log(known[0]), np.log(known[-1]))
        values = np.array([axis[each] for each in known])
        found[rate] = np.array([np.interp(wanted, np.log(known), column) for column in values.T])
    return found


@cache
def _table() -> tuple[Array, dict[float, dict[tuple[int, int], Array]]]:
    tree = json.loads(files("gtsam_rwhec.changes").joinpath("chart_limits.json").read_text("utf-8"))
    table: dict[float, dict[tuple[int, int], Array]] = {}
    for row in tree["limits"]:
        table.setdefault(row["rate"], {})[row["groups"], row["size"]] = np.log(row["ratio"])
    return np.array(tree["nights"], float), table
