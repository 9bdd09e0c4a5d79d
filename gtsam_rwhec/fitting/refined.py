"""The refined calibration: poses, covariances, noise, and the GTSAM graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal, NamedTuple, Self

import gtsam
import numpy as np
from scipy.special import chdtri, fdtri

from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.reprojection_record import Intrinsics, Reprojection
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.pose_covariances import error_of, relative_jacobian, standard_deviations
from gtsam_rwhec.geometry.poses import Array, PoseLike
from gtsam_rwhec.geometry.real_numbers import finite_or_none, is_real, is_whole
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.solver.free_directions import FreeDirection
from gtsam_rwhec.solver.solution import Solution

#: A function that a free direction moves by no more than this, in units, is not moved: the rest is rounding.
NOT_MOVED = 1e-9


@dataclass(frozen=True)
class Movement:
    """The difference of a frame's pose from the certified solution: translation_mm and rotation_deg."""

    translation_mm: float
    rotation_deg: float


@dataclass(frozen=True)
class PairNoise:
    """The noise of a pair's B, of the median measurement, root mean square over axes (of moments: of all measurements).

    ``degrees_of_freedom`` (rotation, translation) of the estimated noise; infinite if the noise was given.
    """

    rotation_rad: float
    translation_m: float
    degrees_of_freedom: tuple[float, float]


