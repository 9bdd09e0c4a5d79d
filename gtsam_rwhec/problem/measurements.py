"""Measurements of one pair: as users give them, as they are kept, and the checks of them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CountError, NoiseError, StampError, UnitsWarning
from gtsam_rwhec.files.terminal_text import brief, some
from gtsam_rwhec.geometry.poses import Array, PosesLike, QuaternionOrder, as_transforms
from gtsam_rwhec.geometry.real_numbers import check_kind, real_array
from gtsam_rwhec.problem.moments import Gauge

Value = TypeVar("Value")


class Pair(NamedTuple):
    """A target and the sensor that saw it; for motions of a sensor (A Y = Y B), the sensor's name twice.

    A pair is a tuple, so ``solution.residuals["tag_0", "cam_0"]`` finds it.
    """

    target: str
    sensor: str

    @property
    def is_motion(self) -> bool:
        """Whether the measurements are motions of one sensor (AX = XB)."""
        return self.target == self.sensor

    @property
    def frames(self) -> tuple[str, ...]:
        """The names of the frames: target and sensor, or the sensor alone for motions."""
        return (self.sensor,) if self.is_motion else tuple(self)

    @property
    def label(self) -> str:
        """The pair's name in messages and tables: "tag_0-cam_0" or "the motions of cam_0"; also ``str(pair)``."""
        return f"the motions of {self.sensor}" if self.is_motion else f"{self.target}-{self.sensor}"

    def __str__(self) -> str:
        return self.label


class Kind(IntEnum):
    """Which parts of a measurement of a pose are measured."""

    #: The whole pose; the certified solution takes the mean variance of its rotation and of its translation.
    POSE = 0
    #: The whole pose, whose noise differs by direction: what slides has next to no weight.
    DIRECTIONAL = 1
    #: A point of the target: its origin. The rotation means nothing.
    POINT = 2
    #: A plane of the target: z is its normal, the origin lies in it. The turn about z and the place in the plane mean
    #: nothing.
    PLANE = 3


#: Values by pair as users give them: a key may be a plain tuple.
ByPair: TypeAlias = Mapping[Pair, Value] | Mapping[tuple[str, str], Value]


#: sigma and kappa below this are refused: other terms of a sum would be lost to rounding.
SMALLEST_WEIGHT = 1e-15
#: sigma and kappa above this are refused too.
LARGEST_WEIGHT = 1e15


@dataclass(frozen=True)
class Measurements:
    """Raw measurements of one pair: A = T_sensorcarrier_targetcarrier and B = T_sensor_target (N, 4, 4), metres.

    sigma and kappa (N,) are the standard deviation of B's translation in metres and the concentration of B's rotation;
    stamps_ns (N,) integer nanoseconds; covariances (N, 6, 6) those of B, rotation first, right perturbation. pixels (N,
    n, 2) are the target's corners in the images that B is from, nan where one was not seen or B was given as a pose.
    kinds (N,) say which parts of a measurement are measured (`Kind`); None where all are whole poses.
    """

    A: Array
    B: Array
    sigma: Array
    kappa: Array
    stamps_ns: np.ndarray | None = None
    covariances: Array | None = None
    pixels: Array | None = None
    kinds: np.ndarray | None = None

    def covariance_of_B(self) -> Array:
        """(N, 6, 6), rotation first: as given, or diagonal with 1 / (2 kappa) and sigma^2."""
        if self.covariances is not None:
            return self.covariances
        variances = np.repeat(np.column_stack([0.5 / self.kappa, self.sigma**2]), 3, axis=1)
        return variances[:, :, None] * np.eye(6)

    def is_of(self, kind: Kind) -> np.ndarray:
        """(N,): which measurements are of a kind."""
        return np.full(len(self.A), kind is Kind.POSE) if self.kinds is None else self.kinds == kind

    def selected(self, mask: np.ndarray) -> Measurements:
        """The measurements where ``mask`` (N,) is true."""
        arrays = {part.name: getattr(self, part.name) for part in fields(self)}
        return replace(self, **{name: array[mask] for name, array in arrays.items() if array is not None})

    @property
    def options(self) -> tuple[np.ndarray | None, Array | None, Array | None, np.ndarray | None]:
        """Stamps, covariances, pixels and kinds."""
        return self.stamps_ns, self.covariances, self.pixels, self.kinds


