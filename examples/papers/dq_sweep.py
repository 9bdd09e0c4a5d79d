"""Methods of ``A X = X B`` over many alphas: a sample's moments are taken once, whatever alpha is."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from dq_scenarios import Array, Sample

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.methods import motions_of
from gtsam_rwhec.methods.dq_descent import squared, unit_combination
from gtsam_rwhec.methods.dual_quaternion_cost import motion_moments, to_transform
from gtsam_rwhec.methods.hand_eye import HAND_EYE_METHODS
from gtsam_rwhec.methods.hand_eye_request import Request
from gtsam_rwhec.methods.method import Outcome

#: The paper's names, in the order of its Table 2.
NAMES = {
    "DQOpt": "dqopt",
    "DQ2ndOrd": "dq2ndord",
    "DQConvRlx": "dqconvrlx",
    "DQ2Steps": "dq2steps",
    "Dan": "dan",
    "Dan, rows": "",
    "ChVecOpt": "chvecopt",
    "QuatVecOpt": "quatvecopt",
    "DQNLOpt": "dqnlopt",
    "DQNLOptRnd": "dqnloptrnd",
}
#: Whose answer is the same for every alpha.
WITHOUT_ALPHA = ("DQ2Steps",)
#: Appendix D: 100 values from 10^-2 to 10^1.7, in 1/m.
ALPHAS = np.logspace(-2.0, 1.7, 100)


def requests(sample: Sample, alphas: Sequence[float] | Array, rng: int = 0) -> list[Request]:
    """One request for each alpha; S, M and W are linear in alpha^2 (eq. 9). ``rng``: seed of random starts."""
    motions = motions_of(sample.C, sample.H)
    moments = motion_moments(motions.rows)
    return [
        Request(motions, moments.cost(float(a)), float(a), None, None, prior=None, scale="known", rng=rng)
        for a in alphas
    ]


def dan_rows(request: Request) -> Outcome[Array]:
    """Dan with alpha on the equations' lower rows only, not on the unknown q' too.

    Section 4.3 says that the translations are scaled, which is ``dan``: (q, alpha q') has length one. Table 2's Dan
    (best alpha 42 and 30 at the range's end, errors of meters) is (q, q') of length one, as here.
    """
    vectors = request.motions.rows[[0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]]
    vectors[6:] *= request.alpha
    form = squared(vectors @ vectors.T)
    form[4:] *= request.alpha
    form[:, 4:] *= request.alpha
    null = np.linalg.eigh(form)[1]
    q, q_dual = unit_combination(null[:4, :2], null[4:, :2])
    return Outcome(to_transform(q, q_dual))


def function_of(name: str) -> Callable[[Request], Outcome[Array]]:
    """The method behind a name of ``NAMES``."""
    return HAND_EYE_METHODS[NAMES[name]].function if NAMES[name] else dan_rows


def errors(sample: Sample, names: Sequence[str], alphas: Sequence[float] | Array = ALPHAS) -> Array:
    """Errors (names, alphas, 2): rotation in degrees, translation in cm."""
    asked = requests(sample, alphas)
    found = np.empty((len(names), len(asked), 2))
    for of_name, name in zip(found, names, strict=True):
        function = function_of(name)
        if name in WITHOUT_ALPHA:
            of_name[:] = distance(function(asked[0]).X, sample.X)
            continue
        for of_alpha, request in zip(of_name, asked, strict=True):
            try:
                of_alpha[:] = distance(function(request).X, sample.X)
            except UnderdeterminedError:
                of_alpha[:] = np.nan
    return found


def distance(X: Array, truth: Array) -> tuple[float, float]:
    """Angle (degrees) and length (cm) between two poses (4, 4)."""
    difference = X[:3, :3].T @ truth[:3, :3]
    sine = np.linalg.norm(difference - difference.T) / np.sqrt(8.0)
    return (
        float(np.degrees(np.arctan2(sine, 0.5 * (np.trace(difference) - 1.0)))),
        100.0 * float(np.linalg.norm(X[:3, 3] - truth[:3, 3])),
    )
