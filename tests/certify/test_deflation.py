"""Bounds on singular matrices: true, and far tighter than a verified test of the whole."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.certify import arrow
from gtsam_rwhec.certify.bound import _curvature, lower_bound
from gtsam_rwhec.certify.deflation import deflated_eigenvalue
from gtsam_rwhec.certify.descent import homogeneous
from gtsam_rwhec.certify.parts import parts_of
from gtsam_rwhec.certify.rotations import CONSTRAINTS, kkt_multipliers, vec
from gtsam_rwhec.certify.search import Search
from gtsam_rwhec.simulate import Noise, general


def at_the_optimum(seed: int, scale: str, sigma: float) -> tuple:
    simulated = general(2, 2, seed=seed, motion="planar", scale=scale, noise=Noise(sigma, 1e5))
    (part,) = parts_of(simulated.problem)
    search = Search(part, rw.SolveOptions())
    found = search.run("auto", None)
    kkt = kkt_multipliers(found.R, search.form.apply(homogeneous(found.R))[:-1].reshape(-1, 9))
    return search.form, kkt, found


def exact_eigenvalue(form, multipliers: np.ndarray) -> float:
    """Smallest eigenvalue of Z_rr with 50 digits, from the stored numbers."""
    mpmath.mp.dps = 50
    n = form.rotations
    A = arrow.dense(form.D, form.C[:, :, :-1], form.E[:-1, :-1])
    G = mpmath.matrix(form.G[:, :-1].tolist())
    Z = mpmath.matrix(A.tolist()) - G.T * G
    for i in range(n):
        for k in np.flatnonzero(multipliers[i]):
            for p, q in zip(*np.nonzero(CONSTRAINTS[k, :9, :9]), strict=True):
                Z[9 * i + int(p), 9 * i + int(q)] -= mpmath.mpf(multipliers[i, k]) * int(CONSTRAINTS[k, p, q])
    return min(mpmath.eigsy(Z, eigvals_only=True))


@pytest.mark.parametrize("scale", ["known", "shared"])
@pytest.mark.parametrize("sigma", [0.01, 1e-4])
@pytest.mark.parametrize("seed", range(3))
def test_it_is_below_the_smallest_eigenvalue_and_close_to_it(scale: str, sigma: float, seed: int) -> None:
    form, kkt, _ = at_the_optimum(seed, scale, sigma)
    D, C, E, rounded = _curvature(form, kkt)
    slack = np.full((form.rotations, 9), 1e-11 * form.magnitude)
    proven = deflated_eigenvalue(form, kkt, arrow.dense(D, C, E), rounded, slack)
    exact = exact_eigenvalue(form, kkt)
    assert mpmath.mpf(proven) <= exact
    assert float(exact) - proven < 1e-14 * form.magnitude


@pytest.mark.parametrize("sigma", [0.01, 1e-4])
def test_free_answers_have_bounds_as_tight_as_others(sigma: float) -> None:
    form, kkt, found = at_the_optimum(1, "shared", sigma)
    bound = lower_bound(form, kkt, vec(found.R).ravel())
    assert not bound.definite
    assert bound.lower <= found.cost
    assert found.cost - bound.lower < 1e-6 * max(found.cost, 1.0)


def test_nothing_is_claimed_of_an_indefinite_matrix() -> None:
    form, kkt, _ = at_the_optimum(0, "known", 0.01)
    worse = kkt.copy()
    worse[:, :3] += 0.01 * form.magnitude  # Z loses that much on its diagonal
    D, C, E, rounded = _curvature(form, worse)
    proven = deflated_eigenvalue(form, worse, arrow.dense(D, C, E), rounded, np.full((form.rotations, 9), 1e-9))
    assert mpmath.mpf(proven) <= exact_eigenvalue(form, worse)
