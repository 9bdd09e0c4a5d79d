"""A problem that is stated by its moments: those that other processes summed, and that were merged."""

from __future__ import annotations

from collections.abc import Mapping

from gtsam_rwhec.problem.accumulation import Accumulator
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.measurements import KeptMeasurements
from gtsam_rwhec.problem.moments import Gauge, Moments
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem


def problem_of_moments(
    moments: Mapping[Pair, Moments],
    gauge: Gauge,
    scale: ScaleMode = "known",
    *,
    is_relative: bool = False,
    sensor_carrier: str | None = None,
    target_carrier: str | None = None,
) -> Problem:
    """The problem of some moments; it has no raw measurements.

    Parameters
    ----------
    moments : dict of Pair to Moments
        About `gauge`.
    gauge : Gauge
    scale : "known", "shared" or "per_target"
    is_relative : bool
        Whether the noise of some measurements was not stated.
    sensor_carrier, target_carrier : str, optional
        As for ``Problem``.

    Raises
    ------
    FrameError
        A name is that of a target and of a sensor.
    """
    problem = Problem(scale, keep_measurements=False, sensor_carrier=sensor_carrier, target_carrier=target_carrier)
    for pair in moments:
        problem._check_names(pair, pair.label)
        problem._kind |= {pair.target: "target", pair.sensor: "sensor"}  # a motion's one name is its sensor's
        problem._kept[pair] = KeptMeasurements()
    problem._accumulator = Accumulator(gauge, dict(moments))
    problem.is_relative = is_relative
    return problem
