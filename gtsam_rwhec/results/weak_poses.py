"""The least known direction of each frame, and the motion that would make it known better.

The motion is a thought experiment: a few more measurements of the frame with the partner that it was measured with most
often, as they would come from turning one carrier against the other by +-30 degrees about an axis of the sensor carrier
through the target, which stays in view. Each adds the information J' N^-1 J of B = Y^-1 A X,

    J = [I, -Ad(B^-1)]   by the right perturbations of X and Y,   N = the noise of B, and that of A moved to B,

to the covariance Sigma that the calibration has. Where errors are correlated, measurements tell less than that: all
that the pair has would be credited with more than the whole calibration knows. Then the largest eigenvalue of Sigma
with the sum of their information is above 1, and new ones count for one part in this eigenvalue. The same number of
measurements like those that there are is beside it, for comparison.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.fitting.fit_options import CarrierNoise
from gtsam_rwhec.fitting.refined import PairNoise, Refined
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.file_record import FileRecord, NotNegative, Triple, triple
from gtsam_rwhec.results.linear_model import MeasuredRows, derivatives, noise_of_A

Kind = Literal["translation", "rotation"]
#: The turn of the thought experiment, and how many measurements it has, half of them to each side.
TURN_RAD, MORE = np.radians(30.0), 10
#: A direction is weak if its deviation is so many times the median of all directions of all frames.
WEAK = 3.0
#: Another motion is named only if it leaves less than this share of what more of the same would leave.
BETTER = 0.9


class WeakDirection(FileRecord):
    """The least known direction of a frame, along which or about which its pose is most uncertain."""

    frame: str  #: Sensor or target
    kind: Kind  #: Along the direction, or about it
    carrier: str  #: Name of the frame's carrier
    axis: Triple  #: The direction, a unit vector in the frame's own axes; its sign is arbitrary
    axis_in_carrier: Triple  #: The same in the carrier's axes
    deviation: NotNegative  #: One standard deviation, millimetres or degrees
    least: NotNegative  #: The deviation along, or about, the frame's best known direction
    is_weak: bool  #: Whether it is more than ``WEAK`` times the median of all directions
    partner: str | None = None  #: The frame with which it was measured most often
    turn: Triple | None = None  #: The best axis to turn about, in the axes of the sensors' carrier; null: none is
    after_turning: float | None = None  #: The deviation after ten such measurements
    after_more: float | None = None  #: The deviation after ten more like those there are


def weak_directions(calibration: Calibration, rows: Mapping[Pair, MeasuredRows]) -> tuple[WeakDirection, ...]:
    """The least known directions of every frame, the least known first; empty without covariances."""
    if calibration.refined is None:
        return ()
    found = list(_directions(calibration, calibration.refined, rows))
    median = {
        kind: float(np.median([size for one, sizes in found if one.kind == kind for size in sizes]))
        for kind in {one.kind for one, _ in found}
    }
    directions = (one.model_copy(update={"is_weak": one.deviation > WEAK * median[one.kind]}) for one, _ in found)
    return tuple(sorted(directions, key=lambda one: one.deviation / (median[one.kind] or 1.0), reverse=True))


def _directions(
    calibration: Calibration, refined: Refined, rows: Mapping[Pair, MeasuredRows]
) -> Iterator[tuple[WeakDirection, Array]]:
    """Each frame's least known directions, with the deviations of all three."""
    kinds: tuple[tuple[Kind, slice, float], ...] = (
        ("translation", slice(3, 6), 1e3),
        ("rotation", slice(0, 3), float(np.degrees(1.0))),
    )
    names = calibration.carriers.sensors or "sensorcarrier", calibration.carriers.targets or "targetcarrier"
    for frame in (*refined.Y, *refined.X):
        if frame not in refined.names or not np.isfinite(covariance := refined.covariance(frame)).all():
            continue
        is_sensor = frame in refined.Y
        R = (refined.Y if is_sensor else refined.X)[frame].rotation().matrix()
        pair = _partner(frame, refined, rows)
        tried = None if pair is None else _tried(calibration, refined, pair, rows[pair])
        for kind, at, times in kinds:
            variances, vectors = np.linalg.eigh(covariance[at, at])
            sizes = times * np.sqrt(np.maximum(variances, 0.0))
            axis = vectors[:, -1]
            one = WeakDirection(
                frame=frame,
                kind=kind,
                carrier=names[0] if is_sensor else names[1],
                axis=triple(axis),
                axis_in_carrier=triple(R @ axis),
                deviation=float(sizes[-1]),
                least=float(sizes[0]),
                is_weak=False,
                partner=None if pair is None else pair.target if is_sensor else pair.sensor,
            )
            if tried is not None:
                one = one.model_copy(update=_best(tried, axis, at, times, is_sensor=is_sensor))
            yield one, sizes