@dataclass(frozen=True)
class RefinedPoses:
    """Refined poses with their covariances: the part of a `Refined` that a result file keeps.

    Covariances are of right perturbations, T Expmap(xi), xi = [omega (rad), v (m)], in the frame's own axes (GTSAM's
    convention; ``rw.pose_covariances`` converts them). They are infinite along free directions.
    """

    #: T_targetcarrier_target and T_sensorcarrier_sensor, metres.
    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float | dict[str, float]
    scale_mode: ScaleMode
    #: By sensor, if estimated: the sensor's stamp t is the carriers' t + offset.
    time_offsets_s: dict[str, float]
    noise_source: Literal["given", "estimated"]
    noise: dict[Pair, PairNoise]
    #: The graph's cost at the end, and at the certified solution.
    cost: float
    initial_cost: float
    #: Number of Levenberg-Marquardt steps, in all rounds of re-weighting together.
    iterations: int
    moved: dict[str, Movement]
    #: (int, int) each. Numbers of inliers and of measurements with robust="gnc"; else empty.
    inlier_counts: dict[Pair, tuple[int, int]]
    #: Empty if everything is determined.
    free_directions: tuple[FreeDirection, ...]
    #: The covariance of all unknowns.
    joint: JointCovariance = field(repr=False)
    #: Errors in pixels, and what was tried, where the refinement is from corners.
    reprojection: Reprojection | None = field(default=None, kw_only=True, repr=False)
    #: Of the sensors whose intrinsics were estimated with the poses; their covariance is that of "intrinsics:SENSOR".
    intrinsics: dict[str, Intrinsics] = field(default_factory=dict, kw_only=True, repr=False)

    def covariance(self, *names: str | Unknown) -> Array:
        """The joint covariance (m, m) of frames, scales and time offsets, in the order given.

        It is zero for fixed frames, and infinite in the rows that a free direction changes. Where the noise was
        estimated, it has `degrees_of_freedom`: take ``squared_radius`` for ellipsoids, which is an F quantile then, and
        no chi-square quantile.

        Parameters
        ----------
        names : str or Unknown
            Frames (six rows each), "scale" or "scale:NAME", "time_offset:SENSOR" (one row each). Without names: all
            unknowns, in the order of ``self.names``.

        Raises
        ------
        FrameError
            If the problem has no such name.
        """
        asked = [Unknown.of(name) for name in names] or list(self.unknowns)
        if not asked:  # everything is fixed
            return np.zeros((0, 0))
        covariance = self.joint.covariance_of(np.concatenate([self._rows_of(unknown) for unknown in asked]))
        for unknown, (first, end) in zip(asked, pairwise(np.cumsum([0, *map(self._width_of, asked)])), strict=True):
            if unknown in self.joint.slots:
                covariance[first:end, first:end] += self.joint.turned(unknown)
        return covariance

    def covariance_of(self, jacobians: Mapping[str | Unknown, Array]) -> Array:
        """The covariance (m, m) of a function of frames, scales and time offsets, to first order.

        Parameters
        ----------
        jacobians : dict of str or Unknown to (m, d) array
            The function's derivative by each unknown that it depends on: by the right perturbation of a frame (d = 6),
            by a scale or a time offset (d = 1). Fixed frames add nothing.

        Raises
        ------
        FrameError
            If the problem has no such name.
        """
        named = {Unknown.of(name): J for name, J in jacobians.items()}
        G = np.sum([J @ self._rows_of(unknown) for unknown, J in named.items()], axis=0)
        covariance = self.joint.covariance_of(G)
        if np.abs(self.joint.reach(G)).max(initial=0.0) > NOT_MOVED:
            for unknown, J in named.items():
                if unknown in self.joint.slots:
                    covariance += J @ self.joint.turned(unknown) @ J.T
        return covariance

    def with_errors(self, moves: Mapping[str, Array]) -> Self:
        """The same, where k errors, one standard deviation each, move frames together by so much (6, k)."""
        along = np.zeros((len(self.joint.unit), len(next(iter(moves.values()), np.zeros((6, 0))).T)))
        for name, move in moves.items():
            rows = self.joint.slots.get(Unknown.of(name))
            if rows is not None:
                along[rows] = move
        return replace(self, joint=replace(self.joint, finite=self.joint.finite + along @ along.T))

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """All unknowns."""
        return tuple(self.joint.slots)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all unknowns."""
        return tuple(map(str, self.unknowns))

    def information(self, *names: str | Unknown) -> Array:
        """Marginal information (m, m) of unknowns: the covariance's inverse, and zero along free directions.

        Where a free direction is oblique to the axes the information still holds everything that is known; the
        covariance does not. FrameError if a name is not among the unknowns, or is given twice.
        """
        asked = tuple(Unknown.of(name) for name in names) or self.unknowns
        if len(set(asked)) != len(asked):
            raise FrameError(f"the information of {', '.join(map(str, asked))} is singular; give each name once")
        return self.joint.information_of(asked)

    def relative(self, first: str, second: str) -> tuple[gtsam.Pose3, Array]:
        """T_first_second of two frames on one carrier, and the covariance (6, 6) of its right perturbation.

        Two cameras of a rig often have a far smaller relative covariance than each camera on its carrier. FrameError if
        the problem has no such frame, or the frames are on two carriers.
        """
        first, second = (self._name(name) for name in (first, second))
        poses = next((p for p in (self.X, self.Y) if first in p and second in p), None)
        if poses is None:
            for name in (first, second):
                self._rows_of(Unknown.of(name))
            raise FrameError(
                f"{first!r} and {second!r} are on two carriers, which move relative to each other, so they have no "
                "fixed relative pose; ask for two sensors or two targets"
            )
        if first == second:
            raise FrameError(f"{first!r} has no pose relative to itself; ask for two frames")
        J = relative_jacobian(poses[first], poses[second])
        G = J @ np.concatenate([self._rows_of(Unknown.of(name)) for name in (first, second)])
        return poses[first].between(poses[second]), self.joint.covariance_of(G)

    def standard_deviations(self, name: str) -> tuple[Array, Array]:
        """A frame's standard deviations (3,) in degrees about and (3,) in millimetres along its own x, y, z."""
        if self._name(name) not in self.X and name not in self.Y:
            raise FrameError(
                f"{name!r} is not a frame and has no axes; there are {', '.join(self.X | self.Y)} (of a scale or an "
                "offset take the root of covariance(name))"
            )
        return standard_deviations(self.covariance(name))

    @property
    def degrees_of_freedom(self) -> float:
        """The fewest degrees of freedom of any group's estimated noise; infinite if the noise was given."""
        return min((min(noise.degrees_of_freedom) for noise in self.noise.values()), default=np.inf)

    def squared_radius(self, dimension: int, confidence: float = 0.95) -> float:
        """The largest xi' covariance^-1 xi inside the confidence ellipsoid.

        It is a chi-square quantile if the noise was given; if the noise was estimated, dimension times an F quantile.
        """
        if not (is_real(confidence) and 0.0 < confidence < 1.0):
            raise OptionError(f"confidence={brief(confidence)}; give one between 0 and 1")
        if not is_whole(dimension, 1):
            raise OptionError(f"dimension={brief(dimension)}; give a whole number of at least 1")
        if np.isinf(self.degrees_of_freedom):
            return float(chdtri(dimension, 1.0 - confidence))
        return float(dimension * fdtri(dimension, self.degrees_of_freedom, confidence))

    def contains(self, name: str, T_carrier_frame: PoseLike, confidence: float = 0.95) -> bool:
        """Whether a pose is inside a frame's confidence ellipsoid.

        Raises
        ------
        FrameError, PoseError
            If the problem has no such frame, or the pose is not valid.
        """
        poses = self.X | self.Y
        if self._name(name) not in poses:
            raise FrameError(f"there is no frame {name!r}; there are {', '.join(poses)}")
        xi = error_of(poses[name], T_carrier_frame)
        if name not in self.names:
            return bool(np.abs(xi).max() < 1e-9)
        return bool(xi @ self.information(name) @ xi <= self.squared_radius(6, confidence))

    def _width_of(self, unknown: Unknown) -> int:
        """The number of an unknown's parameters."""
        slot = self.joint.slots.get(unknown)
        return unknown.dimension if slot is None else slot.stop - slot.start

    @staticmethod
    def _name(name: object) -> str:
        return str(Unknown.of(name))

    def _rows_of(self, unknown: Unknown) -> Array:
        """The matrix (m, d) that selects an unknown's rows; zero for a fixed frame."""
        if unknown not in self.joint.slots:
            if unknown == Unknown(UnknownKind.SCALE):
                why = "it is known, 1" if self.scale_mode == "known" else "each target has its own: 'scale:NAME'"
                raise FrameError(f"'scale' is not an unknown: {why}")
            known = dict.fromkeys((*self.X, *self.Y, *self.names))
            if str(unknown) not in known:
                raise FrameError(f"there is no {str(unknown)!r}; there are {', '.join(known)}")
            return np.zeros((6, len(self.joint.unit)))
        return self.joint.selector((unknown,))


