"""What refining returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import gtsam
import numpy as np
from scipy.special import chdtri, fdtri

from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.geometry.pose_covariances import error_of, relative_jacobian, standard_deviations
from gtsam_rwhec.geometry.poses import Array, PoseLike
from gtsam_rwhec.identifiability.free_directions import FreeDirection
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind
from gtsam_rwhec.solving.solution import Solution


@dataclass(frozen=True)
class Movement:
    """How far a frame moved from the certified solution: translation_mm and rotation_deg."""

    translation_mm: float
    rotation_deg: float


@dataclass(frozen=True)
class PairNoise:
    """The noise of a pair's B that the covariances rest on, root mean square an axis, and how well it is known.

    ``degrees_of_freedom``, (rotation, translation), is how many the noise was estimated with: infinite where given.
    """

    rotation_rad: float
    translation_m: float
    degrees_of_freedom: tuple[float, float]


@dataclass(frozen=True)
class RefinedPoses:
    """Refined poses and how well they are known: what a result file keeps of a `Refined`.

    Covariances are of right perturbations, T Expmap(xi), xi = [omega (rad), v (m)], in the frame's own axes (GTSAM's
    convention; ``rw.pose_covariances`` turns them into others). They are infinite along directions that the
    measurements leave free.

    Attributes
    ----------
    X, Y : dict of str to gtsam.Pose3
        T_targetcarrier_target and T_sensorcarrier_sensor, metres.
    scale : float or dict of str to float
    scale_mode : "known", "shared" or "per_target"
    time_offsets_s : dict of str to float
        Of each sensor for which it was estimated: its stamp t is the carriers' t + offset.
    noise_source : "given" or "estimated"
    noise : dict of (target, sensor) to PairNoise
    cost, initial_cost : float
        Of the graph, at the end and at the certified solution.
    iterations : int
        Levenberg-Marquardt steps, of all rounds of re-weighting together.
    moved : dict of str to Movement
    inlier_counts : dict of (target, sensor) to (int, int)
        Inliers, and measurements, with robust="gnc"; else empty.
    free_directions : tuple of FreeDirection
        Empty where everything is determined.
    joint : JointCovariance
        Of everything that was unknown.
    """

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float | dict[str, float]
    scale_mode: ScaleMode
    time_offsets_s: dict[str, float]
    noise_source: Literal["given", "estimated"]
    noise: dict[Pair, PairNoise]
    cost: float
    initial_cost: float
    iterations: int
    moved: dict[str, Movement]
    inlier_counts: dict[Pair, tuple[int, int]]
    free_directions: tuple[FreeDirection, ...]
    joint: JointCovariance = field(repr=False)

    def covariance(self, *names: str | Unknown) -> Array:
        """Joint covariance of frames, scales and time offsets, in the order given.

        Parameters
        ----------
        names : str or Unknown
            Frames (six rows each), "scale" or "scale:NAME", "time_offset:SENSOR" (one row each). None: everything
            that was unknown, in the order of ``names``.

        Returns
        -------
        (m, m) array
            Zero for what is fixed; infinite in the rows that a free direction reaches.

        Raises
        ------
        FrameError
            For a name that there is not.
        """
        asked = [Unknown.of(name) for name in names] or list(self.unknowns)
        if not asked:  # everything is fixed
            return np.zeros((0, 0))
        covariance = self.joint.covariance_of(np.concatenate([self._rows_of(unknown) for unknown in asked]))
        for unknown, (first, end) in zip(asked, pairwise(np.cumsum([0, *(u.dimension for u in asked)])), strict=True):
            if unknown in self.joint.slots:
                covariance[first:end, first:end] += self.joint.turned(unknown)
        return covariance

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Everything that was unknown."""
        return tuple(self.joint.slots)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of everything that was unknown."""
        return tuple(map(str, self.unknowns))

    def information(self, *names: str | Unknown) -> Array:
        """Marginal information (m, m) of unknowns: the covariance's inverse, and zero along free directions.

        Unlike the covariance it holds everything that is known where a free direction is oblique to the axes.

        Raises
        ------
        FrameError
            For a name that is not among the unknowns.
        """
        asked = tuple(Unknown.of(name) for name in names) or self.unknowns
        if len(set(asked)) != len(asked):
            raise FrameError(f"the information of {', '.join(map(str, asked))}: name each once, or it is singular")
        return self.joint.information_of(asked)

    def relative(self, first: str, second: str) -> tuple[gtsam.Pose3, Array]:
        """T_first_second of two frames on one carrier, and the covariance (6, 6) of its right perturbation.

        What two cameras of a rig have between them; often far better known than either on its carrier.

        Raises
        ------
        FrameError
            For names that there are not, or on two carriers.
        """
        poses = next((p for p in (self.X, self.Y) if first in p and second in p), None)
        if poses is None:
            for name in (first, second):
                self._rows_of(Unknown.of(name))
            raise FrameError(
                f"{first!r} and {second!r} are on two carriers, which move against one another: they have no relative "
                "pose; ask for two sensors or two targets"
            )
        if first == second:
            raise FrameError(f"{first!r} has no pose relative to itself; ask for two frames")
        J = relative_jacobian(poses[first], poses[second])
        G = J @ np.concatenate([self._rows_of(Unknown.of(name)) for name in (first, second)])
        return poses[first].between(poses[second]), self.joint.covariance_of(G)

    def standard_deviations(self, name: str) -> tuple[Array, Array]:
        """A frame's (3,) in degrees about, and (3,) in millimetres along, its own x, y, z."""
        if name not in self.X and name not in self.Y:
            raise FrameError(
                f"{name!r} is no frame, and has no axes; there are {', '.join(self.X | self.Y)} (of a scale or an "
                "offset take the root of covariance(name))"
            )
        return standard_deviations(self.covariance(name))

    @property
    def degrees_of_freedom(self) -> float:
        """Equations that the estimated noise rests on, the fewest of any group; infinite where it was given."""
        return min((min(noise.degrees_of_freedom) for noise in self.noise.values()), default=np.inf)

    def squared_radius(self, dimension: int, confidence: float = 0.95) -> float:
        """Up to which xi' covariance^-1 xi is inside the confidence ellipsoid.

        A chi-square quantile where the noise was given; where it was estimated, dimension times an F quantile.
        """
        if not 0.0 < confidence < 1.0:
            raise OptionError(f"confidence={confidence!r}; give one between 0 and 1")
        if np.isinf(self.degrees_of_freedom):
            return float(chdtri(dimension, 1.0 - confidence))
        return float(dimension * fdtri(dimension, self.degrees_of_freedom, confidence))

    def contains(self, name: str, T_carrier_frame: PoseLike, confidence: float = 0.95) -> bool:
        """Whether a pose is inside a frame's confidence ellipsoid.

        Raises
        ------
        FrameError, PoseError
            For a name or a pose that is none.
        """
        poses = self.X | self.Y
        if name not in poses:
            raise FrameError(f"there is no frame {name!r}; there are {', '.join(poses)}")
        xi = error_of(poses[name], T_carrier_frame)
        if name not in self.names:
            return bool(np.abs(xi).max() < 1e-9)
        return bool(xi @ self.information(name) @ xi <= self.squared_radius(6, confidence))

    def _rows_of(self, unknown: Unknown) -> Array:
        """(m, d): its rows of the unknowns; zero for a fixed frame."""
        if unknown not in self.joint.slots:
            if unknown == Unknown(UnknownKind.SCALE):
                why = "it is known, 1" if self.scale_mode == "known" else "each target has its own: 'scale:NAME'"
                raise FrameError(f"there is no one scale to ask for; {why}")
            known = dict.fromkeys((*self.X, *self.Y, *self.names))
            if str(unknown) not in known:
                raise FrameError(f"there is no {str(unknown)!r}; there are {', '.join(known)}")
            return np.zeros((6, len(self.joint.unit)))
        return self.joint.selector((unknown,))


@dataclass(frozen=True, repr=False)
class Refined(RefinedPoses):
    """A refined calibration, with covariances, and the graph to go on with.

    Attributes
    ----------
    graph, values : gtsam.NonlinearFactorGraph, gtsam.Values
        To go on with.
    keys : dict of str to int
        The variables' keys in them, by name: frames, "scale" ("scale:NAME" for each with scale="per_target"),
        "time_offset:SENSOR".
    inliers : dict of (target, sensor) to (N,) booleans
        With robust="gnc"; else empty.
    solution : Solution
        The certified solution that was refined (with robust="gnc": of the inliers).
    options : RefineOptions

    And everything that `RefinedPoses` has.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    keys: dict[str, int]
    inliers: dict[Pair, np.ndarray]
    solution: Solution
    options: RefineOptions

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({len(self.X)} targets, {len(self.Y)} sensors, noise {self.noise_source}, "
            f"cost {self.cost:.6g}, {len(self.free_directions)} free directions)"
        )

    def __reduce__(self) -> str:
        raise TypeError(
            "a Refined holds a GTSAM graph with Python factors, which can be neither pickled nor copied; "
            "rw.write_refined keeps everything but the graph"
        )
