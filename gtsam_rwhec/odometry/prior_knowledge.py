"""What is known of sensors beside their own motion: heights, the ground, directions, distances, poses."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import FrameError, NoiseError, OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.window_likelihood import Layout, State
from gtsam_rwhec.odometry.window_motions import WindowMotions

Vector = tuple[float, float, float]
#: What the known direction belongs to: an axis of the sensor, or the line from the reference sensor to it.
DirectionOf = Literal["x", "y", "z", "lever_arm"]

#: The largest distance between two sensors, and of a sensor above the ground, metres.
MOST_M = 150.0


@dataclass(frozen=True)
class Ground:
    """The plane that the vehicle drives on, in the reference sensor's frame."""

    normal: Vector  #: (x, y, z): it points up, away from the ground; of any length
    distance_m: float  #: Height of the reference sensor's origin above the plane, metres
    sigma_rad: float  #: Standard deviation of the normal about each axis across it, radians
    sigma_m: float  #: Standard deviation of the distance, metres


@dataclass(frozen=True)
class KnownDirection:
    """A direction in the reference sensor's frame."""

    sensor: str  #: The sensor that it is about
    of: DirectionOf  #: An axis of the sensor, or the line from the reference sensor's origin to the sensor's
    direction: Vector  #: (x, y, z): in the reference sensor's frame; of any length
    sigma_rad: float  #: Standard deviation about each axis across it, radians


@dataclass(frozen=True, eq=False)
class KnownPose:
    """The pose of one sensor in the frame of another, as another measurement has it."""

    first: str
    second: str
    T_first_second: Array  #: (4, 4)
    information: Array  #: (6, 6): of a right perturbation, rotation first; zero along what is not known

    def __str__(self) -> str:
        return f"the pose of {self.second} in {self.first}"

    @cached_property
    def root(self) -> Array:
        """(q, 6): root' root is the information."""
        values, along = np.linalg.eigh(self.information)
        told = values > ROUNDING * values[-1]
        return np.asarray(np.sqrt(values[told])[:, None] * along[:, told].T)


