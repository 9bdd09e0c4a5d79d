"""What a stream says after each measurement: the answer, its proof and covariances, and what does not agree with it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, eigh

from gtsam_rwhec.calibration.point_uncertainty import Carriers, PointUncertainty, point_uncertainty
from gtsam_rwhec.capture.stream_answer import NoiseShown, PartAnswer
from gtsam_rwhec.errors import CountError, RwhecWarning, ScaleError, UnderdeterminedError
from gtsam_rwhec.fitting.fit_options import NoiseOptions, RefineOptions
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.noise_refinement import under_noise
from gtsam_rwhec.fitting.noise_rows import Instants
from gtsam_rwhec.fitting.pair_data import PairData
from gtsam_rwhec.fitting.refined import PairNoise, Refined, RefinedPoses
from gtsam_rwhec.fitting.refinement import refine
from gtsam_rwhec.fitting.unknowns import slots_of
from gtsam_rwhec.geometry.poses import PoseLike, to_pose3
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import VarianceFactors
from gtsam_rwhec.solver.answers import scales_of
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.free_directions import FreeDirection
from gtsam_rwhec.solver.solution import solve


@dataclass(frozen=True)
class Outlier:
    """A measurement that does not count, and what its verdict rests on.

    ``number`` and ``stamp_ns`` are the measurement's own; ``deviations`` is the root of e' V^-1 e of its residual e in
    the noise V that all show; ``judged_at`` is how many measurements had come when it was judged last.
    """

    number: int
    pair: Pair
    stamp_ns: int | None
    deviations: float
    judged_at: int


@dataclass(frozen=True, eq=False)
class StreamUpdate:
    """All that a stream knows after a measurement came or was taken back; ``str()`` is a sentence."""

    #: The measurement that came or went (None: nothing did), and whether it counts now
    number: int | None
    counts: bool
    measurements: int  #: How many came and were not removed
    counting: int  #: How many of them the answer rests on
    #: T_targetcarrier_target and T_sensorcarrier_sensor of the frames that have an answer, metres
    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float | dict[str, float]  #: As in ``Solution``; nan or missing where there is no answer as yet
    #: Of the poses above, by the moments of the measurements that count, weighted by ``noise_factors``: what
    #: ``rw.solve`` finds for them, bound and gap included. None where no frame has an answer.
    certificate: Certificate | None
    free_directions: tuple[FreeDirection, ...]
    #: By frames that have no answer as yet: why
    waiting: dict[tuple[str, ...], str]
    noise_factors: VarianceFactors  #: The weights' variances over the stated ones
    #: Verdicts that changed with this update: measurements that count no more, and that count again
    left_out: tuple[int, ...]
    taken_back: tuple[int, ...]
    #: Whether all verdicts agree with this answer; if not, the next updates go on with them
    is_settled: bool
    seconds: float
    _out: np.ndarray
    _pairs: tuple[Pair, ...]
    _has_stamps: bool
    _parts: tuple[PartAnswer, ...]
    _noise: NoiseShown | None
    _carriers: Carriers
    _scale_mode: ScaleMode
    #: Makes a problem of the measurements that are kept and count, where their noise is estimated; whether they are all
    _counting: Callable[[], Problem] | None
    _is_whole: bool

    @property
    def is_unique(self) -> bool:
        """Whether every frame that was seen has an answer, and the measurements determine it."""
        return bool(self._parts) and not self.waiting and all(p.solution.identifiability.is_unique for p in self._parts)

    @cached_property
    def outliers(self) -> tuple[Outlier, ...]:
        """The measurements that are kept and do not count, in the order of their arrival."""
        stamps = self._out["stamp_ns"].tolist() if self._has_stamps and len(self._out) else [None] * len(self._out)
        return tuple(
            Outlier(
                int(row["number"]), self._pairs[row["pair"]], stamp, float(np.sqrt(row["square"])), int(row["judged"])
            )
            for row, stamp in zip(self._out, stamps, strict=True)
        )

    @cached_property
    def refined(self) -> RefinedPoses | None:
        """The poses with their joint covariance, computed when asked for; None while the noise is not known.

        The covariance is that of the certified answer under the noise that its residuals show (or that was stated, with
        ``noise="given"``), one factor for all rotations and one for all translations. Where measurements share a pose
        of the carriers, they share its error: then these are the best poses under noise of A and of B, as ``calibrate``
        finds it. With ``keep="moments"`` variances are larger by the factor that measurements show which are kept.
        ``Stream.calibrate`` also asks for drift and for errors of the configuration.
        """
        if self._noise is None or not self._parts:
            return None
        larger = 1.0
        if self._counting is not None and self.is_unique:
            kept = self._counting()
            shared = under_shared_noise(kept)
            if shared is not None and self._is_whole:
                return shared
            larger = 1.0 if shared is None else larger_by(shared, kept)
        noise = np.array(self._noise.factors)
        f = noise / np.array(self.noise_factors)
        of_pairs: dict[Pair, PairNoise] = {}
        for part in (answer.part for answer in self._parts):
            m, over = part.moments, noise / np.array(self.noise_factors)
            rotation, translation = np.sqrt(0.5 * m.count / m.kappa * over[0]), np.sqrt(m.count / m.weight * over[1])
            for pair, r, t in zip(part.pairs, rotation.tolist(), translation.tolist(), strict=True):
                of_pairs[pair] = PairNoise(r, t, self._noise.degrees_of_freedom)
        joint = JointCovariance(
            slots_of(unknown for p in self._parts for unknown in p.unknowns),
            larger * block_diag(*(p.covariance(f) for p in self._parts)),
            block_diag(*(p.free for p in self._parts)),
            np.concatenate([p.unit for p in self._parts]),
        )
        cost = float(sum(p.solution.certificate.cost for p in self._parts))
        return RefinedPoses(
            X=self.X,
            Y=self.Y,
            scale=self.scale,
            scale_mode=self._scale_mode,
            time_offsets_s={},
            noise_source="given" if np.isinf(self._noise.degrees_of_freedom[0]) else "estimated",
            noise=of_pairs,
            cost=cost,
            initial_cost=cost,
            iterations=0,
            moved={},
            inlier_counts={},
            free_directions=self.free_directions,
            joint=joint,
        )

    def uncertainty_at(
        self,
        point: ArrayLike,
        frame: str,
        seen_from: str | None = None,
        level: float = 0.95,
        *,
        A: PoseLike | None = None,
    ) -> PointUncertainty:
        """How far off a point is, as ``Calibration.uncertainty_at`` says it, by the covariance of ``refined``.

        Raises UnderdeterminedError while the noise is not known, else as there.
        """
        refined = self.refined
        if refined is None:
            raise UnderdeterminedError(f"{self}: the noise is not known as yet; measure more, or state it")
        return point_uncertainty(
            refined, {}, {}, None, self._carriers, point, frame=frame, seen_from=seen_from, level=level, A=A
        )

    def __str__(self) -> str:
        said = f"{self.counting} of {self.measurements} measurements count"
        if self.certificate is None:
            return f"{said}; no answer as yet"
        free = f"; {len(self.free_directions)} directions are free" if self.free_directions else ""
        waiting = f"; no answer as yet for {', '.join(name for names in self.waiting for name in names)}"
        return f"{said}; {self.certificate.status}{free}{waiting if self.waiting else ''}"


def poses_of(
    parts: Sequence[PartAnswer], knowledge: Problem
) -> tuple[dict[str, gtsam.Pose3], dict[str, gtsam.Pose3], dict[str, float]]:
    """X, Y and the scales of all parts, about the user's origins."""
    X: dict[str, gtsam.Pose3] = {}
    Y: dict[str, gtsam.Pose3] = {}
    scales: dict[str, float] = {}
    for part, answer in ((p.part, p.solution.answer) for p in parts):
        of = {
            name: to_pose3(R, t + part.frame_shift(name))
            for name, R, t in zip(part.free, answer.R, answer.t, strict=True)
        }
        of |= {name: to_pose3(T[:3, :3], T[:3, 3]) for name, T in knowledge.fixed.items() if name in part.fixed}
        X |= {name: of[name] for name in part.targets}
        Y |= {name: of[name] for name in part.sensors}
        scales |= scales_of(part, answer)
    return X, Y, scales


#: Noise of A and of B, independent from pose to pose: what else there is takes a whole log, and `calibrate`.
HOW, KINDS = RefineOptions(noise="estimate"), NoiseOptions(drift="none", systematic=False)


def under_shared_noise(problem: Problem) -> Refined | None:
    """The answer under the noise of A and of B that the residuals show.

    None where no two measurements share a pose of the carriers, or there are too few or too many for such a model.
    """
    data = [PairData.of(problem, pair, HOW, None) for pair in problem.pairs]
    if Instants.of(data).count == problem.number_of_measurements:
        return None
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):  # an update says what it lacks
        try:
            return under_noise(problem, solve(problem), HOW, KINDS).refined()[0]
        except (CountError, UnderdeterminedError, ScaleError):
            return None


def larger_by(shared: Refined, problem: Problem) -> float:
    """By this factor variances are larger, in the worst direction of a frame, than if no error were shared."""
    alone = refine(problem, shared.solution, HOW)
    every = ((of.covariance(name) for of in (shared, alone)) for name in shared.names)
    return max(1.0, *(float(eigh(*pair, eigvals_only=True)[-1]) for pair in every))
