"""What every AX = XB method takes and gives, and what it is known by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import gtsam
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


@dataclass(frozen=True)
class Answer:
    """What a method found.

    Attributes
    ----------
    X : (4, 4) array
        T_c_h, metres.
    cost : float or None
        Its own cost; None: the cost (8) of X, computed afresh by ``solve``.
    cost_name : str
        Which cost that is.
    lower_bound : float or None
        Proven, of the same cost.
    free_directions : tuple of str
        What the motions leave undetermined, in words.
    scale : float
        t_C = scale * (true length); 1 where it is known.
    """

    X: Array
    cost: float | None = None
    cost_name: str = "eq. 8"
    lower_bound: float | None = None
    free_directions: tuple[str, ...] = ()
    scale: float = 1.0


@dataclass(frozen=True)
class Method:
    """One way to solve AX = XB.

    Attributes
    ----------
    name : str
    assumes : str
        What must hold for its answer to be what it claims.
    source : str
        Paper and section.
    function : callable
    prior, linear_prior, weights, covariances, unknown_scale : bool
        What it can take besides motions and alpha; ``linear_prior`` is a prior of the form "distance".
    """

    name: str
    assumes: str
    source: str
    function: Callable[[Request], Answer]
    prior: bool = True
    linear_prior: bool = False
    weights: bool = True
    covariances: bool = True
    unknown_scale: bool = False


@dataclass(frozen=True)
class HandEye:
    """A hand-eye calibration.

    Attributes
    ----------
    X : gtsam.Pose3
        T_c_h: C_i X = X H_i; metres.
    cost : float
        Of X, computed from the motions' residuals: eq. 8 unless ``cost_name`` says otherwise.
    cost_name : str
    lower_bound : float or None
        No pose has a lower cost; None where the method proves nothing.
    gap : float or None
        cost - lower_bound.
    is_optimal : bool or None
        Whether the gap is closed to 1e-9 of the cost, or to what rounding leaves of a cost near zero.
    alpha : float
        1/m, given or estimated.
    method : str
    scale : float
        t_C = scale * (true length).
    seconds : float
    free_directions : tuple of str
        What the motions leave undetermined.
    """

    X: Any  # gtsam.Pose3
    cost: float
    cost_name: str
    lower_bound: float | None
    gap: float | None
    is_optimal: bool | None
    alpha: float
    method: str
    scale: float
    seconds: float
    free_directions: tuple[str, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.X, gtsam.Pose3):
            raise TypeError(f"X is a {type(self.X).__name__}, not a gtsam.Pose3")
