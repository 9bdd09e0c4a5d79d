"""The answer of a stream's measurements where those of one pose of the carriers share its error."""

from __future__ import annotations

import warnings

from scipy.linalg import eigh

from gtsam_rwhec.errors import CountError, RwhecWarning, ScaleError, UnderdeterminedError
from gtsam_rwhec.fitting.fit_options import NoiseOptions, RefineOptions
from gtsam_rwhec.fitting.noise_refinement import under_noise
from gtsam_rwhec.fitting.noise_rows import Instants
from gtsam_rwhec.fitting.pair_data import PairData
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement import refine
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import solve

#: Noise of A and of B, independent from pose to pose: what else there is takes a whole log, and `calibrate`.
HOW, KINDS = RefineOptions(noise="estimate"), NoiseOptions(drift="none", systematic=False)


def under_shared_noise(problem: Problem) -> Refined | None:
    """The answer under the noise of A and of B that the residuals show.

    None where no two measurements share a pose of the carriers, or there are too few or too many for such a model.
    """
    data = [PairData.of(problem, pair, HOW, None) for pair in problem.pairs]
    if Instants.of(data).count == problem.number_of_measurements:
        return None
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):  # an update says what it lacks
        try:
            return under_noise(problem, solve(problem), HOW, KINDS).refined()[0]
        except (CountError, UnderdeterminedError, ScaleError):
            return None


def larger_by(shared: Refined, problem: Problem) -> float:
    """By this factor variances are larger, in the worst direction of a frame, than if no error were shared."""
    alone = refine(problem, shared.solution, HOW)
    every = ((of.covariance(name) for of in (shared, alone)) for name in shared.names)
    return max(1.0, *(float(eigh(*pair, eigvals_only=True)[-1]) for pair in every))