@dataclass(frozen=True)
class GivenMeasurements:
    """The arguments of ``Problem.add``, not checked."""

    A: PosesLike
    B: PosesLike
    sigma: ArrayLike | None
    kappa: ArrayLike | None
    order: QuaternionOrder | None
    stamps_ns: ArrayLike | None
    covariances: ArrayLike | None
    source: str | None
    pixels: Array | None = None
    kind: Kind = Kind.POSE

    def check_source(self) -> None:
        """Raise an OptionError for a source that is no text."""
        check_kind(self.source, str | None, "source", "text: the name of a file or topic")

    @property
    def has_noise(self) -> bool:
        """Whether the noise of both the rotation and the translation is stated."""
        return self.covariances is not None or (self.sigma is not None and self.kappa is not None)

    def checked(self, where: str) -> Measurements:
        """The arguments as arrays; a single sigma or kappa for all measurements stays one number.

        A PoseError, CountError or NoiseError says which poses, stamps or noise are not valid, do not have one entry for
        each measurement, or are given twice.
        """
        A = as_transforms(self.A, self.order, f"A of {where}")
        B = as_transforms(self.B, self.order, f"B of {where}")
        if len(A) != len(B):
            raise CountError(f"{where}: {len(A)} poses in A and {len(B)} in B; give as many in A as in B, in pairs")
        if len(A) == 0:
            raise CountError(f"{where}: no measurements; leave the pair out instead")
        stamps_ns = checked_stamps(self.stamps_ns, len(A), where)
        covariances = checked_covariances(self.covariances, len(A), where)
        sigma, kappa = self.sigma, self.kappa
        if covariances is not None:
            if sigma is not None or kappa is not None:
                raise NoiseError(
                    f"{where}: covariances and {'sigma' if sigma is not None else 'kappa'} are given; give covariances "
                    "alone, or sigma and kappa (the certified solution uses the mean variance of each block)"
                )
            if self.kind is not Kind.POSE:
                sigma, kappa = mean_noise(covariances)
            else:
                variances = np.einsum("nii->ni", covariances)
                sigma, kappa = np.sqrt(variances[:, 3:].mean(axis=1)), 0.5 / variances[:, :3].mean(axis=1)
        sigma, kappa = (positive_weights(x, len(A), name, where) for name, x in (("sigma", sigma), ("kappa", kappa)))
        kinds = None if self.kind is Kind.POSE else np.full(len(A), self.kind, dtype=np.int8)
        return Measurements(A, B, sigma, kappa, stamps_ns, covariances, self.pixels, kinds)


def mean_noise(covariances: Array) -> tuple[Array, Array]:
    """sigma and kappa (N,) of what covariances (N, 6, 6) measure; directions of no weight do not count."""
    of_rotation, of_translation = (
        measured_mean(np.linalg.eigvalsh(np.linalg.inv(covariances[:, block, block])))
        for block in (slice(0, 3), slice(3, 6))
    )
    return 1.0 / np.sqrt(of_translation), 0.5 * of_rotation


#: A direction is measured where its information is at least this part of the block's largest.
MEASURED = 1e-6


def measured_mean(information: Array) -> Array:
    """The mean (N,) of the eigenvalues (N, 3) of an information matrix that are no less than rounding."""
    largest = information.max(axis=1, keepdims=True)
    has = information >= MEASURED * largest
    mean: Array = np.where(has, information, 0.0).sum(axis=1) / has.sum(axis=1)
    return mean


def positive_weights(value: ArrayLike | None, count: int, name: str, where: str) -> Array:
    """sigma or kappa as a () or (count,) array of positive numbers; 1 where the value is None."""
    if value is None:
        return np.array(1.0)
    try:
        array = np.array(real_array(value))
    except ValueError as error:
        raise NoiseError(
            f"{where}: {name}={brief(value)} cannot be read as numbers ({error}); give a number"
        ) from error
    if array.shape not in ((), (count,)) or count == 0 != array.ndim:
        many = f" or one for each of {count}" if count else ""
        raise CountError(f"{where}: {name} has shape {array.shape}; give one number{many}")
    bad = np.flatnonzero(~((array >= SMALLEST_WEIGHT) & (array <= LARGEST_WEIGHT)))
    if bad.size:
        index = f" of measurement {bad[0]}" if array.ndim else ""
        raise NoiseError(
            f"{where}: {name}{index} is {array.flat[bad[0]]}; it must be positive and finite: a number from "
            f"{SMALLEST_WEIGHT:g} to {LARGEST_WEIGHT:g}. sigma is in metres, kappa is 1 / (2 s^2) for s in radians"
        )
    return array