@dataclass(frozen=True)
class Given:
    """What a person knows; nothing by default."""

    #: by sensor: heights of the sensors' origins above the ground, metres. Give the reference sensor's height
    #: too, or ``ground``
    heights_m: dict[str, tuple[float, float]] = field(default_factory=dict, hash=False)
    #: The plane that the vehicle drives on. Without it, heights are along the vehicle's turning axis
    ground: Ground | None = None
    directions: tuple[KnownDirection, ...] = ()
    #: by (sensor, sensor): measured distances between two sensors' origins, metres; only the refinement uses them
    distances_m: dict[tuple[str, str], tuple[float, float]] = field(default_factory=dict, hash=False)
    poses: tuple[KnownPose, ...] = ()  #: Of two sensors; `LidarsTogether` has them by clouds

    def checked(self, sensors: Collection[str], reference: str) -> None:
        """Raise an error for what does not fit these sensors or is not a valid number.

        Raises
        ------
        FrameError
            A sensor is not there, is the reference where it may not be, or is given twice in a distance.
        NoiseError
            A standard deviation is not positive and finite.
        OptionError
            A value is not finite or larger than a vehicle, a distance or height not sensible, or a direction has no
            length.
        """
        for where, named in self._named():
            if named not in sensors:
                raise FrameError(
                    f"{where} is of {named!r}, and no track is of that sensor; the sensors are {', '.join(sensors)}"
                )
        for where, number in self._numbers():
            if not isinstance(number, tuple | list) or len(number) != 2:
                raise OptionError(f"{where} is {number!r}; give it with its standard deviation: (value, deviation)")
            value, sigma = number
            if not np.isfinite(value):
                raise OptionError(f"{where} is {value!r}; give a finite number")
            if not (np.isfinite(sigma) and sigma > 0.0):
                raise NoiseError(f"{where} has the standard deviation {sigma!r}; give a positive number")
            if abs(value) > MOST_M:
                raise OptionError(
                    f"{where} is {value:g} m, and no vehicle is larger than {MOST_M:g} m; give metres: {value:g} mm "
                    f"would be {1e-3 * value:g}"
                )
        for where, direction in self._vectors():
            length = float(np.linalg.norm(direction)) if len(direction) == 3 else 0.0
            if not (np.isfinite(length) and length > 0.0):
                raise OptionError(f"{where} is {direction!r}; give three numbers that are not all zero")
        for known in self.directions:
            if known.of not in get_args(DirectionOf):
                raise OptionError(
                    f"the direction of {known.sensor} is of {known.of!r}; choose one of "
                    f"{', '.join(get_args(DirectionOf))}"
                )
            if known.sensor == reference:
                raise FrameError(
                    f"a direction is given for {reference!r}, which is the reference: its axes are the frame itself"
                )
        for (first, second), (value, _) in self.distances_m.items():
            if first == second:
                raise FrameError(f"a distance of {first!r} to itself is given; name two sensors")
            if value <= 0.0:
                raise OptionError(f"the distance of {first} and {second} is {value:g} m; give a positive number")
        for pose in self.poses:
            T, information = np.asarray(pose.T_first_second), np.asarray(pose.information)
            if pose.first == pose.second or T.shape != (4, 4) or information.shape != (6, 6):
                raise OptionError(f"{pose} is no pose (4, 4) of two sensors with an information (6, 6)")
            if not (np.isfinite(T).all() and np.isfinite(information).all() and np.trace(information) > 0.0):
                raise NoiseError(f"{pose} is not finite, or its information is zero; leave it out")
        others = [name for name in self.heights_m if name != reference]
        if others and reference not in self.heights_m and self.ground is None:
            raise FrameError(
                f"the height of {others[0]} is given, and neither that of the reference sensor {reference} nor the "
                "ground: poses are in the reference's frame, so heights count from there; give its height too"
            )

    def _named(self) -> Iterator[tuple[str, str]]:
        yield from (("a height", name) for name in self.heights_m)
        yield from (("a direction", known.sensor) for known in self.directions)
        yield from (("a distance", name) for pair in self.distances_m for name in pair)
        yield from (("a pose", name) for known in self.poses for name in (known.first, known.second))

    def _numbers(self) -> Iterator[tuple[str, tuple[float, float]]]:
        yield from ((f"the height of {name}", number) for name, number in self.heights_m.items())
        yield from ((f"the distance of {a} and {b}", number) for (a, b), number in self.distances_m.items())
        yield from ((f"the direction of {known.sensor}", (0.0, known.sigma_rad)) for known in self.directions)
        if self.ground is not None:
            yield "the ground's distance", (self.ground.distance_m, self.ground.sigma_m)
            yield "the ground's normal", (0.0, self.ground.sigma_rad)

    def _vectors(self) -> Iterator[tuple[str, Vector]]:
        yield from ((f"the direction of {known.sensor}", known.direction) for known in self.directions)
        if self.ground is not None:
            yield "the ground's normal", self.ground.normal


_AXES = {"x": 0, "y": 1, "z": 2}  # columns of a rotation
#: Information below this share of the largest is rounding.
ROUNDING = 1e-12
#: The least length of a lever arm, metres: a shorter one has no direction.
LEAST_ARM_M = 1e-3


@dataclass(frozen=True)
class Number:
    """One given number: what it is, its value and its standard deviation."""

    what: str
    value: float
    sigma: float
    unit: str  #: "m" or "rad"; empty for a part of a known pose, which has both


@dataclass(frozen=True)
class Rows:
    """Whitened residuals (q,) and derivatives (q, p) at a state, and the given number behind each row."""

    r: Array
    J: Array
    numbers: tuple[Number, ...]

    @property
    def information(self) -> Array:
        """(p, p)."""
        return self.J.T @ self.J


