"""What is left after the fit, measurement by measurement, against the noise that was found."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.file_record import Count, FileRecord, PositiveCount, Row, Rows
from gtsam_rwhec.results.linear_model import LinearModel, equilibrated, inverse_of
from gtsam_rwhec.solver.answers import Residual

#: So many measurements are kept one by one; of more, every so-many-th.
MOST_KEPT = 5_000
#: The measurements are cut into so many blocks in time, each of which the others predict.
BLOCKS = 5
#: With fewer measurements, neighbours in time and the configuration are not examined.
FEWEST = 8
#: The chance of a normal error beyond three standard deviations.
BEYOND_3_BY_CHANCE = 0.0026997960632601866
#: A dependence counts beyond so many of its standard deviations: that is 1 % for the 72 that are looked at.
CHANCE_OF_MANY = 3.8
AXES = ("x", "y", "z")
COMPONENTS = tuple(f"{what} {axis}" for what in ("rotation about", "translation along") for axis in AXES)


class PairResiduals(FileRecord):
    """The residuals of a pair: B against the prediction Y^-1 A X, in the target's axes."""

    target: str
    sensor: str
    used: Count  #: Measurements in the answer
    rms_deg: float  #: Root mean square angle of those in the answer, degrees
    rms_mm: float  #: Root mean square length of those in the answer, millimetres
    spread: float  #: Root mean square in units of the noise: 1 where they are as large as the noise
    neighbours: float | None  #: Correlation with the one before; null: too few
    band: float | None  #: By chance it is within this of zero in 95 %
    times: Row  #: Of those kept one by one: seconds since the first, or places without stamps
    in_answer: tuple[bool, ...]  #: Whether it is in the answer
    deg: Row  #: Angle, degrees
    mm: Row  #: Length, millimetres
    normalised: Rows  #: In units of the noise, rotation first; of those in the answer


class HoldOut(FileRecord):
    """Measurements of a sensor, predicted by all that are not of their block in time, in one linear step."""

    sensor: str
    measurements: Count  #: That could be predicted
    held_out_mm: float  #: Root mean square length, millimetres
    held_out_deg: float  #: Root mean square angle, degrees
    fitted_mm: float  #: The same with all measurements in the fit
    fitted_deg: float  #: The same with all measurements in the fit


class Dependence(FileRecord):
    """How a residual depends on the pose of the carriers: the strongest dependence of all."""

    sensor: str
    component: str  #: Which of the six residuals
    by: str  #: What of A it depends on
    correlation: float  #: Between the two
    by_chance: float  #: The largest of all is below this in 99 % if there is none
    x: Row  #: What of A: radians, or metres
    y: Row  #: The residual in units of its noise


class ResidualsEvidence(FileRecord):
    """Residuals of all pairs, and what they say of the noise model."""

    has_stamps: bool  #: Whether times are seconds
    measurements: Count  #: In the answer
    kept_every: PositiveCount  #: Every so-many-th is kept one by one
    pairs: tuple[PairResiduals, ...]  #: By pair
    spread: float  #: Root mean square of all residuals in units of the noise
    beyond_3: float  #: Share of them beyond three deviations
    excess_kurtosis: float  #: Of them; 0 for normal noise, positive for heavy tails
    instants: int | None  #: Carrier poses with measurements; null: no model of the noise
    worth: float | None  #: So many instants with independent noise would tell as much
    hold_out: tuple[HoldOut, ...]  #: By sensor
    dependence: Dependence | None  #: Of the residuals on the carriers' pose; null: too few