def checked_stamps(stamps_ns: ArrayLike | None, count: int, where: str) -> np.ndarray | None:
    """Stamps as (count,) integer nanoseconds that do not decrease.

    A CountError says that their number or type is wrong, a StampError which stamp goes back. Measurements of one pair
    may have equal stamps.
    """
    stamps = whole_stamps(stamps_ns, count, where)
    if stamps is not None and (np.diff(stamps) < 0).any():
        i = int(np.argmax(np.diff(stamps) < 0)) + 1
        raise StampError(
            f"{where}: stamp {i} ({stamps[i]} ns) is before the stamp ahead of it ({stamps[i - 1]} ns): rows are out "
            "of order, or a clock was set back. Sort the measurements by stamp; where a clock was set back, correct "
            "the stamps, or leave stamps_ns out"
        )
    return stamps


def whole_stamps(stamps_ns: ArrayLike | None, count: int, where: str) -> np.ndarray | None:
    """Stamps as (count,) integer nanoseconds in any order; a CountError for others."""
    if stamps_ns is None:
        return None
    try:
        stamps = np.asarray(stamps_ns)
    except (TypeError, ValueError) as error:
        raise CountError(f"{where}: stamps_ns cannot be read as numbers ({error}); give integer nanoseconds") from error
    if stamps.shape != (count,):
        raise CountError(f"{where}: stamps_ns has shape {stamps.shape} for {count} measurements")
    if not np.issubdtype(stamps.dtype, np.integer):
        raise CountError(f"{where}: stamps_ns is of {stamps.dtype}; give integer nanoseconds")
    return stamps.astype(np.int64)


def checked_covariances(covariances: ArrayLike | None, count: int, where: str) -> Array | None:
    """Covariances of B as (count, 6, 6); a CountError or NoiseError where they are not positive definite matrices."""
    if covariances is None:
        return None
    try:
        array = np.array(real_array(covariances))
    except ValueError as error:
        raise NoiseError(f"{where}: covariances cannot be read as numbers ({error}); give 6 x 6 matrices") from error
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


#: Translations with a median size beyond this, in metres, look like millimetres: no camera sees a tag at 100 m.
MILLIMETRES_M = 100.0
#: A warning names this many pairs, and counts the others.
MOST_NAMED = 3


@dataclass(frozen=True)
class LongTranslations:
    """Which translations of a batch are too long: median size (m) by "A" and "B", and the batch's name.

    ``from_corners``: B was computed from corners, in the unit of their board.
    """

    where: str
    sizes: dict[str, float]
    from_corners: bool = False

    @staticmethod
    def of(A: Array, B: Array, gauge: Gauge, where: str, *, motion: bool, from_corners: bool) -> LongTranslations:
        """Look at a batch; A is taken about the gauge, so that a distant world origin is not too long."""
        c = gauge.sensor_carrier if motion else gauge.target_carrier
        # What a sensor sees (B) is never far.
        found = {"A": A[:, :3, 3] + A[:, :3, :3] @ c - gauge.sensor_carrier, "B": B[:, :3, 3]}
        sizes = {name: float(np.median(np.abs(t).max(axis=1))) for name, t in found.items()}
        long = {name: size for name, size in sizes.items() if size > MILLIMETRES_M}
        return LongTranslations(where, long, from_corners)


def warn_of_millimetres(found: Sequence[LongTranslations], stacklevel: int) -> None:
    """One warning for all batches whose translations look like millimetres."""
    long = [each for each in found if each.sizes]
    if not long:
        return
    sides = sorted({name for each in long for name in each.sizes})
    sizes = [f"{np.median([each.sizes[name] for each in long if name in each.sizes]):.4g}" for name in sides]
    named = some([each.where for each in long], MOST_NAMED)
    cure = "Give metres: divide by 1000"
    if "B" in sides and all(each.from_corners for each in long):
        also = ", and A too" if "A" in sides else ""
        cure = f"B is made of board_points: give these in metres, divided by 1000{also}"
    warnings.warn(
        f"{named}: translations of {' and '.join(sides)} have a median size of {' and '.join(sizes)}; this looks "
        f"like millimetres. {cure}. (This is said once for all pairs of a problem)",
        UnitsWarning,
        stacklevel=stacklevel + 1,
    )