class FactorGraph(NamedTuple):
    """A GTSAM graph, its values at the optimum, and its variables' keys by name."""

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    keys: dict[str, int]


@dataclass(frozen=True, repr=False)
class Refined(RefinedPoses):
    """A refined calibration, with everything that `RefinedPoses` has, and the graph."""

    #: Makes the graph, once it is asked for.
    factor_graph: Callable[[], FactorGraph]
    #: (N,) each. The inliers with robust="gnc"; else empty.
    inliers: dict[Pair, np.ndarray]
    #: The certified solution that was refined; with robust="gnc" it is the inliers' solution.
    solution: Solution
    options: RefineOptions
    #: What was found of the noise of A and B, in time and over the configuration; empty where only B's was estimated.
    noise_sentences: tuple[str, ...] = ()

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors, to go on with."""
        return self.factor_graph().graph

    @property
    def values(self) -> gtsam.Values:
        """The graph's values at the optimum."""
        return self.factor_graph().values

    @property
    def keys(self) -> dict[str, int]:
        """The variables' keys by name: frames, "scale" or "scale:NAME", "time_offset:SENSOR", and effects of noise."""
        return self.factor_graph().keys

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({len(self.X)} targets, {len(self.Y)} sensors, noise {self.noise_source}, "
            f"cost {self.cost:.6g}, {len(self.free_directions)} free directions)"
        )

    def __reduce__(self) -> str:
        raise TypeError(
            "a Refined has a GTSAM graph with Python factors, which cannot be pickled or copied; rw.write_refined "
            "writes everything except the graph"
        )


def sigma_of(refined: RefinedPoses, scalar: str | Unknown) -> float | None:
    """The standard deviation of a scale or of a time offset, None where it is infinite."""
    return finite_or_none(math.sqrt(refined.covariance(scalar)[0, 0]))
