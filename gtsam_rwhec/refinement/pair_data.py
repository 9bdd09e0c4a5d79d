"""A pair's raw measurements with the noise of B and of A, ready for residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from rwhec_factors.batch import BatchResiduals

from gtsam_rwhec.errors import CountError, NoiseError, OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import checked_covariances
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.options import CarrierNoise, RefineOptions
from gtsam_rwhec.trajectories.local_paths import SAME_POSE, LocalPaths
from gtsam_rwhec.trajectories.trajectory import Trajectory


@dataclass(frozen=True)
class PairData:
    """One pair's measurements, translations of B in true metres where their scale is known.

    Attributes
    ----------
    pair : Pair
    residuals : BatchResiduals
        Geodesic.
    covariance : (N, 6, 6) array
        Of B's right perturbation, as given: sigma and kappa (1 / sqrt(2 kappa) rad an axis), or full covariances.
    carrier : (N, 6, 6) array or None
        Of A's right perturbation.
    stamps_ns : (N,) array or None
    paths : LocalPaths or None
        The carriers' motion about each stamp, where the sensor's clock has an offset.
    """

    pair: Pair
    residuals: BatchResiduals
    covariance: Array
    carrier: Array | None
    stamps_ns: np.ndarray | None
    paths: LocalPaths | None = None

    @property
    def count(self) -> int:
        """Number of measurements."""
        return len(self.covariance)

    @staticmethod
    def of(problem: Problem, pair: Pair, options: RefineOptions, paths: LocalPaths | None) -> PairData:
        """From a problem; with a time offset where there are ``paths``.

        Raises
        ------
        MeasurementsNotKeptError
            When there are moments only.
        NoiseError, CountError
            For carrier covariances that lack this pair or have another count.
        """
        raw = problem.measurements(*pair)
        scale = problem.fixed_scales.get(pair.target, 1.0)
        B = raw.B
        covariance = raw.covariance_of_B()
        if scale != 1.0:
            unit = np.r_[1.0, 1.0, 1.0, np.full(3, 1.0 / scale)]
            B = B.copy()
            B[:, :3, 3] /= scale
            covariance = covariance * unit[:, None] * unit
        return PairData(
            pair,
            BatchResiduals(raw.A, B, twists=None if paths is None else paths.twists()),
            covariance,
            None if options.carrier_noise is None else carrier_covariances(options.carrier_noise, pair, raw.A),
            raw.stamps_ns,
            paths,
        )

    def at(self, offset_s: float) -> BatchResiduals:
        """Residuals whose time offset is linearised where it stands: exact there, along the twist of that instant."""
        if self.paths is None or offset_s == 0.0:
            return self.residuals
        twists = self.paths.twists(offset_s)
        there = self.residuals.A @ self.paths.motion(offset_s)
        return BatchResiduals(there @ se3.expmap(-offset_s * twists), self.residuals.B, twists=twists)

    def selected(self, mask: np.ndarray) -> PairData:
        """Of the measurements marked; what is known of A all along (its twists) stays known."""
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
        )


def local_paths(
    problem: Problem, sensors: tuple[str, ...], carrier_path: Trajectory | None = None
) -> dict[Pair, LocalPaths]:
    """The carriers' motion about the stamps of the sensors' pairs.

    From the path as it was logged where it is given; else from the measurements' own poses. The carriers are the same
    for all sensors and targets, as a rule, so that every pair's poses tell it; where two pairs have different poses at
    one stamp (several robots), each pair's own do.

    Raises
    ------
    CountError
        For measurements without stamps, or poses that do not tell a motion.
    OptionError
        For a sensor with motions of its own.
    """
    pairs = [pair for pair in problem.pairs if pair.sensor in sensors]
    for pair in pairs:
        if pair.is_motion:
            raise OptionError(
                f"a time offset would move both ends of {pair} (add_motion), which is not modelled; leave "
                f"{pair.sensor} out of time_offsets"
            )
        if problem.measurements(*pair).stamps_ns is None:
            raise CountError(f"{pair}: a time offset needs stamps for every measurement; add them with stamps_ns=")
    if not pairs:
        return {}
    if carrier_path is not None:
        stamps_of = {pair: problem.measurements(*pair).stamps_ns for pair in pairs}
        return {
            pair: LocalPaths.along(carrier_path, stamps) for pair, stamps in stamps_of.items() if stamps is not None
        }
    telling = [problem.measurements(*pair) for pair in problem.pairs if not pair.is_motion]
    telling = [raw for raw in telling if raw.stamps_ns is not None]
    A = np.concatenate([raw.A for raw in telling])
    stamps = np.concatenate([raw.stamps_ns for raw in telling])
    order = np.argsort(stamps, kind="stable")
    same = np.diff(stamps[order]) == 0
    if (np.abs(np.diff(A[order], axis=0))[same] > SAME_POSE).any():
        return {pair: _paths_of_pair(problem, pair) for pair in pairs}
    # Of all stamps once, then each pair's own among them.
    unique, first = np.unique(stamps, return_index=True)
    paths = LocalPaths.of(A[first], unique, "the carriers")
    of_pairs = {pair: problem.measurements(*pair).stamps_ns for pair in pairs}
    return {pair: paths.selected(np.searchsorted(unique, s)) for pair, s in of_pairs.items() if s is not None}


def _paths_of_pair(problem: Problem, pair: Pair) -> LocalPaths:
    raw = problem.measurements(*pair)
    assert raw.stamps_ns is not None
    return LocalPaths.of(raw.A, raw.stamps_ns, pair.label)


def carrier_covariances(noise: CarrierNoise, pair: Pair, A: Array) -> Array:
    """Of A's right perturbation, (N, 6, 6), whichever way they were given.

    Raises
    ------
    NoiseError, CountError
        Where the pair has none, or another number of them.
    """
    if noise.covariances is None:
        variances = np.r_[np.full(3, noise.rotation_rad**2), np.full(3, noise.translation_m**2)]
        given = np.broadcast_to(np.diag(variances), (len(A), 6, 6))
    else:
        if pair not in noise.covariances:
            there = ", ".join(str(Pair(*known)) for known in noise.covariances)
            raise NoiseError(f"CarrierNoise.covariances has none for {pair}; it has {there}")
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
    """Motions' A's are differences of poses, whose noise is not that of one pose: refused as variables.

    Raises
    ------
    OptionError
        For carrier variables with motions.
    """
    motions = [item.pair for item in data if item.pair.is_motion]
    if motions and options.carrier_model == "variables":
        raise OptionError(
            f"carrier_model='variables' makes each A a pose, but {motions[0]} have a relative A; take "
            "carrier_model='propagated'"
        )