def _partner(frame: str, refined: Refined, rows: Mapping[Pair, MeasuredRows]) -> Pair | None:
    """The pair in which a frame was measured most often."""
    counts = {
        pair: int(measured.used.sum())
        for pair, measured in rows.items()
        if frame in pair and pair in refined.noise and pair.target in refined.X and pair.sensor in refined.Y
    }
    pair = max(counts, key=counts.__getitem__, default=None)
    return pair if pair is not None and counts[pair] else None


def _tried(
    calibration: Calibration, refined: Refined, pair: Pair, measured: MeasuredRows
) -> list[tuple[Triple | None, Array]] | None:
    """The pair's joint covariance (12, 12), target first, after each thought experiment; None: more of the same."""
    covariance = refined.covariance(pair.target, pair.sensor)
    if not np.isfinite(covariance).all():
        return None
    X, Y = refined.X[pair.target].matrix(), refined.Y[pair.sensor].matrix()
    A = measured.A[measured.used]
    of_pair = X, Y, refined.noise[pair], calibration.noise_of_A
    credit = _information(A, *of_pair)
    root = np.linalg.cholesky(covariance + 1e-15 * np.diag(np.diagonal(covariance) + 1e-300))
    share = float(np.linalg.eigvalsh(root.T @ credit @ root)[-1])
    like = A[np.linspace(0, len(A) - 1, MORE).round().astype(int)]
    # The pose at which the target is nearest to the median place before the sensor.
    seen = (se3.inverse(Y[None]) @ A @ X)[:, :3, 3]
    middle = A[np.argmin(np.linalg.norm(seen - np.median(seen, axis=0), axis=1))]
    place = (middle @ X)[:3, 3]
    motions: list[tuple[Triple | None, Array]] = [(None, like)]
    for axis in np.eye(3):
        turns = np.tile([TURN_RAD, -TURN_RAD], MORE // 2)[:, None] * axis
        turned = se3.expmap(np.hstack([turns, np.zeros_like(turns)]))
        turned[:, :3, 3] = place - turned[:, :3, :3] @ place
        motions.append((triple(axis), turned @ middle))
    result = []
    for turn, poses in motions:
        added = root.T @ (_information(poses, *of_pair) / max(share, 1.0)) @ root
        result.append((turn, root @ np.linalg.inv(np.eye(12) + added) @ root.T))
    return result


def _information(A: Array, X: Array, Y: Array, noise: PairNoise, carrier: CarrierNoise | None) -> Array:
    """The information (12, 12) of measurements at A (n, 4, 4) on target and sensor, if their noise is independent."""
    J = derivatives(se3.inverse(Y[None]) @ A @ X)[:, :, :12]
    own = np.diag(np.repeat([noise.rotation_rad**2, noise.translation_m**2], 3))
    total: Array = (J.transpose(0, 2, 1) @ np.linalg.solve(own + noise_of_A(carrier, A, X), J)).sum(axis=0)
    return total


def _best(
    tried: list[tuple[Triple | None, Array]], axis: Array, at: slice, times: float, *, is_sensor: bool
) -> dict[str, object]:
    """What the thought experiments do to a direction: the best axis to turn about, if one is better than the same."""
    first = 6 if is_sensor else 0
    rows = slice(first + at.start, first + at.stop)
    left = [times * math.sqrt(max(float(axis @ after[rows, rows] @ axis), 0.0)) for _, after in tried]
    more, best = left[0], int(np.argmin(left[1:])) + 1
    found: dict[str, object] = {"after_more": more}
    if left[best] < BETTER * more:
        found |= {"turn": tried[best][0], "after_turning": left[best]}
    return found
