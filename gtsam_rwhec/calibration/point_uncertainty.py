"""How far off is a point that a sensor sees: the uncertainty of a calibration in task units.

A point p in the frame f, seen from a carrier or from another frame g on the same carrier, is q = T_g_f p. To first
order an error xi = [omega, v] of T_g_f Expmap(xi) moves it by R_g_f (omega x p + v), so its covariance is J Sigma J'
with J = R_g_f [-[p]x, I]. With one scale for all lengths, the point is taken as measured (true = measured / scale), and
an error of the scale moves it by -p d(scale) / scale. On the other carrier, T_g_f has the pose A of the moment. The
noise of one new measurement is reported separately: it averages out over measurements, and the calibration's error does
not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors import se3
from scipy.special import chdtr, chdtri, fdtr, fdtri

from gtsam_rwhec.errors import FrameError, OptionError, PoseError
from gtsam_rwhec.files.terminal_text import brief, rounded
from gtsam_rwhec.fitting.fit_options import CarrierNoise
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown
from gtsam_rwhec.geometry.poses import LARGEST_M, Array, PoseLike, one_transform
from gtsam_rwhec.geometry.real_numbers import is_real
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem

#: Nodes of the quadrature over directions, in cos(polar angle) and in azimuth. With these the probability of a ball is
#: right to 1e-6 for axes of any ratio that changes the radius.
NODES = (48, 24)
#: No camera measures a target's place to a smaller share of its distance.
LEAST_SHARE = 1e-4


@dataclass(frozen=True, eq=False)
class PointUncertainty:
    """How far off a point is that is seen in one frame and expressed in another."""

    point_m: Array  #: (3,): the point in ``frame``, metres
    #: The frame of the point, and the frame in which it is expressed
    frame: str
    seen_from: str
    level: float  #: Probability of the ellipsoid and of the ball
    centre_m: Array  #: (3,): the point in ``seen_from``, metres
    #: (3, 3): covariance of the centre from the calibration's errors, in the axes of ``seen_from``, m^2; infinite in
    #: rows that a free direction moves
    covariance_m2: Array
    axes: Array  #: (3, 3): columns: the ellipsoid's axes in ``seen_from``, the longest first
    half_lengths_mm: Array  #: (3,): the ellipsoid's half axes at the level, millimetres
    radius_mm: float  #: The true point is within this distance of the centre with probability ``level``, millimetres
    #: The same radius for the noise of one new measurement alone, which is not in ``radius_mm``: of the sensor, and of
    #: A where the point is expressed on the other carrier. None where nothing is measured, and where the noise is not
    #: known.
    measurement_mm: float | None

    def __str__(self) -> str:
        distance_m = float(np.linalg.norm(self.point_m))
        return point_sentence(self.frame, self.seen_from, distance_m, self.level, self.radius_mm, self.measurement_mm)


def point_sentence(
    frame: str, seen_from: str, distance_m: float, level: float, radius_mm: float, measurement_mm: float | None
) -> str:
    """How far off a point is, as one sentence."""
    what = f"A point {distance_m:.2f} m from {frame}, expressed in {seen_from},"
    if not np.isfinite(radius_mm):
        return f"{what} is not determined: the measurements leave a direction free that moves it."
    said = f"{what} is within {rounded(radius_mm)} mm of its true place with {100 * level:g} % probability"
    if measurement_mm is None:
        return f"{said}."
    if is_of_no_sensor(measurement_mm, distance_m):
        return f"{said}; the noise of one new measurement is not told: the residuals are smaller than a sensor's."
    return f"{said}; the noise of one new measurement adds up to {rounded(measurement_mm)} mm."


def is_of_no_sensor(measurement_mm: float, distance_m: float) -> bool:
    """Whether the noise of a measurement is below what sensors have: smaller residuals tell nothing."""
    return measurement_mm < 1e3 * LEAST_SHARE * distance_m


def checked_point(point: ArrayLike) -> Array:
    """A point (3,) in metres; a PoseError for anything else."""
    try:
        result = np.asarray(point, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PoseError(f"the point is {brief(point)}; give three numbers, metres") from error
    if result.shape != (3,) or not (np.abs(result) <= LARGEST_M).all():
        raise PoseError(f"the point is {brief(point)}; give three finite numbers, metres, up to {LARGEST_M:g}")
    return result


def checked_level(level: float) -> float:
    """A probability between 0 and 1; an OptionError for anything else."""
    if not (is_real(level) and 0.0 < level < 1.0):
        raise OptionError(f"level={brief(level)}; give one between 0 and 1")
    return float(level)


def jacobian_of_point(R: Array, point: Array) -> Array:
    """J (3, 6) = R [-[p]x, I]: the movement of R p + t by a right perturbation [omega, v]."""
    return np.asarray(R @ np.hstack([-se3.hat(point), np.eye(3)]))


def ellipsoid(covariance: Array, level: float, degrees_of_freedom: float) -> tuple[Array, Array, float]:
    """Axes (3, 3), half lengths (3,) and the ball's radius, for a covariance (3, 3), in its unit of length.

    With finite degrees of freedom (the noise was estimated) the error is a multivariate t, and the ellipsoid is that of
    3 F(3, nu). The longest axis is first. Where rows are infinite, these axes come first and have infinite lengths.
    """
    free = ~np.isfinite(np.diagonal(covariance))
    inside = np.flatnonzero(~free)
    values, vectors = np.linalg.eigh(covariance[np.ix_(inside, inside)])
    order = np.argsort(values)[::-1]
    variances = np.concatenate([np.full(free.sum(), np.inf), np.maximum(values[order], 0.0)])
    axes = np.zeros((3, 3))
    axes[np.flatnonzero(free), np.arange(free.sum())] = 1.0
    axes[np.ix_(inside, np.arange(free.sum(), 3))] = vectors[:, order]
    infinite = np.isinf(degrees_of_freedom)
    square = chdtri(3, 1.0 - level) if infinite else 3.0 * fdtri(3, degrees_of_freedom, level)
    return axes, np.sqrt(square * variances), ball_radius(variances, level, degrees_of_freedom)


def ball_radius(variances: Array, level: float, degrees_of_freedom: float = np.inf) -> float:
    """The radius of the ball about the centre that holds a normal (or t) vector with this probability.

    In polar coordinates z = rho u of the whitened error, u is uniform on the sphere and independent of rho^2, which is
    chi-square with 3 degrees of freedom (or 3 F(3, nu)). So P(|e| <= r) is the mean over u of P(rho^2 <= r^2 / u'Vu).
    """
    if not np.isfinite(variances).all():
        return float("inf")
    largest = float(variances.max())
    if largest <= 0.0:
        return 0.0
    x, wx = np.polynomial.legendre.leggauss(NODES[0])
    y, wy = np.polynomial.legendre.leggauss(NODES[1])
    cosine, azimuth = 0.5 * (x[:, None] + 1.0), 0.25 * np.pi * (y + 1.0)  # one octant; the others are alike
    weight = 0.25 * wx[:, None] * wy
    first, second, third = np.sort(variances)[::-1] / largest
    spread = first * cosine**2 + (1.0 - cosine**2) * (second * np.cos(azimuth) ** 2 + third * np.sin(azimuth) ** 2)

    def lacking(square: float) -> float:
        ratio = square / spread
        known = chdtr(3, ratio) if np.isinf(degrees_of_freedom) else fdtr(3, degrees_of_freedom, ratio / 3.0)
        return float((weight * known).sum()) - level

    end = 1.0
    while lacking(end) < 0.0:
        end *= 4.0
    from scipy.optimize import brentq  # here, since its import takes as long as a calibration of few poses

    return float(np.sqrt(largest * brentq(lacking, 0.0, end, xtol=1e-12)))


#: The words for a carrier that a problem does not name. Without A, each but one means the carrier of the point's own
#: frame; with A, the other one.
CARRIER_WORDS = {
    "sensor": ("sensorcarrier", "hand", "base", "rig"),
    "target": ("targetcarrier", "base", "hand", "world"),
}
#: For each side, the word that usually means the other carrier. Without A it is ambiguous.
MORE_OFTEN_THE_OTHER = {"sensor": "base", "target": "hand"}


@dataclass(frozen=True)
class Carriers:
    """The names of the carriers as the problem states them; None where it does not."""

    sensors: str | None = None
    targets: str | None = None

    def of(self, side: str) -> str | None:
        """The name of the carrier of "sensor" or "target"."""
        return self.sensors if side == "sensor" else self.targets


@dataclass(frozen=True)
class Place:
    """Where a point is expressed."""

    name: str
    frame: gtsam.Pose3 | None  #: The pose of the frame on its carrier; None for the carrier itself
    is_across: bool  #: Whether it is on the other carrier than the point's own frame


def places_of(
    frame: str, own: str, poses: Mapping[str, Mapping[str, gtsam.Pose3]], carriers: Carriers, *, has_A: bool
) -> dict[str, Place]:
    """By its word: each place where a point of ``frame``, a "sensor" or a "target", can be expressed or not without A.

    ``poses`` has the frames on the carrier of the sensors, and of the targets.
    """
    places: dict[str, Place] = {}
    kinds = [own, *(kind for kind in poses if kind != own)]
    for kind in kinds:
        name, known = carriers.of(kind), list(CARRIER_WORDS[kind])
        if not has_A:
            known.remove(MORE_OFTEN_THE_OTHER[kind])
        is_across = kind != own
        usual = f"the frame that carries {f'the {kind}s' if is_across else frame}"
        words = (known if is_across == has_A else known[:1]) if name is None else [name, known[0]]
        for word in words:
            places.setdefault(word, Place(name or usual, None, is_across))
        if all(places[word].is_across != is_across for word in words):  # its words are names of the other carrier
            places[usual] = Place(name or usual, None, is_across)
    for kind in kinds:
        for name, pose in poses[kind].items():
            if name != frame:
                places.setdefault(name, Place(name, pose, kind != own))
    return places


def place_of(
    seen_from: object, frame: str, own: str, places: Mapping[str, Place], carriers: Carriers, *, has_A: bool
) -> Place:
    """Where a point of ``frame`` is expressed, by the word that a user gave, or None.

    Raises
    ------
    FrameError
        There is no such place, or it is on the other carrier and A is not given.
    OptionError
        A is given, and has no use.
    """
    if seen_from is None:
        return next(place for place in places.values() if place.frame is None and place.is_across == has_A)
    place = places.get(seen_from) if isinstance(seen_from, str) else None
    with_A = "uncertainty_at(..., A=T_sensorcarrier_targetcarrier)"
    is_unclear = isinstance(seen_from, str) and seen_from == MORE_OFTEN_THE_OTHER[own]
    if place is None and is_unclear and not has_A and carriers.of(own) is None:
        raise FrameError(
            f"it is not clear which carrier {seen_from!r} is, as the problem does not name its carriers; name them: "
            f'rw.Problem(sensor_carrier="hand", target_carrier="base"), or say seen_from="{CARRIER_WORDS[own][0]}" for '
            f"the carrier of {frame}; for the other carrier, which moves relative to {frame}, give the pose at that "
            f"moment too: {with_A}"
        )
    across = _listed(places, is_across=True)
    if place is None:
        raise FrameError(
            f"{brief(seen_from)} is no frame in which a point of {frame} can be expressed; there are its carrier "
            f"{_listed(places, is_across=False)}, and with A = T_sensorcarrier_targetcarrier the other carrier {across}"
        )
    if place.is_across and not has_A:
        other = "target" if own == "sensor" else "sensor"
        raise FrameError(
            f"{place.name} is on the carrier of the {other}s, which moves relative to {frame}; give the pose at that "
            f"moment too: {with_A}"
        )
    if has_A and not place.is_across:
        raise OptionError(
            f"A has no use: {place.name} and {frame} are on one carrier; leave A out, or take a frame on the other "
            f"carrier {across}"
        )
    return place


def _listed(places: Mapping[str, Place], *, is_across: bool) -> str:
    there = {word: place for word, place in places.items() if place.is_across == is_across}
    carrier, frames = ([word for word, of in there.items() if (of.frame is None) is it] for it in (True, False))
    return f"({', '.join(carrier)}){' and ' if frames else ''}{', '.join(frames)}"


#: Unit vectors whose mean is shorter than this have no common direction.
NO_DIRECTION = 0.1


@dataclass(frozen=True)
class SensorView:
    """Where a sensor saw its targets: the typical point (3,) in metres, and whether every one was in front of it."""

    point_m: tuple[float, float, float]
    in_front: bool


def views_of(
    problem: Problem, inliers: Mapping[Pair, np.ndarray], scale: float | dict[str, float]
) -> dict[str, SensorView]:
    """Where each sensor saw its targets: their median distance, in their mean direction, true metres."""
    points: dict[str, list[np.ndarray]] = {}
    if not problem.has_measurements:
        return {}
    for pair in problem.pairs:
        if pair.is_motion:
            continue
        seen = problem.measurements(*pair).B[:, :3, 3]
        if inliers:
            seen = seen[inliers[pair]]
        length = scale.get(pair.target) if isinstance(scale, dict) else scale
        if len(seen) and length is not None:
            points.setdefault(pair.sensor, []).append(seen / length)
    return {sensor: _view(np.concatenate(seen)) for sensor, seen in points.items()}


def _view(seen: np.ndarray) -> SensorView:
    distances = np.linalg.norm(seen, axis=1)
    mean = (seen / np.maximum(distances, 1e-300)[:, None]).mean(axis=0)
    length = float(np.linalg.norm(mean))
    # Seen all around, the mean has no direction; then z, which is forward for cameras.
    direction = mean / length if length > NO_DIRECTION else np.array([0.0, 0.0, 1.0])
    x, y, z = (float(np.median(distances)) * direction).tolist()
    return SensorView((x, y, z), bool((seen[:, 2] > 0.0).all()))


def point_uncertainty(
    refined: RefinedPoses,
    views: Mapping[str, SensorView],
    noise_m: Mapping[Pair, float],
    noise_of_A: CarrierNoise | None,
    carriers: Carriers,
    point: ArrayLike,
    *,
    frame: str,
    seen_from: str | None,
    level: float,
    A: PoseLike | None,
) -> PointUncertainty:
    """As ``Calibration.uncertainty_at``; ``noise_m`` is that of one measurement's translation, by pair, metres."""
    p, level = checked_point(point), checked_level(level)
    poses = {"sensor": refined.Y, "target": refined.X}
    own = next((kind for kind, of in poses.items() if isinstance(frame, str) and frame in of), None)
    if own is None:
        raise FrameError(
            f"there is no frame {brief(frame)}; there are the sensors {', '.join(refined.Y) or '(none)'} and the "
            f"targets {', '.join(refined.X) or '(none)'}"
        )
    if frame in views and views[frame].in_front and p[2] <= 0.0:
        raise PoseError(
            f"the point {p.tolist()} is behind {frame}, which saw every target in front of it (z > 0); give a "
            "point in the sensor's own frame, z forward, metres"
        )
    places = places_of(frame, own, poses, carriers, has_A=A is not None)
    place = place_of(seen_from, frame, own, places, carriers, has_A=A is not None)
    is_sensor = own == "sensor"
    on_carrier = poses[own][frame]
    T, levers = on_carrier, None
    if A is not None:
        given = gtsam.Pose3(one_transform(A, "A"))
        T = (given.inverse() if is_sensor else given).compose(on_carrier)
        here, there = np.asarray(on_carrier.transformFrom(p)), np.asarray(T.transformFrom(p))
        levers = {"sensorcarrier": here if is_sensor else there, "targetcarrier": there if is_sensor else here}
    if place.frame is not None:
        T = place.frame.between(T)
    R, q = T.rotation().matrix(), np.asarray(T.transformFrom(p))
    jacobians: dict[str | Unknown, Array] = {frame: jacobian_of_point(R, p)}
    if place.frame is not None:  # its error xi turns T into Expmap(-xi) T, and moves q by -(omega x q + v)
        jacobians[place.name] = -jacobian_of_point(np.eye(3), q)
    if "scale" in refined.names and is_sensor:
        jacobians["scale"] = -(R @ p)[:, None] / float(np.asarray(refined.scale))
    covariance = refined.covariance_of(jacobians)
    axes, half_lengths, radius = ellipsoid(covariance, level, refined.degrees_of_freedom)
    lever = None if levers is None or noise_of_A is None else levers[noise_of_A.about]
    sigma_m: float | None = 0.0
    if is_sensor:  # the median of its pairs
        noise = [value for pair, value in noise_m.items() if pair.sensor == frame]
        sigma_m = float(np.median(noise)) if noise else None
    return PointUncertainty(
        point_m=p,
        frame=frame,
        seen_from=place.name,
        level=level,
        centre_m=q,
        covariance_m2=covariance,
        axes=axes,
        half_lengths_mm=1e3 * half_lengths,
        radius_mm=1e3 * radius,
        measurement_mm=_measurement_mm(sigma_m, noise_of_A, lever, level),
    )


def _measurement_mm(
    sigma_m: float | None, noise_of_A: CarrierNoise | None, lever: Array | None, level: float
) -> float | None:
    """The radius of the noise of one new measurement: of B, and of A where the point crosses from carrier to carrier.

    An error [omega, v] of A moves the point by omega x l + v, in whichever frame; l is the point in
    the axes of the carrier that the noise is about. None where nothing is measured, or its noise is not known.
    """
    if sigma_m is None:
        return None
    if noise_of_A is None or lever is None:
        return 1e3 * math.sqrt(chdtri(3, 1.0 - level)) * sigma_m if sigma_m else None
    across = sigma_m**2 + noise_of_A.translation_m**2
    turned = across + noise_of_A.rotation_rad**2 * float(lever @ lever)
    return 1e3 * ball_radius(np.array([turned, turned, across]), level)
