"""Carriers that are exchanged, as a rig file may have them: A is then the inverse of what it says.

It is the most common mistake in a rig file, and few stations hide it: their residuals are small beside what B varies by
though another reading fits far better. So the two readings of A alone are compared here, by their likelihoods under the
noise that each leaves. Of 40 draws of n stations from two real cells, an exchange was named in 16 for n = 4, 34 for
n = 5, 39 for n = 6 and all for n = 8, 10 and 14; where there was none it was never named (280 draws).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.calibration.misreadings import Misreading, are_too_few_to_tell, is_plain, shares_of
from gtsam_rwhec.calibration.moved_frames import explains_more
from gtsam_rwhec.calibration.readings import A_INVERTED
from gtsam_rwhec.calibration.samples import Sampled
from gtsam_rwhec.calibration.trial_fits import fitted, signal_of
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.problem.problem import Problem

#: Logarithm of the ratio of likelihoods from which on the exchange is named.
SURELY = 15.0
#: And its mean over blocks of neighbouring measurements must be above this many of its standard deviations.
SIGMAS = 1.0
#: A residual of the exchange must be below this share of what B varies by; else something else is wrong.
EXPLAINED = 0.15
#: Below this the measurements do not tell the two apart.
ALIKE = 3.0


@dataclass(frozen=True)
class Exchange:
    """What the measurements say of exchanged carriers.

    Attributes
    ----------
    misreading : Misreading or None
        The exchange, where it fits far better, and where a frame that moved once does not fit far better still.
    is_open : bool
        Whether measurements that are too few for any other test do not tell the two apart, or leave residuals that are
        not small.
    """

    misreading: Misreading | None = None
    is_open: bool = False


@one_blas_thread()
def exchange_of(problem: Problem) -> Exchange:
    """Compare A as it was read with its inverse; nothing is said where either has no fit."""
    sampled = Sampled.of(problem)
    if sampled is None:
        return Exchange()
    given, inverse = fitted(problem, sampled.as_read()), fitted(problem, sampled.by(A_INVERTED))
    if given is None or inverse is None:
        return Exchange()
    gains = inverse.log_likelihoods - given.log_likelihoods
    sums = np.bincount(sampled.blocks(), gains)[np.unique(sampled.blocks())]
    gain, spread = float(gains.sum()), float(sums.std(ddof=1)) * math.sqrt(len(sums)) if len(sums) > 1 else math.inf
    signal = signal_of(sampled.as_read())
    is_explained = max(shares_of(inverse.residual, signal)) < EXPLAINED
    is_named = gain > SURELY and gain > SIGMAS * spread and is_explained
    if is_named and not explains_more(problem, sampled.as_read(), inverse.residual):
        before, after = given.residual, inverse.residual
        return Exchange(
            Misreading(
                A_INVERTED.mistake,
                A_INVERTED.likely,
                A_INVERTED.cure,
                (math.degrees(before.rotation_rad), math.degrees(after.rotation_rad)),
                (1e3 * before.translation_m, 1e3 * after.translation_m),
            )
        )
    is_small = is_plain(given.residual, signal)
    return Exchange(is_open=are_too_few_to_tell(problem) and (gain > -ALIKE or not is_small))
