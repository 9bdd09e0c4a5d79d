"""Is a sensor's clock late? A test on the residuals of a calibration that takes every stamp as right.

A clock that is off by d moves A by d times the carrier's velocity, so it leaves v d in the residuals. The part of v
that the poses and scales cannot take up is v~; then d^ = -v~'r / v~'v~ (the score test's one step). Its variance comes
from the scores of contiguous blocks of time, so residuals that are correlated in time do not make it too small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from gtsam_rwhec.errors import CountError, OptionError, TransformError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.free_space import free_offsets
from gtsam_rwhec.refinement.geodesic import linearized
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.pair_data import PairData, local_paths
from gtsam_rwhec.refinement.refined import RefinedPoses
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind
from gtsam_rwhec.refinement.variables import State, Variables
from gtsam_rwhec.refinement.variance_components import jacobian_of
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: The scores are summed over so many blocks of time.
BLOCKS = 20
#: With fewer measurements no offset is looked for.
FEWEST = 2 * BLOCKS
#: An offset is found if chance exceeds it with at most this probability.
CHANCE = 1e-3
#: The Jacobian of all measurements may have this many numbers: 160 MB.
MOST_NUMBERS = 20_000_000


@dataclass(frozen=True)
class ClockTest:
    """What the residuals say of a sensor's clock; ``str()`` is a sentence's part.

    Attributes
    ----------
    sensor : str
    offset_s, sigma_s : float
        One step's estimate of the offset, and its standard deviation over blocks of time.
    is_late : bool
        Whether the offset is more than chance.
    """

    sensor: str
    offset_s: float
    sigma_s: float
    is_late: bool

    def __str__(self) -> str:
        return f"{1e3 * self.offset_s:+.2g} ± {1e3 * self.sigma_s:.2g} ms for {self.sensor}"


def clocks_of(
    problem: Problem, refined: RefinedPoses, path: Trajectory | None = None
) -> tuple[tuple[ClockTest, ...], dict[str, str]]:
    """Test every sensor's clock; for sensors without a test, by name, why there is none.

    Parameters
    ----------
    problem : Problem
        The measurements that count.
    refined : RefinedPoses
        Their calibration without time offsets.
    path : Trajectory, optional
        The carriers' poses over time, if they were logged faster than the measurements were made.
    """
    tests: list[ClockTest] = []
    without: dict[str, str] = {}
    for sensor in problem.sensors:
        found = _test_of(problem, refined, sensor, path)
        if isinstance(found, ClockTest):
            tests.append(found)
        else:
            without[sensor] = found
    return tuple(tests), without


def _test_of(problem: Problem, refined: RefinedPoses, sensor: str, path: Trajectory | None) -> ClockTest | str:
    """The test of one sensor's clock, or why there is none."""
    pairs = [pair for pair in problem.pairs if pair.sensor == sensor]
    if any(pair.is_motion for pair in pairs):
        return "it has motions of its own"
    if any(problem.measurements(*pair).stamps_ns is None for pair in pairs):
        return "it has no stamps"
    if sum(problem.moments(*pair).count for pair in pairs) < FEWEST:
        return f"it has fewer than {FEWEST} measurements"
    variables = Variables.of(problem, (sensor,))
    size = sum(unknown.dimension for unknown in variables.unknowns)
    if 6 * problem.number_of_measurements * size > MOST_NUMBERS:
        return "there are too many measurements for the test"
    try:
        paths = local_paths(problem, (sensor,), path)
    except (CountError, OptionError, TransformError):
        return "the carriers' velocity at its stamps is unknown"
    data = [PairData.of(problem, pair, RefineOptions(), paths.get(pair)) for pair in problem.pairs]
    standing, _ = free_offsets(data, variables)
    if standing:
        return "the carriers moved no faster than the noise of their poses makes it seem"
    r, J, measurement, stamps = _stacked(data, variables, _state_of(refined, variables, sensor))
    offset = np.zeros(size, dtype=bool)
    unknowns = variables.unknowns
    ends = np.cumsum([unknown.dimension for unknown in unknowns])
    offset[ends[unknowns.index(Unknown(UnknownKind.TIME_OFFSET, sensor))] - 1] = True
    both = np.column_stack([J[:, offset][:, 0], r])
    rest = both - J[:, ~offset] @ np.linalg.lstsq(J[:, ~offset], both, rcond=1e-9)[0]
    v, r = rest.T
    information = float(v @ v)
    if information <= 1e-12 * float(both[:, 0] @ both[:, 0]):
        return "the poses take up what an offset would do"
    scores = np.bincount(measurement, weights=v * r, minlength=len(stamps))
    block = np.empty(len(stamps), dtype=np.int64)
    moved = np.bincount(measurement, weights=v * v, minlength=len(stamps))
    order = np.argsort(stamps, kind="stable")
    # Blocks of equal information: standstill says nothing of a clock.
    block[order] = np.minimum((np.cumsum(moved[order]) / information * BLOCKS).astype(np.int64), BLOCKS - 1)
    estimate = -float(scores.sum()) / information
    centred = scores + estimate * moved  # what is left of each score at the estimate
    sums = np.bincount(block, weights=centred, minlength=BLOCKS)
    sigma = float(np.sqrt(BLOCKS / (BLOCKS - 1.0) * (sums**2).sum())) / information
    quantile = float(stdtrit(BLOCKS - 1, 1.0 - 0.5 * CHANCE))
    return ClockTest(sensor, estimate, sigma, abs(estimate) > quantile * sigma)


def _state_of(refined: RefinedPoses, variables: Variables, sensor: str) -> State:
    of = refined.scale
    scales = {u: of[u.owner] if isinstance(of, dict) else float(of) for u in variables.scales}
    return State(dict(refined.X), dict(refined.Y), scales, {sensor: 0.0})


def _stacked(data: list[PairData], variables: Variables, state: State) -> tuple[Array, Array, np.ndarray, np.ndarray]:
    """Whitened residuals (6 N,) and Jacobian (6 N, d) of all measurements, the measurement of each row, its stamp."""
    size = sum(unknown.dimension for unknown in variables.unknowns)
    layout = JointCovariance.of(variables.unknowns, np.eye(size), np.zeros((size, 0)), np.ones(size))
    at = linearized(data, variables, state)
    residuals, jacobians, stamps = [], [], []
    for item in data:
        linear = at[item.pair]
        deviation = np.sqrt(np.einsum("nii->ni", item.covariance).reshape(-1, 2, 3).mean(axis=2)).repeat(3, axis=1)
        own, rows = jacobian_of(item.pair, linear, variables, layout)
        J = np.zeros((item.count, 6, size))
        J[:, :, rows] = own / deviation[:, :, None]
        residuals.append(linear.residual / deviation)
        jacobians.append(J)
        stamps.append(np.zeros(item.count, dtype=np.int64) if item.stamps_ns is None else item.stamps_ns)
    r, J = np.concatenate(residuals), np.concatenate(jacobians)
    # Rotations and translations by what the residuals show, whatever was stated.
    scale = np.sqrt((r**2).reshape(-1, 2, 3).mean(axis=(0, 2))).repeat(3)
    scale = np.maximum(scale, 1e-300)
    number = len(r)
    return (
        (r / scale).reshape(-1),
        (J / scale[:, None]).reshape(6 * number, size),
        np.repeat(np.arange(number), 6),
        np.concatenate(stamps),
    )
