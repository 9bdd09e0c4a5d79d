"""Measurements of one pair: as users give them, as they are kept, and the checks in between."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CountError, NoiseError, UnitsWarning
from gtsam_rwhec.geometry.poses import Array, PosesLike, QuaternionOrder, as_transforms
from gtsam_rwhec.problem.moments import BLOCK, Gauge

#: sigma and kappa below this, or above its inverse, lose everything else in rounding.
SMALLEST_WEIGHT = 1e-15
#: Translations with a median beyond this are taken for millimetres (a camera sees no tag at 100 m).
MILLIMETRES_M = 100.0


@dataclass(frozen=True)
class Measurements:
    """Raw measurements of one edge: A, B (N, 4, 4), sigma (N,) in m, kappa (N,), stamps (N,) in ns, 6x6 covariances."""

    A: Array
    B: Array
    sigma: Array
    kappa: Array
    stamps_ns: np.ndarray | None = None
    covariances: Array | None = None

    def covariance_of_B(self) -> Array:
        """(N, 6, 6), rotation first: as given, or 1 / (2 kappa) and sigma^2 an axis."""
        if self.covariances is not None:
            return self.covariances
        variances = np.repeat(np.column_stack([0.5 / self.kappa, self.sigma**2]), 3, axis=1)
        covariance: Array = variances[:, :, None] * np.eye(6)
        return covariance

    def selected(self, mask: np.ndarray) -> Measurements:
        """Those marked."""
        return Measurements(
            self.A[mask],
            self.B[mask],
            self.sigma[mask],
            self.kappa[mask],
            None if self.stamps_ns is None else self.stamps_ns[mask],
            None if self.covariances is None else self.covariances[mask],
        )

    def kept(self) -> KeptMeasurements:
        """Copied, since the caller's arrays may change; sigma and kappa are one for each measurement then."""
        sigma, kappa = (np.broadcast_to(value, len(self.A)) for value in (self.sigma, self.kappa))
        copied = replace(self, A=self.A.copy(), B=self.B.copy(), sigma=sigma, kappa=kappa)
        return KeptMeasurements((copied,), self.covariances is not None)


@dataclass(frozen=True)
class KeptMeasurements:
    """Raw measurements of a pair, batch by batch, as far as they are kept; whether covariances came with any."""

    batches: tuple[Measurements, ...] = ()
    has_covariances: bool = False

    def __add__(self, other: KeptMeasurements) -> KeptMeasurements:
        return KeptMeasurements(self.batches + other.batches, self.has_covariances or other.has_covariances)

    @property
    def count(self) -> int:
        """How many are kept."""
        return sum(len(batch.A) for batch in self.batches)

    def joined(self) -> Measurements:
        """All in one, in the order in which they were added."""
        batches = self.batches
        stamps = [b.stamps_ns for b in batches if b.stamps_ns is not None]
        return Measurements(
            np.concatenate([b.A for b in batches]),
            np.concatenate([b.B for b in batches]),
            np.concatenate([b.sigma for b in batches]),
            np.concatenate([b.kappa for b in batches]),
            np.concatenate(stamps) if len(stamps) == len(batches) else None,
            np.concatenate([b.covariance_of_B() for b in batches]) if self.has_covariances else None,
        )


@dataclass(frozen=True)
class GivenMeasurements:
    """Measurements as ``Problem.add`` is given them: nothing is checked. Its documentation says what each is."""

    A: PosesLike
    B: PosesLike
    sigma: ArrayLike | None
    kappa: ArrayLike | None
    order: QuaternionOrder | None
    stamps_ns: ArrayLike | None
    covariances: ArrayLike | None
    source: str | None

    @property
    def has_noise(self) -> bool:
        """Whether the noise of both rotation and translation is stated."""
        return self.covariances is not None or (self.sigma is not None and self.kappa is not None)

    def checked(self, where: str) -> Measurements:
        """The arrays that they are; one sigma or kappa for all stays one number.

        Raises
        ------
        PoseError, CountError, NoiseError
            For poses, stamps or noise that are none, that are not one for each measurement, or noise given twice.
        """
        A = as_transforms(self.A, self.order, f"A of {where}")
        B = as_transforms(self.B, self.order, f"B of {where}")
        if len(A) != len(B):
            raise CountError(f"{where}: {len(A)} poses in A and {len(B)} in B; they come in pairs")
        if len(A) == 0:
            raise CountError(f"{where}: no measurements; leave the pair out instead")
        stamps_ns = checked_stamps(self.stamps_ns, len(A), where)
        covariances = checked_covariances(self.covariances, len(A), where)
        sigma, kappa = self.sigma, self.kappa
        if covariances is not None:
            if sigma is not None or kappa is not None:
                raise NoiseError(
                    f"{where}: covariances and {'sigma' if sigma is not None else 'kappa'} are given, which may "
                    "contradict one another; give the one or the other (of covariances, the certified solution takes "
                    "the mean variance of each block)"
                )
            variances = np.einsum("nii->ni", covariances)
            sigma, kappa = np.sqrt(variances[:, 3:].mean(axis=1)), 0.5 / variances[:, :3].mean(axis=1)
        return Measurements(
            A,
            B,
            positive_weights(sigma, len(A), "sigma", where),
            positive_weights(kappa, len(A), "kappa", where),
            stamps_ns,
            covariances,
        )