def residuals_of(model: LinearModel, calibration: Calibration) -> ResidualsEvidence:
    """The residuals of a calibration's model."""
    r, J = model.whitened()
    every = -(-len(r) // MOST_KEPT)
    used = r[model.used]
    noise = calibration.noise.model
    return ResidualsEvidence(
        has_stamps=model.stamps_ns is not None,
        measurements=int(model.used.sum()),
        kept_every=every,
        pairs=tuple(_of_pair(model, r, number, every) for number in range(len(model.pairs))),
        spread=_rms(used),
        beyond_3=float((np.abs(used) > 3.0).mean()) if used.size else 0.0,
        excess_kurtosis=_excess_kurtosis(used),
        instants=None if noise is None else noise.instants,
        worth=None if noise is None else noise.worth,
        hold_out=tuple(_hold_out(model, r, J)),
        dependence=_dependence(model, r),
    )


def _of_pair(model: LinearModel, r: Array, number: int, every: int) -> PairResiduals:
    mine = model.pair == number
    used = mine & model.used
    mine = mine & (np.arange(len(r)) % every == 0)
    degrees, millimetres = sizes(model.residual)
    correlation, band = _neighbours(r[used], model.seconds[used])
    pair = model.pairs[number]
    return PairResiduals(
        target=pair.target,
        sensor=pair.sensor,
        used=int(used.sum()),
        rms_deg=_rms(degrees[used]),
        rms_mm=_rms(millimetres[used]),
        spread=_rms(r[used]),
        neighbours=correlation,
        band=band,
        times=_rounded(model.seconds[mine]),
        in_answer=tuple(model.used[mine].tolist()),
        deg=_rounded(degrees[mine]),
        mm=_rounded(millimetres[mine]),
        normalised=tuple(map(_rounded, r[mine & model.used])),
    )


def pooled_residual(residuals: Iterable[Residual]) -> Residual:
    """The root mean square over all measurements of several pairs; nan where there are none."""
    all_ = list(residuals)
    number = np.array([one.number_of_measurements for one in all_], dtype=int)
    squares = np.array([(one.translation_rms_m**2, one.rotation_rms_rad**2) for one in all_]).reshape(-1, 2)
    total = int(number.sum())
    rms = np.sqrt(number @ squares / total) if total else np.full(2, np.nan)
    return Residual(total, float(rms[0]), float(rms[1]))


def sizes(residual: Array) -> tuple[Array, Array]:
    """Angles (N,) in degrees and lengths (N,) in millimetres of residuals (N, 6)."""
    angle: Array = np.degrees(np.linalg.norm(residual[:, :3], axis=1))
    return angle, 1e3 * np.linalg.norm(residual[:, 3:], axis=1)


def _neighbours(r: Array, seconds: Array) -> tuple[float | None, float | None]:
    """The correlation of residuals with those before them in time, and how large it is by chance, 95 %."""
    if len(r) < FEWEST:
        return None, None
    ordered = r[np.argsort(seconds, kind="stable")]
    ordered = ordered - ordered.mean(axis=0)
    variance = (ordered**2).mean()
    if variance == 0.0:
        return None, None
    return float((ordered[1:] * ordered[:-1]).mean() / variance), 1.96 / np.sqrt(6.0 * (len(r) - 1))


def _hold_out(model: LinearModel, r: Array, J: Array) -> Iterator[HoldOut]:
    """Predictions of each block from the others: one step of the linear model from the answer, with what they know."""
    used = model.used
    whole, pull = model.information(J, used), model.gradient(J, r, used)
    block = np.zeros(len(r), dtype=int)
    block[np.argsort(model.seconds, kind="stable")] = np.arange(len(r)) * BLOCKS // max(len(r), 1)
    predicted = np.full(model.residual.shape, np.nan)
    for number in range(BLOCKS):
        mine = used & (block == number)
        if not mine.any():
            continue
        left = whole - model.information(J, mine)
        if np.linalg.matrix_rank(equilibrated(left)[0], tol=1e-9, hermitian=True) < len(left):
            continue
        step = np.append(inverse_of(left) @ (pull - model.gradient(J, r, mine)), 0.0)
        predicted[mine] = model.residual[mine] - np.einsum("nij,nj->ni", model.J[mine], step[model.places[mine]])
    for sensor, of_sensor in model.by_sensor.items():
        known = of_sensor & np.isfinite(predicted[:, 0])
        if known.any():
            held, fitted = sizes(predicted[known]), sizes(model.residual[known])
            yield HoldOut(
                sensor=sensor,
                measurements=int(known.sum()),
                held_out_mm=_rms(held[1]),
                held_out_deg=_rms(held[0]),
                fitted_mm=_rms(fitted[1]),
                fitted_deg=_rms(fitted[0]),
            )


def _dependence(model: LinearModel, r: Array) -> Dependence | None:
    """The strongest correlation of a residual with a coordinate of A, over sensors, residuals and coordinates."""
    found: list[Dependence] = []
    for sensor, of_sensor in model.by_sensor.items():
        mine = model.used & of_sensor
        if mine.sum() < FEWEST:
            continue
        coordinates, names = _coordinates(model.A[mine])
        values = r[mine] - r[mine].mean(axis=0)
        spread = np.outer(values.std(axis=0), coordinates.std(axis=0)) * len(values)
        correlation = np.divide(values.T @ coordinates, spread, out=np.zeros(spread.shape), where=spread > 0.0)
        row, column = np.unravel_index(int(np.abs(correlation).argmax()), correlation.shape)
        every = slice(None, None, -(-len(values) // 1000))
        found.append(
            Dependence(
                sensor=sensor,
                component=COMPONENTS[row],
                by=names[column],
                correlation=float(correlation[row, column]),
                by_chance=min(CHANCE_OF_MANY / np.sqrt(len(values)), 1.0),
                x=_rounded(coordinates[every, column]),
                y=_rounded(r[mine][every, row]),
            )
        )
    return max(found, key=lambda one: abs(one.correlation) / one.by_chance, default=None)


def _coordinates(A: Array) -> tuple[Array, tuple[str, ...]]:
    """The carriers' pose as six centred numbers, about the pose in the middle, and their names."""
    middle = A[int(np.argmin(np.linalg.norm(A[:, :3, 3] - np.median(A[:, :3, 3], axis=0), axis=1)))]
    turned = se3.so3_logmap(np.swapaxes(np.broadcast_to(middle[:3, :3], A[:, :3, :3].shape), 1, 2) @ A[:, :3, :3])
    values = np.concatenate([turned, A[:, :3, 3]], axis=1)
    names = (*(f"rotation of A about {axis}, rad" for axis in AXES), *(f"{axis} of A, m" for axis in AXES))
    return values - values.mean(axis=0), names


def _excess_kurtosis(values: Array) -> float:
    if values.size < FEWEST or not values.any():
        return 0.0
    centred = values - values.mean()
    return float((centred**4).mean() / (centred**2).mean() ** 2 - 3.0)


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else 0.0


def _rounded(values: Array) -> Row:
    """Six significant digits: more are noise, and a file has many."""
    return tuple(float(f"{value:.6g}") for value in values.tolist())
