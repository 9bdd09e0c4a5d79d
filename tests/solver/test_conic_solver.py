"""Clarabel's conic problems: the stacked triangle, and a semidefinite program whose answer is known."""

from __future__ import annotations

import clarabel
import numpy as np
import pytest
import scipy.sparse

from gtsam_rwhec.solver.relaxation import solve_conic, stacked, unstacked


def test_the_stacked_triangle_keeps_inner_products_and_is_undone() -> None:
    M, N = (M + M.T for M in np.random.default_rng(0).standard_normal((2, 5, 5)))
    assert stacked(M) @ stacked(N) == pytest.approx(np.vdot(M, N), rel=1e-14)
    np.testing.assert_allclose(unstacked(np.r_[stacked(M), 7.0], 5), M, atol=1e-15)


def test_the_smallest_eigenvalue_is_the_largest_shift_that_stays_semidefinite() -> None:
    M = np.random.default_rng(1).standard_normal((6, 6))
    M = M + M.T
    A = scipy.sparse.csc_matrix(stacked(np.eye(6))[:, None])
    x, z, iterations = solve_conic(np.array([-1.0]), A, stacked(M), [clarabel.PSDTriangleConeT(6)], 1e-10, 100)
    assert x[0] == pytest.approx(np.linalg.eigvalsh(M)[0], rel=1e-8)
    assert np.trace(unstacked(z, 6)) == pytest.approx(1.0, rel=1e-8)
    assert 0 < iterations < 100