@dataclass(frozen=True)
class GivenRows:
    """The prior knowledge, with sensors by their indices."""

    given: Given
    place: dict[str, int]  #: by sensor: 0 is the one in whose frame the poses are
    #: (3,): the ground's normal in the frame of sensor 0, pointing up: as given, or the vehicle's turning axis
    normal: Array
    sigma_normal: float  #: rad
    #: Standard deviation of a weak prior, which holds time offsets that the data do not determine
    clock_sigma_s: float

    @property
    def has_ground(self) -> bool:
        """Whether heights are given, so that the ground's normal and the reference's height are unknowns."""
        return bool(self.given.heights_m)

    @property
    def first_height(self) -> float:
        """The initial height of sensor 0, metres; zero without heights."""
        heights, ground = self.given.heights_m, self.given.ground
        if not heights:
            return 0.0
        if self._first in heights:
            return heights[self._first][0]
        return ground.distance_m if ground is not None else float(np.mean([height for height, _ in heights.values()]))

    @property
    def _first(self) -> str:
        return next(name for name, k in self.place.items() if k == 0)

    def rows(self, state: State, layout: Layout) -> Rows:
        """All residuals at a state."""
        r: list[float] = []
        J: list[Array] = []
        numbers: list[Number] = []

        def add(number: Number, off: float, *parts: tuple[np.ndarray | int, Array | float]) -> None:
            row = np.zeros(layout.size + 1)
            for at, derivative in parts:
                row[at] += derivative
            r.append(float(off) / number.sigma)
            J.append(row[:-1] / number.sigma)
            numbers.append(number)

        R, t = state.T[:, :3, :3], state.T[:, :3, 3]
        if self.has_ground:
            across = _across(self.normal)
            n = self.normal + across @ state.tilt
            tilts, height = layout.ground[:2], int(layout.ground[2])
            for tilt, which, off in zip(tilts, ("first", "second"), state.tilt, strict=True):
                add(Number(f"the ground's normal ({which} tilt)", 0.0, self.sigma_normal, "rad"), off, (tilt, 1.0))
            if (ground := self.given.ground) is not None:
                number = Number("the ground's distance", ground.distance_m, ground.sigma_m, "m")
                add(number, state.height - ground.distance_m, (height, 1.0))
            for name, (value, sigma) in self.given.heights_m.items():
                k = self.place[name]
                by_pose, by_tilts = (layout.at[k, 3:6], n @ R[k]), (tilts, across.T @ t[k])
                off = n @ t[k] + state.height - value
                add(Number(f"height of {name}", value, sigma, "m"), off, by_pose, by_tilts, (height, 1.0))
        for known in self.given.directions:
            k = self.place[known.sensor]
            what = f"direction of {known.sensor}'s {known.of.replace('_', ' ')}"
            for i, across in enumerate(_across(_unit(known.direction)).T, start=1):
                number = Number(f"{what} ({i})", 0.0, known.sigma_rad, "rad")
                if known.of == "lever_arm":
                    arm = max(float(np.linalg.norm(t[k])), LEAST_ARM_M)
                    add(number, across @ t[k] / arm, (layout.at[k, 3:6], across @ R[k] / arm))
                else:
                    e = np.eye(3)[_AXES[known.of]]
                    add(number, across @ R[k] @ e, (layout.at[k, :3], -across @ R[k] @ se3.hat(e[None])[0]))
        for (first, second), (value, sigma) in self.given.distances_m.items():
            j, k = self.place[first], self.place[second]
            length = max(float(np.linalg.norm(t[k] - t[j])), LEAST_ARM_M)
            u = (t[k] - t[j]) / length
            number = Number(f"distance of {first} and {second}", value, sigma, "m")
            add(number, length - value, (layout.at[k, 3:6], u @ R[k]), (layout.at[j, 3:6], -u @ R[j]))
        for pose in self.given.poses:
            j, k = self.place[pose.first], self.place[pose.second]
            T = se3.inverse(state.T[j][None])[0] @ state.T[k]
            off = pose.root @ se3.logmap((np.linalg.inv(pose.T_first_second) @ T)[None])[0]
            by_first = -pose.root @ se3.adjoint(se3.inverse(T[None]))[0]
            for value, one, other in zip(off, by_first, pose.root, strict=True):
                add(Number(str(pose), 0.0, 1.0, ""), value, (layout.at[j, :6], one), (layout.at[k, :6], other))
        for k in np.flatnonzero(layout.open[:, 7]).tolist():
            add(Number("", 0.0, self.clock_sigma_s, "s"), float(state.offset[k]), (int(layout.at[k, 7]), 1.0))
        return Rows(np.array(r), np.array(J).reshape(-1, layout.size), tuple(numbers))

    def form_rows(self, state: State, scaled: np.ndarray) -> Array:
        """Whitened rows (q, d) over the certified form's y; distances are not linear and have none.

        The height of sensor 0 is fixed in them, and its variance is added to that of each height. Only the exact
        likelihood has the correlations between heights.
        """
        K = len(state.T) - 1
        d = 12 * K + int(scaled[1:].sum()) + 1
        rows = []
        for name, (value, sigma) in self.given.heights_m.items():
            k = self.place[name]
            if k == 0:
                continue
            t = state.T[k, :3, 3]
            lateral = float(np.linalg.norm(t - self.normal * (self.normal @ t)))
            whole = np.sqrt(sigma**2 + self._reference_sigma**2 + (self.sigma_normal * lateral) ** 2)
            # For a scaled sensor the form has t' = alpha t: the row is multiplied by the estimated scale.
            row = np.zeros(d)
            row[9 * K + 3 * k - 3 : 9 * K + 3 * k] = self.normal
            row[-1] = -state.scale[k] * (value - self.first_height)
            rows.append(row / (whole * state.scale[k]))
        for known in self.given.directions:
            k, along = self.place[known.sensor], _unit(known.direction)
            is_arm = known.of == "lever_arm"
            arm = max(float(np.linalg.norm(state.T[k, :3, 3])), 0.1) * state.scale[k] if is_arm else 1.0
            at = 9 * K + 3 * k - 3 if is_arm else 9 * (k - 1) + 3 * _AXES[known.of]
            for across in _across(along).T:
                row = np.zeros(d)
                row[at : at + 3] = across / (arm * known.sigma_rad)
                rows.append(row)
                if not is_arm:
                    # The rows across also fit the opposite direction; the component along the axis excludes it.
                    row = np.zeros(d)
                    row[at : at + 3], row[-1] = along, -1.0
                    rows.append(row)
        for pose in self.given.poses:
            rows += list(self._of_pose(pose, state, d))
        return np.array(rows).reshape(-1, d)

    def _of_pose(self, pose: KnownPose, state: State, d: int) -> Array:
        """Whitened rows (q, d): how y's pose differs from a known one, in the axes of the second at the state."""
        K, (j, k) = len(state.T) - 1, (self.place[pose.first], self.place[pose.second])

        def parts(sensor: int) -> tuple[Array, Array]:
            rotation, translation = np.zeros((9, d)), np.zeros((3, d))
            if sensor:
                rotation[:, 9 * sensor - 9 : 9 * sensor] = np.eye(9)
                at = 9 * K + 3 * sensor - 3
                translation[:, at : at + 3] = np.eye(3) / state.scale[sensor]
            else:
                rotation[:, -1] = np.eye(3).ravel()
            return rotation, translation

        (R_j, t_j), (R_k, t_k) = parts(j), parts(k)
        R, t = pose.T_first_second[:3, :3], pose.T_first_second[:3, 3]
        back = (state.T[j, :3, :3] @ R).T
        # I + hat(turn) by columns, less the part that is symmetric, which is small to second order.
        off = np.kron(np.eye(3), back) @ (R_k - np.kron(R.T, np.eye(3)) @ R_j)
        turn = 0.5 * (off[[5, 6, 1]] - off[[7, 2, 3]])
        shift = back @ (t_k - t_j - np.kron(t, np.eye(3)) @ R_j)
        rows = pose.root @ np.concatenate([turn, shift])
        # Half a turn has no such part either; the whole difference excludes it.
        turns_known = np.linalg.eigvalsh(pose.information[:3, :3])[0] > 1.0
        return np.concatenate([rows, off]) if turns_known else np.asarray(rows)

    @property
    def _reference_sigma(self) -> float:
        heights, ground = self.given.heights_m, self.given.ground
        sigmas = [heights[self._first][1]] if self._first in heights else []
        return min([*sigmas, *([ground.sigma_m] if ground is not None else [])], default=0.0)


