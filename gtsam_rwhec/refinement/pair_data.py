"""A pair's raw measurements with the noise of B and of A, ready for residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from rwhec_factors.batch import BatchResiduals

from gtsam_rwhec.accumulation import Pair
from gtsam_rwhec.errors import CountError, NoiseError, OptionError
from gtsam_rwhec.measurements import checked_covariances
from gtsam_rwhec.poses import Array
from gtsam_rwhec.problem import Problem
from gtsam_rwhec.refinement.options import CarrierNoise, RefineOptions
from gtsam_rwhec.twists import carrier_twists


@dataclass(frozen=True)
class PairData:
    """One pair's measurements, translations of B in true metres where their scale is known.

    Attributes
    ----------
    pair : (str, str)
    residuals : BatchResiduals
        Geodesic.
    covariance : (N, 6, 6) array
        Of B's right perturbation, as given: sigma and kappa (1 / sqrt(2 kappa) rad an axis), or full covariances.
    carrier : (N, 6, 6) array or None
        Of A's right perturbation.
    stamps_ns : (N,) array or None
    """

    pair: Pair
    residuals: BatchResiduals
    covariance: Array
    carrier: Array | None
    stamps_ns: np.ndarray | None

    @property
    def count(self) -> int:
        """Number of measurements."""
        return len(self.covariance)

    @staticmethod
    def of(problem: Problem, pair: Pair, options: RefineOptions, with_offset: bool) -> PairData:
        """From a problem.

        Raises
        ------
        MeasurementsNotKeptError
            When there are moments only.
        NoiseError, CountError
            For carrier covariances that lack this pair or have another count; time offsets without stamps.
        """
        raw = problem.measurements(*pair)
        scale = problem.fixed_scales.get(pair[0], 1.0)
        B = raw.B
        covariance = raw.covariance_of_B()
        if scale != 1.0:
            unit = np.r_[1.0, 1.0, 1.0, np.full(3, 1.0 / scale)]
            B = B.copy()
            B[:, :3, 3] /= scale
            covariance = covariance * unit[:, None] * unit
        twists = None
        if with_offset:
            if raw.stamps_ns is None:
                raise CountError(
                    f"{'-'.join(pair)}: a time offset needs stamps for every measurement; add them with stamps_ns="
                )
            twists = carrier_twists(raw.A, raw.stamps_ns, "-".join(pair))
        return PairData(
            pair,
            BatchResiduals(raw.A, B, twists=twists),
            covariance,
            None if options.carrier_noise is None else carrier_covariances(options.carrier_noise, pair, raw.A),
            raw.stamps_ns,
        )

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
        )


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
            raise NoiseError(
                f"CarrierNoise.covariances has none for {pair}; it has {', '.join(map(str, noise.covariances))}"
            )
        checked = checked_covariances(noise.covariances[pair], len(A), f"CarrierNoise of {'-'.join(pair)}")
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
    motions = [item.pair[1] for item in data if item.pair[0] == item.pair[1]]
    if motions and options.carrier_model == "variables":
        raise OptionError(
            f"carrier_model='variables' makes each A a pose, but the motions of {motions[0]} have a relative A; take "
            "carrier_model='propagated'"
        )
