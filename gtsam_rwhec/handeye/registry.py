"""Every AX = XB method behind one call."""

from __future__ import annotations

import time
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import OptionError, PriorError
from gtsam_rwhec.geometry.poses import Array, PosesLike, QuaternionOrder, to_pose3
from gtsam_rwhec.handeye.alpha import estimate_alpha
from gtsam_rwhec.handeye.approximate import dq2ndord, dq2ndord_lambda, dq2steps, dqconvrlx
from gtsam_rwhec.handeye.certified import certified
from gtsam_rwhec.handeye.cost import moments_of
from gtsam_rwhec.handeye.daniilidis import daniilidis
from gtsam_rwhec.handeye.dual_quaternions import from_transforms
from gtsam_rwhec.handeye.iterative import dqitr
from gtsam_rwhec.handeye.local import chvecopt, dqnlopt, dqnlopt_random, quatvecopt
from gtsam_rwhec.handeye.method import Answer, HandEye, Method, Request, ScaleMode
from gtsam_rwhec.handeye.motion_costs import covariance_cost, squared_mahalanobis, squared_residuals
from gtsam_rwhec.handeye.motions import motions_of
from gtsam_rwhec.handeye.optimal import dqopt
from gtsam_rwhec.handeye.polynomial import dqoptpoly_resultant, dqoptpoly_sturm
from gtsam_rwhec.handeye.prior import DualQuaternionPrior
from gtsam_rwhec.handeye.weights import check_alpha, check_covariances, check_weights

_DQ = "Dekel et al., Optimal least-squares solution to the hand-eye calibration problem"
_NEAR = "DQOpt's answer in the basin of the best minimum"
METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            "dqopt", "nothing; its optimum is proven", f"{_DQ}, Section 3.2.1, Algorithm 1", dqopt, linear_prior=True
        ),
        Method("dq2steps", "axes that are not parallel", f"{_DQ}, Section 3.2.2, Algorithm 2", dq2steps, prior=False),
        Method("dqconvrlx", "little noise: q . q' = 0 nearly without asking", f"{_DQ}, Section 3.2.3", dqconvrlx),
        Method("dq2ndord", "mu small, as with little noise", f"{_DQ}, Section 3.2.4, Algorithm 4", dq2ndord),
        Method("dq2ndord_lambda", "lambda near the relaxation's", f"{_DQ}, Appendix A", dq2ndord_lambda),
        Method("dqitr", "a fixed point that attracts; some noise", f"{_DQ}, Section 3.2.5, Algorithm 5", dqitr),
        Method("dqoptpoly_resultant", "some noise: M is not singular", f"{_DQ}, Appendix B", dqoptpoly_resultant),
        Method("dqoptpoly_sturm", "some noise: M is not singular", f"{_DQ}, Appendix B", dqoptpoly_sturm),
        Method(
            "dan",
            "two axes that are not parallel, and little noise: it minimises nothing",
            "Daniilidis, Hand-eye calibration using dual quaternions (IJRR 1999)",
            daniilidis,
            prior=False,
            covariances=False,
        ),
        Method("dqnlopt", "nothing: it starts at DQOpt's answer", f"{_DQ}, Section 4.4", dqnlopt),
        Method("dqnloptrnd", "a random start in the best minimum's basin", f"{_DQ}, Section 4.4", dqnlopt_random),
        Method("chvecopt", _NEAR, f"{_DQ}, eq. 30, first", chvecopt, prior=False, covariances=False),
        Method("quatvecopt", _NEAR, f"{_DQ}, eq. 30, second", quatvecopt, prior=False, covariances=False),
        Method(
            "certified",
            "nothing; its bound says whether the optimum is proven",
            "this library's certified solver, on eq. 30's first cost",
            certified,
            prior=False,
            covariances=False,
            unknown_scale=True,
        ),
    )
}

#: A cost below this part of all squares is zero.
NOTHING = 1e-28
#: The cost's name with a prior.
_WITH_PRIOR = {"imaginary": "eq. 26", "distance": "eq. 25"}
#: A gap is closed at this part of the cost.
CLOSED = 1e-9
#: Rounding of a cost, as a part of the squares that cancel in it.
ROUNDING = 1e-12


