"""What the user states: targets, sensors, measurements, scale, known frames and priors; all validation of them."""

from __future__ import annotations

import copy
import warnings
from dataclasses import dataclass, field
from numbers import Real
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import (
    CountError,
    FrameError,
    MeasurementsNotKeptError,
    NoiseError,
    OptionError,
    PriorError,
    RotationsProjectedWarning,
    ScaleError,
)
from gtsam_rwhec.geometry.poses import (
    ROTATION_TOLERANCE,
    Array,
    PoseLike,
    PosesLike,
    QuaternionOrder,
    as_transforms,
    one_transform,
)
from gtsam_rwhec.problem.accumulation import Accumulator, Batch, Pair
from gtsam_rwhec.problem.measurements import (
    Measurements,
    checked_covariances,
    checked_stamps,
    positive_weights,
    warn_of_millimetres,
    weights_of,
)
from gtsam_rwhec.problem.moments import Gauge, Moments
from gtsam_rwhec.problem.priors import Prior, check_agreement, difference

ScaleMode = Literal["known", "shared", "per_target"]


@dataclass
class _Edge:
    """Raw measurements of one target by one sensor, or of one sensor's motions, as far as they are kept."""

    batches: list[Measurements] = field(default_factory=list)
    covariance_given: bool = False


class Problem:
    """A calibration problem: A_i X_j = Y_k B_i for targets j, sensors k and measurements i.

    A = T_sensorcarrier_targetcarrier (known: kinematics, motion capture, SLAM), B = T_sensor_target (measured),
    X = T_targetcarrier_target and Y = T_sensorcarrier_sensor (unknown). Translations in metres.

    Parameters
    ----------
    scale : "known", "shared" or "per_target"
        Whether lengths in B are true, or true times one unknown factor, or times one for each target
        (t_B = scale * true length). With "per_target", ``fix_scale`` names targets of known size.
    keep_measurements : bool
        Whether raw pairs are kept beside the moments. Refinement under richer noise needs them; the certified
        solution does not. Without them memory does not grow with the number of measurements.
    """

    def __init__(self, scale: ScaleMode = "known", *, keep_measurements: bool = True) -> None:
        if scale not in get_args(ScaleMode):
            raise OptionError(f"scale={scale!r} is not one of {', '.join(map(repr, get_args(ScaleMode)))}")
        self.scale: ScaleMode = scale
        self.keep_measurements = keep_measurements
        self.is_relative = False
        self.fixed: dict[str, Array] = {}
        self.priors: dict[str, list[Prior]] = {}
        self.fixed_scales: dict[str, float] = {}
        self._kind: dict[str, Literal["target", "sensor"]] = {}
        self._edges: dict[Pair, _Edge] = {}
        self._accumulator = Accumulator()

    # -- what is in it ------------------------------------------------------------------------------------------

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets, in order of first appearance."""
        return tuple(name for name, kind in self._kind.items() if kind == "target")

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors, in order of first appearance."""
        return tuple(name for name, kind in self._kind.items() if kind == "sensor")

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """(target, sensor) of every edge; (sensor, sensor) for a sensor's own motions."""
        return tuple(self._edges)

    @property
    def number_of_measurements(self) -> int:
        """Measurements of all pairs together."""
        return sum(moments.count for moments in self._accumulator.moments.values())

    @property
    def has_covariances(self) -> bool:
        """Whether any measurement came with a full covariance (used in refinement only)."""
        return any(edge.covariance_given for edge in self._edges.values())

    @property
    def has_measurements(self) -> bool:
        """Whether every raw measurement is still here."""
        kept = sum(len(batch.A) for edge in self._edges.values() for batch in edge.batches)
        return kept == self.number_of_measurements

    @property
    def gauge(self) -> Gauge:
        """The origins that moments are about."""
        return self._accumulator.gauge

    def moments(self, target: str, sensor: str) -> Moments:
        """Moments of a pair, about ``gauge``."""
        self._edge(target, sensor)
        return self._accumulator.moments[target, sensor]

    def measurements(self, target: str, sensor: str) -> Measurements:
        """Raw measurements of a pair, in the order in which they were added.

        Raises
        ------
        MeasurementsNotKeptError
            When the problem was made with ``keep_measurements=False``.
        """
        edge = self._edge(target, sensor)
        if sum(len(batch.A) for batch in edge.batches) != self.moments(target, sensor).count:
            raise MeasurementsNotKeptError(
                f"the raw measurements of {target}-{sensor} were not kept (keep_measurements=False); "
                "make the problem with keep_measurements=True"
            )
        batches = edge.batches
        stamps = [b.stamps_ns for b in batches if b.stamps_ns is not None]
        return Measurements(
            np.concatenate([b.A for b in batches]),
            np.concatenate([b.B for b in batches]),
            np.concatenate([b.sigma for b in batches]),
            np.concatenate([b.kappa for b in batches]),
            np.concatenate(stamps) if len(stamps) == len(batches) else None,
            np.concatenate([b.covariance_of_B() for b in batches]) if edge.covariance_given else None,
        )

    def _edge(self, target: str, sensor: str) -> _Edge:
        try:
            return self._edges[target, sensor]
        except KeyError:
            raise FrameError(f"no measurements of the pair ({target!r}, {sensor!r}); there are {self.pairs}") from None

    # -- measurements -------------------------------------------------------------------------------------------

    def add(
        self,
        target: str,
        sensor: str,
        A: PosesLike,
        B: PosesLike,
        sigma: ArrayLike | None = None,
        kappa: ArrayLike | None = None,
        *,
        order: QuaternionOrder | None = None,
        stamps_ns: ArrayLike | None = None,
        covariances: ArrayLike | None = None,
        source: str | None = None,
    ) -> None:
        """Add measurements of a target by a sensor; any number of batches, in any order.

        Parameters
        ----------
        target, sensor : str
            Names, unique across targets and sensors.
        A, B : (N, 4, 4) arrays, lists of gtsam.Pose3, or (N, 7) rows of quaternion and translation
            A = T_sensorcarrier_targetcarrier, B = T_sensor_target; metres.
        sigma : float or (N,), optional
            Standard deviation of B's translation, each axis, in metres. Left out: 1, and costs are relative.
        kappa : float or (N,), optional
            Concentration of B's rotation; a standard deviation of s rad an axis is kappa = 1 / (2 s^2).
        order : "wxyz" or "xyzw"
            Order of the quaternions, for rows of 7.
        stamps_ns : (N,) integers, optional
            Nanoseconds; kept for refinement.
        covariances : (N, 6, 6), optional
            Of B, rotation first, right perturbation (GTSAM's order), in place of sigma and kappa: refinement takes them
            whole, the certified solution the mean variance of each block.
        source : str, optional
            Where they came from (a file, a topic), said in errors.

        Raises
        ------
        PoseError, CountError, NoiseError, FrameError
            For bad input; nothing of the batch is added then.
        """
        if target == sensor:
            raise FrameError(f"{target!r} is given as target and as sensor; names are unique across both")
        self._add((target, sensor), A, B, sigma, kappa, order, stamps_ns, covariances, source)

    def add_motion(
        self,
        sensor: str,
        A: PosesLike,
        B: PosesLike,
        sigma: ArrayLike | None = None,
        kappa: ArrayLike | None = None,
        *,
        order: QuaternionOrder | None = None,
        stamps_ns: ArrayLike | None = None,
        covariances: ArrayLike | None = None,
        source: str | None = None,
    ) -> None:
        """Add motions seen by a sensor's own odometry: A Y = Y B (AX = XB), A the carrier's, B the sensor's.

        Both are T_before_after. Arguments and errors as in ``add``.
        """
        self._add((sensor, sensor), A, B, sigma, kappa, order, stamps_ns, covariances, source)

    def _add(
        self,
        pair: Pair,
        A_poses: PosesLike,
        B_poses: PosesLike,
        sigma: ArrayLike | None,
        kappa: ArrayLike | None,
        order: QuaternionOrder | None,
        stamps_ns: ArrayLike | None,
        covariances: ArrayLike | None,
        source: str | None,
    ) -> None:
        target, sensor = pair
        motion = target == sensor
        where = (f"the motions of {sensor}" if motion else f"{target}-{sensor}") + (f" ({source})" if source else "")
        self._check_names(pair, where)
        A = as_transforms(A_poses, order, f"A of {where}")
        B = as_transforms(B_poses, order, f"B of {where}")
        if len(A) != len(B):
            raise CountError(f"{where}: {len(A)} poses in A and {len(B)} in B; they come in pairs")
        if len(A) == 0:
            raise CountError(f"{where}: no measurements; leave the pair out instead")
        count = len(A)
        stamps = checked_stamps(stamps_ns, count, where)
        covariance = checked_covariances(covariances, count, where)
        if covariance is not None:
            if sigma is not None or kappa is not None:
                raise NoiseError(
                    f"{where}: covariances and {'sigma' if sigma is not None else 'kappa'} are given, which may "
                    "contradict one another; give the one or the other (of covariances, the certified solution takes "
                    "the mean variance of each block)"
                )
            sigma, kappa = weights_of(covariance)
        sigmas = positive_weights(sigma, count, "sigma", where)
        kappas = positive_weights(kappa, count, "kappa", where)
        accumulator, projected = self._accumulator.added(Batch(pair, A, B, 1.0 / sigmas**2, kappas, where))
        if projected:
            warnings.warn(
                f"{where}: {projected} rotations were off R'R = I by rounding in the input (less than "
                f"{ROTATION_TOLERANCE:g}) and were projected to the nearest rotation",
                RotationsProjectedWarning,
                stacklevel=3,
            )
        warn_of_millimetres(A, B, accumulator.gauge, motion, where)
        # Only now, with everything checked and warned of (warnings may be errors), does the problem change.
        self._accumulator = accumulator
        self.is_relative = self.is_relative or sigma is None or kappa is None
        if not motion:
            self._kind[target] = "target"
        self._kind[sensor] = "sensor"
        edge = self._edges.setdefault(pair, _Edge())
        edge.covariance_given = edge.covariance_given or covariance is not None
        if self.keep_measurements:
            edge.batches.append(
                Measurements(
                    A.copy(),
                    B.copy(),
                    np.broadcast_to(sigmas, (count,)),
                    np.broadcast_to(kappas, (count,)),
                    stamps,
                    covariance,
                )
            )

    def _check_names(self, pair: Pair, where: str) -> None:
        target, sensor = pair
        for name, kind in ((target, "target"), (sensor, "sensor")):
            if not isinstance(name, str) or not name:
                raise FrameError(f"{where}: the {kind}'s name is {name!r}; give a string that is not empty")
            if target != sensor and self._kind.get(name, kind) != kind:
                raise FrameError(
                    f"{where}: {name!r} is a {self._kind[name]} already and cannot be a {kind} too; "
                    "names are unique across targets and sensors"
                )
        if target == sensor and self._kind.get(sensor) == "target":
            raise FrameError(f"{where}: {sensor!r} is a target; only sensors have motions of their own")

    # -- what is known beforehand -------------------------------------------------------------------------------

    def fix(self, name: str, T_carrier_frame: PoseLike) -> None:
        """Say that a frame's pose on its carrier is known exactly.

        Raises
        ------
        PriorError
            When it is fixed at another pose already, or a prior contradicts it.
        """
        T = one_transform(T_carrier_frame, f"the pose at which {name} is fixed")
        known = self.fixed.get(name)
        if known is not None and np.abs(known - T).max() > 1e-9:
            raise PriorError(
                f"{name} is fixed already, at another pose ({difference(known, T)}); remove one of the two"
            )
        for prior in self.priors.get(name, []):
            check_agreement(name, Prior(T, 0.0, np.inf), prior)
        self.fixed[name] = T

    def add_prior(
        self, name: str, T_carrier_frame: PoseLike, sigma: float | None = None, kappa: float | None = None
    ) -> None:
        """Add a belief about a frame's pose on its carrier: a MAP estimate in place of a maximum-likelihood one.

        Parameters
        ----------
        name : str
        T_carrier_frame : pose
        sigma : float, optional
            Standard deviation of the translation, each axis, in metres; None leaves the translation free.
        kappa : float, optional
            Concentration of the rotation, 1 / (2 s^2) for s rad an axis; None leaves the rotation free.

        Raises
        ------
        PriorError
            When it contradicts what is known of the frame already, or says nothing.
        """
        T = one_transform(T_carrier_frame, f"the prior of {name}")
        if sigma is None and kappa is None:
            raise PriorError(f"the prior of {name} has neither sigma nor kappa and says nothing; give one of them")
        where = f"the prior of {name}"
        prior = Prior(
            T,
            None if sigma is None else float(positive_weights(sigma, 0, "sigma", where)),
            None if kappa is None else float(positive_weights(kappa, 0, "kappa", where)),
        )
        if name in self.fixed:
            check_agreement(name, Prior(self.fixed[name], 0.0, np.inf), prior)
        for other in self.priors.get(name, []):
            check_agreement(name, other, prior)
        self.priors.setdefault(name, []).append(prior)

    def fix_scale(self, name: str, scale: float = 1.0) -> None:
        """Say that a target's size (or, for motions, a sensor's odometry scale) is known, with scale="per_target".

        Raises
        ------
        ScaleError
            When the scale is not positive, or the problem's scale is not "per_target".
        """
        if self.scale != "per_target":
            raise ScaleError(f"fix_scale({name!r}) needs scale='per_target'; this problem has scale={self.scale!r}")
        if not (isinstance(scale, Real) and np.isfinite(scale) and scale > 0):
            raise ScaleError(f"the scale of {name} is {scale!r}; give a positive number (measured / true length)")
        if self.fixed_scales.get(name, scale) != scale:
            raise ScaleError(f"the scale of {name} is fixed at {self.fixed_scales[name]} already, and now at {scale}")
        self.fixed_scales[name] = float(scale)

    # -- joining ------------------------------------------------------------------------------------------------

    def __add__(self, other: Problem) -> Problem:
        """Both problems' measurements and knowledge in one: logs can be processed apart and joined."""
        if not isinstance(other, Problem):
            return NotImplemented
        if self.scale != other.scale:
            raise OptionError(f"a problem with scale={self.scale!r} cannot join one with scale={other.scale!r}")
        merged = copy.copy(self)
        merged.keep_measurements = self.keep_measurements and other.keep_measurements
        merged.is_relative = self.is_relative or other.is_relative
        merged.fixed, merged.fixed_scales = dict(self.fixed), dict(self.fixed_scales)
        merged.priors = {name: list(priors) for name, priors in self.priors.items()}
        merged._kind = dict(self._kind)
        merged._edges = {pair: _Edge(list(edge.batches), edge.covariance_given) for pair, edge in self._edges.items()}
        for name, kind in other._kind.items():
            if merged._kind.setdefault(name, kind) != kind:
                raise FrameError(
                    f"{name!r} is a {kind} in one problem and a {merged._kind[name]} in the other; rename one of them"
                )
        merged._accumulator = self._accumulator.merged(other._accumulator)
        for pair, edge in other._edges.items():
            known = merged._edges.setdefault(pair, _Edge())
            known.batches.extend(edge.batches)
            known.covariance_given = known.covariance_given or edge.covariance_given
        for name, T in other.fixed.items():
            merged.fix(name, T)
        for name, priors in other.priors.items():
            for prior in priors:
                merged.add_prior(name, prior.transform, prior.sigma, prior.kappa)
        for name, scale in other.fixed_scales.items():
            merged.fix_scale(name, scale)
        return merged

    def __radd__(self, other: object) -> Problem:
        """0 + problem, so that ``sum(problems)`` joins them."""
        return self if other == 0 else NotImplemented

    def __repr__(self) -> str:
        return (
            f"Problem({len(self.targets)} targets, {len(self.sensors)} sensors, {len(self._edges)} pairs, "
            f"{self.number_of_measurements} measurements, scale={self.scale!r})"
        )
