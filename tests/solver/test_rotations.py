"""The constraints of SO(3), in exact arithmetic: Theorem 6 and 8 of the RWHEC paper, and its Appendix A."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import scipy.linalg
from exact_arithmetic import basis_of, homogeneous, rank, rational_quaternion, rotation
from exact_cost import fractions
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from rwhec_factors.se3 import so3_nearest

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.rotations import (
    ALL_CONSTRAINTS,
    CONSTRAINTS,
    kkt_multipliers,
    random_rotations,
    retract,
    tangent_basis,
    unvec,
    vec,
)

integers = st.integers(-20, 20)
quaternions = st.tuples(integers, integers, integers, integers).filter(any)
EXACT = fractions(ALL_CONSTRAINTS)
SPECIAL = [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1), (1, 1, 0, 0), (1, 1, 1, 1), (1, -1, 1, 1), (0, 3, 4, 0)]


def jacobian(R: np.ndarray) -> np.ndarray:
    """(21, 9): derivatives of the constraints with h = 1, exactly."""
    x = homogeneous([R])
    return np.array([2 * (A @ x)[:9] for A in EXACT], dtype=object)


def wedge(w: Array) -> Array:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


@given(quaternions)
def test_all_21_constraints_vanish_exactly_on_rotations(q: tuple[int, int, int, int]) -> None:
    x = homogeneous([rotation(np.array(q, dtype=object))])
    assert all(x @ A @ x == 0 for A in EXACT)


@given(quaternions)
def test_reflections_keep_both_orthogonalities_and_break_the_handedness(q: tuple[int, int, int, int]) -> None:
    x = homogeneous([-rotation(np.array(q, dtype=object))])
    values = [x @ A @ x for A in EXACT]
    assert not any(values[:11])
    assert not values[20]
    assert any(values[11:20])


@given(st.lists(st.integers(-3, 3), min_size=9, max_size=9))
def test_nothing_but_rotations_satisfies_them(entries: list[int]) -> None:
    M = np.array(entries, dtype=float).reshape(3, 3)
    x = np.append(vec(M[None]).ravel(), 1.0)
    satisfied = not np.einsum("kpq,p,q->k", ALL_CONSTRAINTS, x, x).any()
    assert satisfied == (np.array_equal(M.T @ M, np.eye(3)) and round(np.linalg.det(M)) == 1)


@pytest.mark.parametrize("q", SPECIAL)
def test_jacobian_has_rank_6_at_special_rotations(q: tuple[int, int, int, int]) -> None:
    J = jacobian(rotation(np.array(q, dtype=object)))
    assert (rank(J), rank(J[:6]), rank(J[6:11]), rank(J[11:20])) == (6, 6, 5, 6)


@given(quaternions)
@settings(max_examples=40, deadline=None)
def test_jacobian_has_rank_6_on_all_of_so3(q: tuple[int, int, int, int]) -> None:
    """Theorem 6: all 21 (ACQ), and the first six alone, which is Theorem 8's condition (a)."""
    R = rotation(np.array(q, dtype=object))
    J = jacobian(R)
    assert J.shape == (21, 9)
    assert rank(J) == rank(J[:6]) == 6
    assert not (J @ basis_of(R)).any()  # the tangents are what is left (eq. 84)


@given(quaternions, st.lists(st.integers(-5, 5), min_size=4, max_size=4))
@settings(max_examples=30, deadline=None)
def test_rank_and_redundant_constraints_are_constant_nearby(q: tuple[int, int, int, int], step: list[int]) -> None:
    """Theorem 8's condition (b): where R'R = I, near a rotation, the other fifteen stay zero."""
    nearby = np.array([Fraction(a) + Fraction(b, 10**9) for a, b in zip(q, step, strict=True)], dtype=object)
    assume(nearby.any())
    R = rotation(nearby)
    x = homogeneous([R])
    assert not any(x @ A @ x for A in EXACT[6:])
    assert rank(jacobian(R)) == 6


def test_twenty_of_the_21_constraints_are_independent() -> None:
    every = fractions(ALL_CONSTRAINTS.reshape(21, 100))
    assert rank(every) == rank(every[:20]) == 20
    np.testing.assert_array_equal(CONSTRAINTS, ALL_CONSTRAINTS[:20])
    # The one left out completes R R' = I, whose trace is that of R'R = I.
    np.testing.assert_array_equal(ALL_CONSTRAINTS[:3].sum(axis=0), ALL_CONSTRAINTS[[9, 10, 20]].sum(axis=0))
    assert len(np.unique(ALL_CONSTRAINTS, axis=0)) == 21


