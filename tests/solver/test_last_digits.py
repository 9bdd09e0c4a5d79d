"""No verdict hangs on the last digit: inputs disturbed by 1e-12 give the same status, cause and free directions.

Exact data and carriers at rest are not among them: there a disturbance of 1e-12 is all that the inputs tell of answers
100 times as far away as anything measured, and the proof over that region is about as wide as the tolerance.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from rwhec_factors.se3 import expmap
from small_problems import GROSS_NOISE, SMALL_NOISE, simulated

import gtsam_rwhec as rw
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Noise

DISTURBANCES = 5


def facts(problem: rw.Problem) -> tuple[object, ...]:
    """What a solution says, without numbers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rw.errors.RwhecWarning)
        try:
            solution = rw.solve(problem)
        except rw.errors.RwhecError as error:
            return (type(error),)
    known = solution.identifiability
    certificate = solution.certificate
    free = tuple((one.kind, one.reason, frozenset(one.frames)) for one in known.free_directions)
    alone = tuple((each.is_unique, each.rotation_axes, len(each.free_directions)) for each in known.pairs.values())
    return certificate.status, certificate.cause, certificate.region is None, free, alone


@pytest.mark.parametrize("noise", [SMALL_NOISE, GROSS_NOISE], ids=["small noise", "gross noise"])
@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize("motion", ["general", "planar", "single_axis"])
def test_of_disturbed_inputs(motion: str, scale: ScaleMode, noise: Noise) -> None:
    problem = simulated(2, 2, 3, motion=motion, scale=scale, noise=noise).problem
    draw = np.random.default_rng(0)
    expected = facts(problem)
    for _ in range(DISTURBANCES):
        disturbed = {}
        for pair in problem.pairs:
            raw = problem.measurements(*pair)
            A, B = (T @ expmap(1e-12 * draw.standard_normal((len(T), 6))) for T in (raw.A, raw.B))
            disturbed[pair] = rw.Measurements(A, B, raw.sigma, raw.kappa)
        assert facts(problem.with_measurements(disturbed)) == expected
