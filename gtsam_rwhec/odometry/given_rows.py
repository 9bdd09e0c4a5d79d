"""What a person gives as residuals: of the exact likelihood, and, where they are linear, of the certified form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.given import Given
from gtsam_rwhec.odometry.unknowns import Layout, State

_AXES = {"x": 0, "y": 1, "z": 2}
#: The least length of a lever arm whose direction is given, metres: shorter ones have none.
LEAST_ARM_M = 1e-3


@dataclass(frozen=True)
class Number:
    """One given number: what it is, its value, standard deviation and unit ("m" or "rad")."""

    what: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Rows:
    """Whitened residuals (q,) and derivatives (q, p) at a state, with the number of each."""

    r: Array
    J: Array
    numbers: tuple[Number, ...]

    @property
    def information(self) -> Array:
        """(p, p)."""
        product: Array = self.J.T @ self.J
        return product


@dataclass(frozen=True)
class GivenRows:
    """What is given, by the places of the sensors.

    Attributes
    ----------
    given : Given
    place : dict of sensor to int
        0 is the one in whose frame the poses are.
    normal : (3,) array
        The ground's normal there, as given or as the axis that the vehicle turned about; it points up.
    sigma_normal : float
        rad.
    clock_sigma_s : float
        What time offsets may be off at most, one standard deviation: keeps those that the data do not tell.
    """

    given: Given
    place: dict[str, int]
    normal: Array
    sigma_normal: float
    clock_sigma_s: float

    @property
    def has_ground(self) -> bool:
        """Whether heights are given, so that the ground's normal and the reference's height are unknowns."""
        return bool(self.given.heights_m)

    @property
    def first_height(self) -> float:
        """A start for the height of sensor 0."""
        ground = self.given.ground
        named = [name for name, k in self.place.items() if k == 0]
        if named[0] in self.given.heights_m:
            return self.given.heights_m[named[0]][0]
        return (
            ground.distance_m if ground is not None else float(np.mean([h for h, _ in self.given.heights_m.values()]))
        )

    def rows(self, state: State, layout: Layout, *, distances: bool = True) -> Rows:
        """All residuals at a state."""
        r: list[float] = []
        J: list[Array] = []
        numbers: list[Number] = []

        def add(number: Number, off: float, *parts: tuple[np.ndarray | int, Array | float]) -> None:
            row = np.zeros(layout.size + 1)
            for at, derivative in parts:
                row[at] += derivative
            r.append(off / number.sigma)
            J.append(row[:-1] / number.sigma)
            numbers.append(number)

        T = state.T
        if self.has_ground:
            across = _across(self.normal)
            n = self.normal + across @ state.tilt
            tilts, height = layout.ground[:2], int(layout.ground[2])
            for i in range(2):
                number = Number(
                    f"the ground's normal ({'first' if i == 0 else 'second'} tilt)", 0.0, self.sigma_normal, "rad"
                )
                add(number, float(state.tilt[i]), (int(tilts[i]), 1.0))
            ground = self.given.ground
            if ground is not None:
                number = Number("the ground's distance", ground.distance_m, ground.sigma_m, "m")
                add(number, state.height - ground.distance_m, (height, 1.0))
            for name, (value, sigma) in self.given.heights_m.items():
                k = self.place[name]
                off = float(n @ T[k, :3, 3]) + state.height - value
                by_pose = np.r_[np.zeros(3), n @ T[k, :3, :3]]
                number = Number(f"height of {name}", value, sigma, "m")
                add(number, off, (layout.at[k, :6], by_pose), (tilts, across.T @ T[k, :3, 3]), (height, 1.0))
        for known in self.given.directions:
            k, across = self.place[known.sensor], _across(_unit(known.direction))
            R, t = T[k, :3, :3], T[k, :3, 3]
            for i in range(2):
                number = Number(
                    f"direction of {known.sensor}'s {known.of.replace('_', ' ')} ({i + 1})", 0.0, known.sigma_rad, "rad"
                )
                if known.of == "lever_arm":
                    arm = max(float(np.linalg.norm(t)), LEAST_ARM_M)
                    by_pose = np.r_[np.zeros(3), across[:, i] @ R] / arm
                    add(number, float(across[:, i] @ t) / arm, (layout.at[k, :6], by_pose))
                else:
                    e = np.eye(3)[_AXES[known.of]]
                    by_pose = np.r_[-across[:, i] @ R @ se3.hat(e[None])[0], np.zeros(3)]
                    add(number, float(across[:, i] @ R @ e), (layout.at[k, :6], by_pose))
        if distances:
            for (first, second), (value, sigma) in self.given.distances_m.items():
                j, k = self.place[first], self.place[second]
                apart = T[k, :3, 3] - T[j, :3, 3]
                length = max(float(np.linalg.norm(apart)), LEAST_ARM_M)
                u = apart / length
                number = Number(f"distance of {first} and {second}", value, sigma, "m")
                add(
                    number,
                    length - value,
                    (layout.at[k, 3:6], u @ T[k, :3, :3]),
                    (layout.at[j, 3:6], -u @ T[j, :3, :3]),
                )
        for k in np.flatnonzero(layout.open[:, 7]).tolist():
            add(Number("", 0.0, self.clock_sigma_s, "s"), float(state.offset[k]), (int(layout.at[k, 7]), 1.0))
        return Rows(np.array(r), np.array(J).reshape(-1, layout.size), tuple(numbers))

    def form_rows(self, state: State, scaled: np.ndarray) -> Array:
        """Whitened rows (q, d) over the certified form's y; distances are not linear and have none.

        The height of sensor 0 is taken as given there, with its deviation in each height's; the exact likelihood has
        what heights share.
        """
        K = len(state.T) - 1
        which = np.flatnonzero(scaled[1:])
        d = 12 * K + len(which) + 1
        rows = []
        reference = self.first_height if self.has_ground else 0.0
        for name, (value, sigma) in self.given.heights_m.items():
            k = self.place[name]
            if k == 0:
                continue
            t = state.T[k, :3, 3]
            lateral = float(np.linalg.norm(t - self.normal * (self.normal @ t)))
            whole = np.sqrt(sigma**2 + self._reference_sigma**2 + (self.sigma_normal * lateral) ** 2)
            # Of a scaled sensor the form has t' = alpha t: the row is about it times the scale of the estimate.
            row = np.zeros(d)
            row[9 * K + 3 * k - 3 : 9 * K + 3 * k] = self.normal
            row[-1] = -state.scale[k] * (value - reference)
            rows.append(row / (whole * state.scale[k]))
        for known in self.given.directions:
            k, across = self.place[known.sensor], _across(_unit(known.direction))
            for i in range(2):
                row = np.zeros(d)
                if known.of == "lever_arm":
                    arm = max(float(np.linalg.norm(state.T[k, :3, 3])), 0.1) * state.scale[k]
                    row[9 * K + 3 * k - 3 : 9 * K + 3 * k] = across[:, i] / arm
                else:
                    axis = 9 * (k - 1) + 3 * _AXES[known.of]
                    row[axis : axis + 3] = across[:, i]
                rows.append(row / known.sigma_rad)
                if known.of != "lever_arm":
                    # Both ways of the axis are across it; the length along it tells them apart.
                    along = np.zeros(d)
                    along[axis : axis + 3] = _unit(known.direction)
                    along[-1] = -1.0
                    rows.append(along)
        return np.array(rows).reshape(-1, d)

    @property
    def _reference_sigma(self) -> float:
        ground = self.given.ground
        named = [name for name, k in self.place.items() if k == 0]
        sigmas = [self.given.heights_m[name][1] for name in named if name in self.given.heights_m]
        sigmas += [ground.sigma_m] if ground is not None else []
        return min(sigmas, default=0.0)


def _unit(direction: tuple[float, float, float] | Array) -> Array:
    vector: Array = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    return vector


def _across(axis: Array) -> Array:
    """Two unit vectors (3, 2) across an axis and each other."""
    _, _, Vt = np.linalg.svd(axis[None])
    basis: Array = Vt[1:].T
    return basis
