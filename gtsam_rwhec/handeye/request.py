"""What every AX = XB method gets: the motions, checked and summed up, and the options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.cost import DualQuaternionCost
from gtsam_rwhec.handeye.motions import Motions
from gtsam_rwhec.handeye.prior import DualQuaternionPrior

ScaleMode = Literal["known", "unknown"]


@dataclass(frozen=True)
class Request:
    """A problem C_i X = X H_i and how to solve it.

    Attributes
    ----------
    motions : Motions
        C and H, checked.
    cost : DualQuaternionCost
        Eq. 8 with alpha, with weights or covariances, and with the prior (eqs. 26-29) if there is one.
    alpha : float
        Weight of translations relative to rotations, 1/m.
    weights : (N,) array or None
        Factor of each motion's terms.
    covariances : (N, 8, 8) or (1, 8, 8) array or None
        Of the residuals (A q, B q + A q').
    prior : DualQuaternionPrior or None
        A pose known beforehand.
    scale : "known" or "unknown"
        Whether t_C is in metres.
    rng : numpy.random.Generator, int or None
        For methods with a random start: ``numpy.random.default_rng(rng)``.
    """

    motions: Motions
    cost: DualQuaternionCost
    alpha: float
    weights: Array | None
    covariances: Array | None
    prior: DualQuaternionPrior | None
    scale: ScaleMode
    rng: np.random.Generator | int | None