def test_appendix_a_spans_the_same_matrices() -> None:
    """Eqs. 70-73: P_1 of Lambda_1 (+) Lambda_2 and P_2 of lambda, for one rotation, as matrices over [vec R, h]."""
    theirs = []
    for a in range(3):
        for b in range(a, 3):
            Lambda = np.zeros((3, 3))
            Lambda[a, b] = Lambda[b, a] = 1.0
            for kronecker in (np.kron(Lambda, np.eye(3)), np.kron(np.eye(3), Lambda)):
                theirs.append(scipy.linalg.block_diag(-kronecker, np.trace(Lambda)))
    zero, eye = np.zeros((3, 3)), np.eye(3)
    P_o = np.block([[zero, eye, zero], [zero, zero, eye], [eye, zero, zero]])
    for m in np.eye(9):
        ijk, jki, kij = (wedge(part) for part in m.reshape(3, 3))
        P = np.zeros((10, 10))
        P[:9, :9] = np.block([[zero, -ijk, kij], [ijk, zero, -jki], [-kij, jki, zero]])
        P[:9, 9] = P[9, :9] = -P_o @ m
        theirs.append(P)
    assert len(theirs) == 21
    of_paper = fractions(np.array(theirs).reshape(21, 100))
    assert rank(of_paper) == 20
    assert rank(np.concatenate([of_paper, fractions(ALL_CONSTRAINTS.reshape(21, 100))])) == 20


def test_vec_stacks_columns() -> None:
    R = np.arange(18.0).reshape(2, 3, 3)
    np.testing.assert_array_equal(vec(R)[0], R[0].ravel(order="F"))
    np.testing.assert_array_equal(unvec(vec(R)), R)
    np.testing.assert_array_equal(unvec(vec(R).ravel()), R)


def test_tangents_are_those_of_right_perturbations() -> None:
    R = random_rotations(5, np.random.default_rng(0))
    w = np.random.default_rng(1).standard_normal((5, 3))
    moved = np.array([each @ wedge(by) for each, by in zip(R, w, strict=True)])
    np.testing.assert_allclose(np.einsum("nik,nk->ni", tangent_basis(R), w), vec(moved), atol=1e-14)
    exact = rotation(rational_quaternion(R[0]))
    np.testing.assert_allclose(basis_of(exact).astype(float), tangent_basis(R)[0], atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 0.3, 2.0, 3.0])
def test_retraction_is_the_exponential(size: float) -> None:
    generator = np.random.default_rng(3)
    R = random_rotations(20, generator)
    w = size * generator.standard_normal((20, 3)) / np.sqrt(3.0)
    expected = np.array([each @ scipy.linalg.expm(wedge(by)) for each, by in zip(R, w, strict=True)])
    np.testing.assert_allclose(retract(R, w), expected, atol=1e-14)


def test_a_thousand_retractions_stay_on_so3() -> None:
    generator = np.random.default_rng(4)
    R = random_rotations(3, generator)
    for _ in range(1000):
        R = retract(R, generator.standard_normal((3, 3)))
    np.testing.assert_allclose(R.transpose(0, 2, 1) @ R, np.broadcast_to(np.eye(3), (3, 3, 3)), atol=2e-15)
    assert (np.linalg.det(R) > 0.0).all()


@pytest.mark.parametrize("seed", range(3))
def test_projection_is_the_nearest_rotation(seed: int) -> None:
    generator = np.random.default_rng(seed)
    M = generator.standard_normal((4, 3, 3))
    M[0] = -np.eye(3)  # every half turn is as near
    nearest = so3_nearest(M)
    np.testing.assert_allclose(nearest @ nearest.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(nearest), 1.0)
    others = random_rotations(500, generator)
    distance = np.linalg.norm(M[:, None] - others, axis=(2, 3)).min(axis=1)
    assert (np.linalg.norm(M - nearest, axis=(1, 2)) <= distance + 1e-12).all()


def test_random_rotations_are_rotations_and_uniform() -> None:
    R = random_rotations(20_000, np.random.default_rng(5))
    np.testing.assert_allclose(R.transpose(0, 2, 1) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    assert (np.linalg.det(R) > 0.0).all()
    # Entries have mean 0 and variance 1/3; angles have the density (1 - cos t) / pi, so tr R has mean 0.
    np.testing.assert_allclose(R.mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose((R**2).mean(axis=0), 1.0 / 3.0, atol=0.02)


def test_kkt_multipliers_leave_the_tangential_gradient_alone() -> None:
    generator = np.random.default_rng(6)
    R, gradient = random_rotations(4, generator), generator.standard_normal((4, 9))
    multipliers = kkt_multipliers(R, gradient)
    assert not multipliers[:, 6:].any()
    Lambda = np.einsum("nk,kpq->npq", multipliers, CONSTRAINTS)
    rest = gradient - np.einsum("npq,nq->np", Lambda, np.c_[vec(R), np.ones(4)])[:, :9]
    basis = tangent_basis(R)
    in_tangents = np.einsum("npk,nk->np", basis, np.einsum("npk,np->nk", basis, gradient)) / 2.0
    np.testing.assert_allclose(rest, in_tangents, atol=1e-13)