def _unit(direction: tuple[float, float, float] | Array) -> Array:
    vector: Array = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    return vector


def _across(axis: Array) -> Array:
    """Two unit vectors (3, 2), perpendicular to an axis and to each other."""
    _, _, Vt = np.linalg.svd(axis[None])
    return Vt[1:].T


#: An axis is taken as up if it is within this angle of the reference's +z axis or -y axis.
NEAR_RAD = np.radians(40.0)


def up_direction(given: Given, windows: WindowMotions, variances: Array, reference: str) -> tuple[Array, float]:
    """The ground's normal (3,), pointing up, in the frame of sensor 0, and its standard deviation in rad.

    Without a given ground it is the axis about which sensor 0 turned most. It is made to point along +z, or, in an
    optical frame (z forward, y down), along -y. Raises `OptionError` if heights are given without the ground, and the
    turning axis is near neither z nor y.
    """
    if given.ground is not None:
        return _unit(given.ground.normal), given.ground.sigma_rad
    axis, sigma = turning_axis(windows, variances)
    if abs(axis[2]) > np.cos(NEAR_RAD):
        axis = axis * np.sign(axis[2])
    elif abs(axis[1]) > np.cos(NEAR_RAD):
        axis = -axis * np.sign(axis[1])
    elif given.heights_m:
        raise OptionError(
            f"heights are given, and the vehicle turned about ({', '.join(f'{x:.2f}' for x in axis)}) of {reference}'s "
            "frame, which is near neither its z axis nor its y axis: nothing says which way is up. Give the ground, "
            "with its normal in that frame"
        )
    return axis, sigma


