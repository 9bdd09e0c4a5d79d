"""A pair's raw measurements with the noise of B and of A, and the carriers' motion about their stamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from rwhec_factors import se3
from rwhec_factors.batch import BatchResiduals, Linearization

from gtsam_rwhec.errors import CountError, NoiseError, OptionError
from gtsam_rwhec.fitting.fit_options import CarrierNoise, NoiseGroups, RefineOptions
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import SAME_POSE, LocalPaths, Trajectory
from gtsam_rwhec.problem.directions import SLIDES, slides_of
from gtsam_rwhec.problem.measurements import Pair, checked_covariances
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import VarianceFactors


@dataclass(frozen=True)
class PairData:
    """One pair's measurements; translations of B are in true metres where the scale is known."""

    pair: Pair
    #: The geodesic residuals.
    residuals: BatchResiduals
    #: (N, 6, 6): covariances of B's right perturbation, as given: sigma and kappa (1 / sqrt(2 kappa) rad an axis), or
    #: full ones.
    covariance: Array
    #: (N, 6, 6): covariances of A's right perturbation.
    carrier: Array | None
    #: (N,)
    stamps_ns: np.ndarray | None
    #: The carriers' motion about each stamp, where the sensor's clock has an offset.
    paths: LocalPaths | None = None
    #: (N, 6, 6): the part of the covariance that is of directions in which nothing is measured.
    slides: Array | None = None

    @property
    def measured(self) -> Array:
        """The covariance (N, 6, 6) of what is measured, without the slides'."""
        return self.covariance if self.slides is None else self.covariance - self.slides

    @property
    def told(self) -> Array:
        """(N,): how many entries of each residual are measured."""
        lost = 0 if self.slides is None else np.linalg.matrix_rank(self.slides, tol=0.5 * SLIDES, hermitian=True)
        told: Array = np.full(self.count, 6.0) - lost
        return told

    @property
    def count(self) -> int:
        """Number of measurements."""
        return len(self.covariance)

    @staticmethod
    def of(problem: Problem, pair: Pair, options: RefineOptions, paths: LocalPaths | None) -> PairData:
        """A pair of a problem; with ``paths`` the sensor's clock has an offset.

        Raises
        ------
        MeasurementsNotKeptError
            If the problem kept moments only.
        NoiseError, CountError
            If the carrier covariances lack this pair or have another count.
        """
        raw = problem.measurements(*pair)
        scale = problem.fixed_scales.get(pair.target, 1.0)
        unit = np.r_[1.0, 1.0, 1.0, np.full(3, 1.0 / scale)]
        B = raw.B.copy()
        B[:, :3, 3] /= scale
        return PairData(
            pair,
            BatchResiduals(raw.A, B, twists=None if paths is None else paths.twists()),
            raw.covariance_of_B() * unit[:, None] * unit,
            None if options.carrier_noise is None else carrier_covariances(options.carrier_noise, pair, raw.A),
            raw.stamps_ns,
            paths,
            slides_of(raw),
        )

    def at(self, offset_s: float, more_s: Array | float = 0.0) -> BatchResiduals:
        """Residuals linearised at a time offset: exact at this offset, with the twists of that instant.

        By ``more_s`` (N,) A is later beside that.
        """
        late_s = offset_s + more_s
        if self.paths is None or not np.any(late_s):
            return self.residuals
        twists = self.paths.twists(late_s)
        there = self.residuals.A @ self.paths.motion(late_s)
        return BatchResiduals(there @ se3.expmap(-offset_s * twists), self.residuals.B, twists=twists)

    def since_s(self, stamp_ns: int) -> Array:
        """The time (N,) since a stamp, at which the offset of a clock holds that has a rate."""
        assert self.stamps_ns is not None
        found: Array = (self.stamps_ns - stamp_ns) * 1e-9
        return found

    def selected(self, mask: np.ndarray) -> PairData:
        """The measurements that the mask marks, with their twists."""
        return PairData(
            self.pair,
            BatchResiduals(
                self.residuals.A[mask],
                self.residuals.B[mask],
                twists=None if self.residuals.twists is None else self.residuals.twists[mask],
            ),
            self.covariance[mask],
            None if self.carrier is None else self.carrier[mask],
            None if self.stamps_ns is None else self.stamps_ns[mask],
            None if self.paths is None else self.paths.selected(mask),
            None if self.slides is None else self.slides[mask],
        )


def local_paths(
    problem: Problem, sensors: tuple[str, ...], carrier_path: Trajectory | None = None
) -> dict[Pair, LocalPaths]:
    """The carriers' motion about the stamps of the sensors' pairs.

    The motion comes from the logged path if it is given, else from the measurements' own poses. Usually all sensors and
    targets have the same carriers, so every pair's poses are used together. If two pairs have different poses at one
    stamp (several robots), the poses of each pair are used alone.

    Raises
    ------
    CountError
        If measurements have no stamps, or their poses determine no motion at most of them.
    OptionError
        If a sensor has motions of its own, or the logged path is that of the inverse of A.
    """
    stamps_of: dict[Pair, np.ndarray] = {}
    for pair in [pair for pair in problem.pairs if pair.sensor in sensors]:
        if pair.is_motion:
            raise OptionError(
                f"{pair.sensor} has motions of its own (add_motion), for which time offsets are not modelled; leave "
                f"{pair.sensor} out of time_offsets"
            )
        own = problem.measurements(*pair).stamps_ns
        if own is None:
            raise CountError(f"{pair}: a time offset needs stamps for every measurement; add them with stamps_ns=")
        stamps_of[pair] = own
    if not stamps_of:
        return {}
    if carrier_path is not None:
        for pair, own in stamps_of.items():
            _check_side(carrier_path, problem.measurements(*pair).A, own, pair)
        return {pair: LocalPaths.along(carrier_path, own) for pair, own in stamps_of.items()}
    stamped = [problem.measurements(*pair) for pair in problem.pairs if not pair.is_motion]
    stamped = [raw for raw in stamped if raw.stamps_ns is not None]
    A = np.concatenate([raw.A for raw in stamped])
    stamps = np.concatenate([raw.stamps_ns for raw in stamped])
    order = np.argsort(stamps, kind="stable")
    same = np.diff(stamps[order]) == 0
    if (np.abs(np.diff(A[order], axis=0))[same] > SAME_POSE).any():
        return {pair: LocalPaths.of(problem.measurements(*pair).A, own, pair.label) for pair, own in stamps_of.items()}
    unique, first = np.unique(stamps, return_index=True)
    paths = LocalPaths.of(A[first], unique, "the carriers")
    return {pair: paths.selected(np.searchsorted(unique, own)) for pair, own in stamps_of.items()}


