"""All AX = XB methods, and the one call that runs each of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal, get_args

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import OptionError, PriorError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array, PosesLike, QuaternionOrder, to_pose3
from gtsam_rwhec.geometry.real_numbers import is_one_of
from gtsam_rwhec.methods.certified import certified_motions
from gtsam_rwhec.methods.dq_approximations import (
    dq2ndord,
    dq2ndord_lambda,
    dq2steps,
    dqconvrlx,
    dqitr,
    dqoptpoly_resultant,
    dqoptpoly_sturm,
)
from gtsam_rwhec.methods.dq_descent import chvecopt, daniilidis, dqnlopt, dqnlopt_random, quatvecopt
from gtsam_rwhec.methods.dqopt import dqopt, estimate_alpha
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms
from gtsam_rwhec.methods.hand_eye_request import DualQuaternionPrior, Request, ScaleMode
from gtsam_rwhec.methods.method import Estimate, Method, Outcome, Proof, Properties, Takes
from gtsam_rwhec.methods.motions import (
    check_alpha,
    check_covariances,
    check_weights,
    cost_of,
    motions_of,
    squared_mahalanobis,
    squared_residuals,
)

_DQ = "Dekel et al., Optimal least-squares solution to the hand-eye calibration problem"
_NEAR = "DQOpt's answer in the basin of the best minimum"
_WEIGHED = frozenset({Takes.WEIGHTS})
_QUADRATIC = frozenset({Takes.WEIGHTS, Takes.COVARIANCES})
_WITH_PRIOR = _QUADRATIC | {Takes.PRIORS}


def _of_dq_paper(
    name: str,
    function: Callable[[Request], Outcome[Array]],
    section: str,
    assumes: str,
    takes: frozenset[Takes] = _WITH_PRIOR,
    *,
    joint: bool = True,
    certifiable: bool = False,
) -> Method[[Request]]:
    properties = Properties("dual quaternions", joint=joint, certifiable=certifiable)
    return Method(name, function, properties, f"{_DQ}, {section}", assumes, takes)


HAND_EYE_METHODS: dict[str, Method[[Request]]] = {
    method.name: method
    for method in (
        _of_dq_paper(
            "dqopt",
            dqopt,
            "Section 3.2.1, Algorithm 1",
            "nothing; its optimum is proven",
            _WITH_PRIOR | {Takes.LINEAR_PRIORS},
            certifiable=True,
        ),
        _of_dq_paper(
            "dq2steps", dq2steps, "Section 3.2.2, Algorithm 2", "axes that are not parallel", _QUADRATIC, joint=False
        ),
        _of_dq_paper("dqconvrlx", dqconvrlx, "Section 3.2.3", "little noise: then q . q' is nearly 0"),
        _of_dq_paper("dq2ndord", dq2ndord, "Section 3.2.4, Algorithm 4", "little noise: mu is small"),
        _of_dq_paper("dq2ndord_lambda", dq2ndord_lambda, "Appendix A", "lambda near that of the relaxation"),
        _of_dq_paper("dqitr", dqitr, "Section 3.2.5, Algorithm 5", "some noise; an iteration that converges"),
        _of_dq_paper("dqoptpoly_resultant", dqoptpoly_resultant, "Appendix B", "some noise: M is not singular"),
        _of_dq_paper("dqoptpoly_sturm", dqoptpoly_sturm, "Appendix B", "some noise: M is not singular"),
        Method(
            "dan",
            daniilidis,
            Properties("dual quaternions"),
            "Daniilidis, Hand-eye calibration using dual quaternions (IJRR 1999)",
            "two axes that are not parallel, and little noise: it minimises nothing",
            _WEIGHED,
        ),
        _of_dq_paper("dqnlopt", dqnlopt, "Section 4.4", "nothing: it starts at DQOpt's answer"),
        _of_dq_paper("dqnloptrnd", dqnlopt_random, "Section 4.4", "a random start in the best minimum's basin"),
        _of_dq_paper("chvecopt", chvecopt, "eq. 30, first", _NEAR, _WEIGHED),
        _of_dq_paper("quatvecopt", quatvecopt, "eq. 30, second", _NEAR, _WEIGHED),
        Method(
            "certified",
            certified_motions,
            Properties("SE(3)", certifiable=True, monocular=True),
            "this library's certified solver, on eq. 30's first cost",
            "nothing; its bound says whether the optimum is proven",
            _WEIGHED | {Takes.SHARED_SCALE},
        ),
    )
}

#: The cost with a prior has this name, by the prior's form.
_COST_WITH_PRIOR = {"imaginary": "eq. 26", "distance": "eq. 25"}
#: A gap counts as zero when it is below this share of the cost,
CLOSED = 1e-9
#: or below this share of the squares that cancel in the cost, which is rounding error,
ROUNDING = 1e-12
#: or below this share of all squares: the cost is then zero.
NOTHING = 1e-28


@one_blas_thread()
def solve_hand_eye(
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
) -> Estimate[gtsam.Pose3]:
    """Solve C_i X = X H_i.

    Parameters
    ----------
    C, H : (N, 4, 4) arrays, sequences of N gtsam.Pose3, or (N, 7) arrays
        Relative poses T_before_after of the two rigidly joined frames, metres; C_i and H_i belong to the same move.
    method : str
        A name of ``HAND_EYE_METHODS``.
    alpha : float or "estimate"
        Weight of a translation residual relative to a rotation residual (eq. 8), 1/m. It is about sigma_rotation /
        sigma_translation. "estimate" finds it from the residuals.
    weights : (N,) array, optional
        Factor of each motion's terms.
    covariances : (N, 8, 8) or (8, 8) array, optional
        Of the residuals (A q, B q + A q'), in place of alpha and weights.
    prior : DualQuaternionPrior, optional
        A pose X known beforehand.
    order : "wxyz" or "xyzw", optional
        For rows of 7 (quaternion, translation).
    rng : numpy.random.Generator or int, optional
        For methods with a random start.
    scale : "known" or "unknown"
        Whether t_C is in metres.

    Returns
    -------
    Estimate
        The one pose X = T_c_h, its cost and proof, and alpha.

    Raises
    ------
    PoseError, CountError, UnderdeterminedError
        For motions that cannot be used.
    OptionError, NoiseError, PriorError
        For options, weights or priors that cannot be used at all, or not with this method.
    """
    start = time.perf_counter()
    if not isinstance(method, str) or method not in HAND_EYE_METHODS:
        raise OptionError(f"method={brief(method)} is not known; choose one of {', '.join(HAND_EYE_METHODS)}")
    chosen = HAND_EYE_METHODS[method]
    _check_options(chosen, weights, covariances, prior, scale)
    motions = motions_of(C, H, order)
    w, information = check_weights(weights, len(motions)), check_covariances(covariances, len(motions))
    if not (isinstance(alpha, str) and alpha == "estimate"):
        number = check_alpha(alpha)
    elif information is None:
        number = estimate_alpha(motions, w, prior)
    else:
        raise OptionError("alpha='estimate' and covariances are both given; covariances take alpha's place")
    cost = cost_of(motions, number, w, information)
    if prior is not None:
        cost = prior.added_to(cost)
    request = Request(motions, cost, number, w, information, prior, scale, rng)
    return evaluated(request, chosen.function(request), method, start)


def evaluated(request: Request, found: Outcome[Array], method: str, start: float) -> Estimate[gtsam.Pose3]:
    """The estimate of a method's outcome: with its cost, computed anew from the pose itself, and its proof."""
    (q,), (q_dual,) = from_transforms(found.X[None])
    cost = cost_of_pose(request, q, q_dual) if found.cost is None else found.cost
    name = (found.cost_name or "eq. 8") if request.prior is None else _COST_WITH_PRIOR[request.prior.form]
    proof = None
    if found.lower_bound is not None:
        squares = request.cost.S.diagonal() @ (q * q) + request.cost.M.diagonal() @ (q_dual * q_dual)
        closed = max(CLOSED * cost, ROUNDING * squares, NOTHING * float(np.trace(request.cost.S)))
        proof = Proof(cost, name, found.lower_bound, bool(cost - found.lower_bound <= closed))
    return Estimate(
        method=method,
        X=to_pose3(found.X[:3, :3], found.X[:3, 3]),
        Y={},
        scale=found.scale if isinstance(found.scale, float) else dict(found.scale),
        cost=cost,
        cost_name=name,
        proof=proof,
        free_directions=found.free_directions,
        seconds=time.perf_counter() - start,
        alpha=request.alpha,
    )


def cost_of_pose(request: Request, q: Array, q_dual: Array) -> float:
    """The cost (8) of a pose, parts (4,), with the prior's term: sums of squares of the motions' own residuals."""
    if request.covariances is not None:
        cost = squared_mahalanobis(request.motions, q, q_dual, request.covariances)
    else:
        rotation, translation = squared_residuals(request.motions, q, q_dual, request.weights)
        cost = rotation + request.alpha**2 * translation
    return cost if request.prior is None else cost + request.prior.value(q, q_dual)


def _check_options(
    method: Method[[Request]],
    weights: ArrayLike | None,
    covariances: ArrayLike | None,
    prior: DualQuaternionPrior | None,
    scale: ScaleMode,
) -> None:
    if not is_one_of(scale, get_args(ScaleMode)):
        raise OptionError(f"scale={brief(scale)} is not known; choose 'known' or 'unknown'")
    if prior is not None and not isinstance(prior, DualQuaternionPrior):
        raise PriorError(f"the prior is a {type(prior).__name__}; give a gtsam_rwhec.methods.DualQuaternionPrior")
    for given, needed in (
        (weights is not None, Takes.WEIGHTS),
        (covariances is not None, Takes.COVARIANCES),
        (prior is not None, Takes.PRIORS),
        (prior is not None and prior.form == "distance", Takes.LINEAR_PRIORS),
        (scale == "unknown", Takes.SHARED_SCALE),
    ):
        if given and needed not in method.takes:
            raise OptionError(f"method={method.name!r} cannot take {needed.value}; leave it out, or use another method")