def solve(
    C: PosesLike,
    H: PosesLike,
    method: str = "dqopt",
    *,
    alpha: float | Literal["estimate"] = 1.0,
    weights: ArrayLike | None = None,
    covariances: ArrayLike | None = None,
    prior: DualQuaternionPrior | None = None,
    order: QuaternionOrder | None = None,
    rng: np.random.Generator | int | None = None,
    scale: ScaleMode = "known",
) -> HandEye:
    """Solve C_i X = X H_i.

    Parameters
    ----------
    C, H : (N, 4, 4) arrays, sequences of N gtsam.Pose3, or (N, 7) arrays
        Relative poses T_before_after of the two rigidly joined frames, metres; C_i and H_i of the same move.
    method : str
        A name of ``METHODS``.
    alpha : float or "estimate"
        1/m: what a translation residual counts beside a rotation residual (eq. 8), about sigma_rotation /
        sigma_translation. "estimate" finds it from the residuals.
    weights : (N,) array, optional
        Factor of each motion's terms.
    covariances : (N, 8, 8) or (8, 8) array, optional
        Of the residuals (A q, B q + A q'), in place of alpha and weights.
    prior : DualQuaternionPrior, optional
    order : "wxyz" or "xyzw", optional
        For rows of 7 (quaternion, translation).
    rng : numpy.random.Generator or int, optional
        For methods that start at random.
    scale : "known" or "unknown"
        Whether t_C's unit is the metre.

    Returns
    -------
    HandEye

    Raises
    ------
    PoseError, CountError, UnderdeterminedError
        For motions that cannot be used.
    OptionError, NoiseError, PriorError
        For options, weights or priors that cannot be used, or not with this method.
    """
    start = time.perf_counter()
    if not isinstance(method, str) or method not in METHODS:
        raise OptionError(f"method={method!r} is not known; choose one of {', '.join(METHODS)}")
    chosen = METHODS[method]
    _check_options(chosen, weights, covariances, prior, scale)
    motions = motions_of(C, H, order)
    w, information = check_weights(weights, len(motions)), check_covariances(covariances, len(motions))
    if information is not None:
        if _estimated(alpha):
            raise OptionError("alpha='estimate' and covariances are both given; covariances take alpha's place")
        number = check_alpha(alpha)
        cost = covariance_cost(motions, information)
    else:
        moments = moments_of(motions.rows, w)
        number = estimate_alpha(motions, moments, w, prior) if _estimated(alpha) else check_alpha(alpha)
        cost = moments.cost(number)
    if prior is not None:
        cost = prior.added_to(cost)
    request = Request(motions, cost, number, w, information, prior, scale, rng)
    return result(request, chosen.function(request), method, start)


def result(request: Request, answer: Answer, method: str, start: float) -> HandEye:
    """A method's answer with its cost, computed afresh from the pose that is handed out, and its gap."""
    X = answer.X
    (q,), (q_dual,) = from_transforms(X[None])
    cost = cost_of_pose(request, q, q_dual) if answer.cost is None else answer.cost
    gap = is_optimal = None
    if answer.lower_bound is not None:
        gap = cost - answer.lower_bound
        squares = request.cost.S.diagonal() @ (q * q) + request.cost.M.diagonal() @ (q_dual * q_dual)
        is_optimal = bool(gap <= max(CLOSED * cost, ROUNDING * squares, NOTHING * float(np.trace(request.cost.S))))
    return HandEye(
        X=to_pose3(X[:3, :3], X[:3, 3]),
        cost=cost,
        cost_name=answer.cost_name if request.prior is None else _WITH_PRIOR[request.prior.form],
        lower_bound=answer.lower_bound,
        gap=gap,
        is_optimal=is_optimal,
        alpha=request.alpha,
        method=method,
        scale=answer.scale,
        seconds=time.perf_counter() - start,
        free_directions=answer.free_directions,
    )


def cost_of_pose(request: Request, q: Array, q_dual: Array) -> float:
    """The cost (8) of a pose, parts (4,), with the prior's: sums of squares of the motions' own residuals."""
    if request.covariances is not None:
        cost = squared_mahalanobis(request.motions, q, q_dual, request.covariances)
    else:
        rotation, translation = squared_residuals(request.motions, q, q_dual, request.weights)
        cost = rotation + request.alpha**2 * translation
    return cost if request.prior is None else cost + request.prior.value(q, q_dual)


def _estimated(alpha: object) -> bool:
    return isinstance(alpha, str) and alpha == "estimate"


def _check_options(
    method: Method,
    weights: ArrayLike | None,
    covariances: ArrayLike | None,
    prior: DualQuaternionPrior | None,
    scale: ScaleMode,
) -> None:
    if scale not in ("known", "unknown"):
        raise OptionError(f"scale={scale!r} is not 'known' or 'unknown'")
    if weights is not None and covariances is not None:
        raise OptionError("weights and covariances are both given; put the weights into the covariances")
    if prior is not None and not isinstance(prior, DualQuaternionPrior):
        raise PriorError(f"the prior is a {type(prior).__name__}; give a gtsam_rwhec.handeye.DualQuaternionPrior")
    for given, can, what in (
        (weights is not None, method.weights, "weights"),
        (covariances is not None, method.covariances, "covariances"),
        (prior is not None, method.prior, "a prior"),
        (
            prior is not None and prior.form == "distance",
            method.linear_prior,
            "a prior of the form 'distance' (eq. 25; 'imaginary', eq. 26, makes the cost one of eq. 8's kind)",
        ),
        (scale == "unknown", method.unknown_scale, "scale='unknown'"),
    ):
        if given and not can:
            raise OptionError(f"method={method.name!r} cannot take {what}; leave it out, or use another method")