#: A path is that of the inverse of A where A's median distance from that is less than this share of its own.
INVERSE = 0.1


def _check_side(path: Trajectory, A: Array, stamps_ns: np.ndarray, pair: Pair) -> None:
    """Refuse a path of the inverse of A: velocities along it are others, and hide a clock's offset."""
    there = path.at(stamps_ns)[0]
    own, other = (float(np.median(np.abs(A - T).max(axis=(1, 2)))) for T in (there, se3.inverse(there)))
    if other < INVERSE * own:
        raise OptionError(
            f"carrier_path has the inverse of A of {pair} (median differences {other:.2g}, and {own:.2g} from A "
            "itself); give T_sensorcarrier_targetcarrier over time, the inverse of each of its poses"
        )


def carrier_covariances(noise: CarrierNoise, pair: Pair, A: Array) -> Array:
    """Covariances (N, 6, 6) of A's right perturbation; NoiseError or CountError if the pair has none or too few."""
    if noise.covariances is None:
        variances = np.r_[np.full(3, noise.rotation_rad**2), np.full(3, noise.translation_m**2)]
        given = np.broadcast_to(np.diag(variances), (len(A), 6, 6))
    else:
        if pair not in noise.covariances:
            there = ", ".join(str(Pair(*known)) for known in noise.covariances)
            raise NoiseError(f"CarrierNoise.covariances lacks {pair}; it has {there}")
        checked = checked_covariances(noise.covariances[pair], len(A), f"CarrierNoise of {pair}")
        if checked is None:
            raise CountError(f"CarrierNoise.covariances of {pair} is None; give {len(A)} of 6 x 6")
        given = checked
    if noise.about == "targetcarrier":
        return np.array(given)
    # Expmap(xi) A = A Expmap(Ad(A^-1) xi)
    adjoint = se3.adjoint(se3.inverse(A))
    turned: Array = adjoint @ given @ adjoint.transpose(0, 2, 1)
    return turned


def check_carriers(data: list[PairData], options: RefineOptions) -> None:
    """Refuse motions with carrier variables: the A of a motion is a relative pose, which is not one carrier pose."""
    motions = [item.pair for item in data if item.pair.is_motion]
    if motions and options.carrier_model == "variables":
        raise OptionError(
            f"carrier_model='variables' makes each A a variable pose, but {motions[0]} have a relative A; "
            "take carrier_model='propagated'"
        )


#: The two components of a measurement's noise.
PoseComponent = Literal["rotation", "translation"]
COMPONENTS: tuple[PoseComponent, PoseComponent] = ("rotation", "translation")
#: Pairs that share a variance factor: one pair, all pairs of the sensor with this name, or all pairs (None).
Group = Pair | str | None
#: The variance factors of each pair.
FactorsByPair = dict[Pair, VarianceFactors]


def largest_change(before: FactorsByPair, after: FactorsByPair) -> float:
    """The largest change of a factor's logarithm."""
    ratios = np.array([after[pair] for pair in before]) / np.array(list(before.values()))
    return float(np.abs(np.log(ratios)).max(initial=0.0))


def group_of(pair: Pair, groups: NoiseGroups) -> Group:
    """The group that a pair is in."""
    if groups == "all":
        return None
    return pair.sensor if groups == "sensor" else pair


def group_label(group: Group) -> str:
    """The group's name in messages."""
    return "the measurements" if group is None else str(group)


def measurement_covariance(data: PairData, factors: VarianceFactors) -> Array:
    """B's covariances (N, 6, 6): D Sigma D, with the square roots of the factors on D's diagonal; slides stay."""
    d = np.sqrt(np.repeat(factors, 3))
    scaled: Array = data.measured * d[:, None] * d
    return scaled if data.slides is None else scaled + data.slides


def residual_covariance(data: PairData, at: Linearization, factors: VarianceFactors) -> Array:
    """Covariances (N, 6, 6) of the geodesic residual: B's, and A's through de/dA, to first order."""
    covariance = measurement_covariance(data, factors)
    if data.carrier is not None:
        covariance = covariance + at.carrier @ data.carrier @ at.carrier.transpose(0, 2, 1)
    return covariance


def square_root_information(covariance: Array) -> Array:
    """W (N, 6, 6) with W' W = covariance^-1: the inverse of the lower Cholesky factor."""
    L = np.linalg.cholesky(covariance)
    root: Array = np.linalg.solve(L, np.broadcast_to(np.eye(L.shape[-1]), L.shape))
    return root
