"""What every AX = XB method is asked, checked and summed up."""

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
    """What is to be solved.

    Attributes
    ----------
    motions : Motions
    cost : DualQuaternionCost
        Eq. 8 with alpha, weights or covariances, and the prior (eqs. 26-29) if there is one.
    alpha : float
        1/m.
    weights : (N,) array or None
    covariances : (N, 8, 8) or (1, 8, 8) array or None
    prior : DualQuaternionPrior or None
    scale : "known" or "unknown"
    rng : numpy.random.Generator, int or None
        For methods that start at random: ``numpy.random.default_rng(rng)``.
    """

    motions: Motions
    cost: DualQuaternionCost
    alpha: float
    weights: Array | None
    covariances: Array | None
    prior: DualQuaternionPrior | None
    scale: ScaleMode
    rng: np.random.Generator | int | None

    @property
    def noise_free_part(self) -> float:
        """What of M is a prior's, and so no sign of noise."""
        return 0.0 if self.prior is None else self.prior.b