def positive_weights(value: ArrayLike | None, count: int, name: str, where: str) -> Array:
    """sigma or kappa as a () or (count,) array of positive numbers; left out: 1."""
    if value is None:
        return np.array(1.0)
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise NoiseError(f"{where}: {name}={value!r} cannot be read as numbers; give a number") from error
    if array.shape not in ((), (count,)) or count == 0 != array.ndim:
        many = f" or one for each of {count}" if count else ""
        raise CountError(f"{where}: {name} has shape {array.shape}; give one number{many}")
    bad = np.flatnonzero(~((array > 0.0) & np.isfinite(array)))
    if bad.size:
        index = f" of measurement {bad[0]}" if array.ndim else ""
        raise NoiseError(f"{where}: {name}{index} is {array.flat[bad[0]]}; it must be positive and finite")
    unlikely = np.flatnonzero((array < SMALLEST_WEIGHT) | (array > 1.0 / SMALLEST_WEIGHT))
    if unlikely.size:
        value_there = array.flat[unlikely[0]]
        raise NoiseError(
            f"{where}: {name} is {value_there:.3g}; beyond {SMALLEST_WEIGHT:g} to {1.0 / SMALLEST_WEIGHT:g} no double "
            "precision sum holds it. sigma is in metres, kappa is 1 / (2 s^2) for s in radians"
        )
    return array


def checked_stamps(stamps_ns: ArrayLike | None, count: int, where: str) -> np.ndarray | None:
    """Stamps as (count,) integer nanoseconds.

    Raises
    ------
    CountError
        For another count, or for numbers that are not integers.
    """
    if stamps_ns is None:
        return None
    stamps = np.asarray(stamps_ns)
    if stamps.shape != (count,):
        raise CountError(f"{where}: stamps_ns has shape {stamps.shape} for {count} measurements")
    if not np.issubdtype(stamps.dtype, np.integer):
        raise CountError(f"{where}: stamps_ns is of {stamps.dtype}; give integer nanoseconds")
    return stamps.astype(np.int64)


def checked_covariances(covariances: ArrayLike | None, count: int, where: str) -> Array | None:
    """Covariances of B as (count, 6, 6), positive definite.

    Raises
    ------
    CountError, NoiseError
        For another shape, or for what is no covariance.
    """
    if covariances is None:
        return None
    array = np.array(covariances, dtype=np.float64)
    if array.shape == (6, 6):
        array = np.broadcast_to(array, (count, 6, 6))
    if array.shape != (count, 6, 6):
        raise CountError(f"{where}: covariances has shape {array.shape}; give (6, 6) or ({count}, 6, 6)")
    with np.errstate(invalid="ignore"):
        asymmetry = np.abs(array - array.transpose(0, 2, 1)).max(axis=(1, 2))
        bad = np.flatnonzero(~(asymmetry <= 1e-9 * np.abs(array).max(axis=(1, 2))))
    if bad.size:
        raise NoiseError(
            f"{where}: the covariance of measurement {bad[0]} is not finite and symmetric; give 6 x 6 matrices in the "
            f"order of rotation, translation:\n{array[bad[0]]}"
        )
    smallest = np.linalg.eigvalsh(array)[:, 0]
    if smallest.min() <= 0.0:
        index = int(smallest.argmin())
        raise NoiseError(
            f"{where}: the covariance of measurement {index} is not positive definite (smallest eigenvalue "
            f"{smallest[index]:.3g}); give variances that are positive in every direction"
        )
    return array


def warn_of_millimetres(A: Array, B: Array, gauge: Gauge, motion: bool, where: str) -> None:
    """Warn where translations look as if they were in millimetres."""
    # About the gauge, so that a world origin far away is no millimetre; B is what a sensor sees, never far away.
    c = gauge.sensor_carrier if motion else gauge.target_carrier
    centred_A = A[:BLOCK, :3, 3] + A[:BLOCK, :3, :3] @ c - gauge.sensor_carrier
    spread_A = float(np.median(np.abs(centred_A).max(axis=1)))
    size_B = float(np.median(np.abs(B[:BLOCK, :3, 3]).max(axis=1)))
    for name, size in (("A", spread_A), ("B", size_B)):
        if size > MILLIMETRES_M:
            warnings.warn(
                f"{where}: translations of {name} have a median size of {size:.4g}; that looks like millimetres. "
                "This library takes metres; divide by 1000 if so",
                UnitsWarning,
                stacklevel=4,
            )