def turning_axis(windows: WindowMotions, variances: Array) -> tuple[Array, float]:
    """The axis (3,) about which sensor 0 turned most, and its standard deviation in rad.

    On a plane, this axis is the normal up to noise. Turns about other axes above the noise show that the ground is not
    a plane. Their mean square, divided by ten (as for ten independent parts of a drive), is then added to the variance.
    """
    used = windows.used[0]
    w = windows.rotation_vectors()[0, used]
    square, axes = np.linalg.eigh(w.T @ w)
    noise = float((variances[0, 0] * windows.length[0, used]).sum())
    of_noise = np.sqrt(noise / len(w) / max(square[2], 1e-300))
    beyond = max(float(square[1]) - 1.3 * noise, 0.0)
    return axes[:, 2], float(np.hypot(of_noise, np.sqrt(beyond / max(square[2], 1e-300) / 10.0)))


def upside_down(normal: Array, T: Array) -> np.ndarray:
    """For sensors at T (m, 4, 4): 1 where ``normal`` points down by the sensor's axes, -1 where up, 0 where neither.

    As in `up_direction`, z points up; if z is near neither, y points down. Returns (m,).
    """
    along = np.einsum("mij,i->mj", T[:, :3, :3], normal)
    limit = np.cos(NEAR_RAD)
    by_z = np.where(np.abs(along[:, 2]) > limit, -np.sign(along[:, 2]), 0.0)
    by_y = np.where(np.abs(along[:, 1]) > limit, np.sign(along[:, 1]), 0.0)
    return np.where(by_z != 0.0, by_z, by_y)
