"""All methods by name, and the call that runs a method."""

from __future__ import annotations

import time

import gtsam

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import PoseLike, one_transform
from gtsam_rwhec.methods import (
    certified,
    dornaika1998,
    heller2014,
    horn2023,
    image_methods,
    li2010,
    linear_methods,
    local_on_manifold,
    strobl2006,
    tabb2017,
    wise2020,
    zhuang1994,
)
from gtsam_rwhec.methods.applicability import check_problem
from gtsam_rwhec.methods.estimate import Estimate, Outcome, Poses, Proof
from gtsam_rwhec.methods.evaluation import evaluate
from gtsam_rwhec.methods.method import Method, MethodOptions, check_options
from gtsam_rwhec.problem.problem import Problem

#: The cost by which all answers are compared.
COST_NAME = "J (RWHEC paper, eq. 18)"
#: All methods: closed forms, then iterations, then global methods.
METHODS: dict[str, Method[[Problem, MethodOptions]]] = {
    method.name: method
    for method in (
        zhuang1994.METHOD,
        dornaika1998.CLOSED,
        li2010.KRONECKER,
        li2010.DUAL_QUATERNIONS,
        linear_methods.SHAH,
        linear_methods.WANG,
        dornaika1998.NONLINEAR,
        local_on_manifold.METHOD,
        strobl2006.METHOD,
        horn2023.METHOD,
        tabb2017.C1,
        tabb2017.C2,
        tabb2017.C1_SEPARABLE,
        tabb2017.C2_SEPARABLE,
        image_methods.RP1,
        wise2020.METHOD,
        heller2014.METHOD,
        heller2014.MATRIX,
        image_methods.EVANGELISTA,
        certified.METHOD,
    )
}


@one_blas_thread()
def run(name: str, problem: Problem, options: MethodOptions | None = None) -> Estimate[dict[str, gtsam.Pose3]]:
    """Solve a problem by a published method.

    Parameters
    ----------
    name : str
        A key of ``METHODS``.
    problem : Problem
    options : MethodOptions, optional

    Raises
    ------
    OptionError
        When the name is unknown, or ``options`` is not a ``MethodOptions``.
    CountError, FrameError, MeasurementsNotKeptError, NoiseError, PriorError, ScaleError
        When the method cannot solve the problem; the message says why.
    UnderdeterminedError
        When the measurements do not determine the method's equations.
    """
    method = method_of(name)
    check_options(options)
    check_problem(method, problem)
    start = time.perf_counter()
    found = method.function(problem, options or MethodOptions())
    seconds = time.perf_counter() - start
    return estimate_of(method.name, problem, found, seconds)


def method_of(name: str) -> Method[[Problem, MethodOptions]]:
    """The method of a name; OptionError for an unknown name."""
    try:
        return METHODS[name]
    except (KeyError, TypeError):
        raise OptionError(f"method {brief(name)} is not one of {', '.join(METHODS)}") from None


def estimate_of(name: str, problem: Problem, found: Outcome[Poses], seconds: float) -> Estimate[dict[str, gtsam.Pose3]]:
    """A method's answer, evaluated under the certified objective."""
    scale = found.scale if isinstance(found.scale, float) else dict(found.scale)
    evaluation = evaluate(problem, found.X, found.Y, scale)
    proof = None
    if found.cost is not None and found.lower_bound is not None:
        proof = Proof(found.cost, found.cost_name, found.lower_bound, bool(found.is_optimal))
    return Estimate(
        method=name,
        X={name: _pose3(found.X[name], name) for name in problem.targets},
        Y={name: _pose3(found.Y[name], name) for name in problem.sensors},
        scale=scale,
        cost=evaluation.cost,
        cost_name=COST_NAME,
        proof=proof,
        residuals=evaluation.residuals,
        seconds=seconds,
        starts_from=found.starts_from,
        notes=found.notes,
        free_directions=evaluation.free_directions,
    )


def _pose3(pose: PoseLike, name: str) -> gtsam.Pose3:
    return gtsam.Pose3(one_transform(pose, name))
