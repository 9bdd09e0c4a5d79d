"""The lowest end of many random starts, by a descent that is not the library's."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import random_rotations, retract, tangent_basis, vec
from gtsam_rwhec.solver.search import Found, Search


def lowest_of_random_starts(form: ReducedForm, count: int, seed: int = 0) -> Array:
    """The rotations (n, 3, 3) of least cost that Levenberg-Marquardt on the dense form finds from all starts.

    It is not the library's descent.
    """
    Q, n = form.Q, form.rotations
    R = random_rotations(count * n, np.random.default_rng(seed))
    damping = np.full(count, 1e-3 * form.magnitude)

    def homogeneous(R: Array) -> Array:
        return np.c_[vec(R).reshape(count, 9 * n), np.ones(count)]

    x = homogeneous(R)
    cost = np.einsum("si,si->s", x @ Q, x)
    for _ in range(80):
        J = np.zeros((count, n, 9, n, 3))
        J[:, range(n), :, range(n)] = tangent_basis(R).reshape(count, n, 9, 3).transpose(1, 0, 2, 3)
        J = J.reshape(count, 9 * n, 3 * n)
        gradient = np.einsum("sip,si->sp", J, (x @ Q)[:, :-1])
        H = J.transpose(0, 2, 1) @ Q[:-1, :-1] @ J + damping[:, None, None] * np.eye(3 * n)
        step = -np.linalg.solve(H, gradient[..., None])[..., 0]
        moved = retract(R, step.reshape(-1, 3))
        x_new = homogeneous(moved)
        new = np.einsum("si,si->s", x_new @ Q, x_new)
        better = new < cost
        R = np.where(np.repeat(better, n)[:, None, None], moved, R)
        x, cost = np.where(better[:, None], x_new, x), np.where(better, new, cost)
        damping *= np.where(better, 0.2, 4.0)
    return R.reshape(count, n, 3, 3)[cost.argmin()]


def assert_never_beaten(search: Search, found: Found, starts: int) -> None:
    """The least end of many starts, evaluated on the measurements, is not below the bound: without any tolerance."""
    _, lowest = search.whole.answer_near(lowest_of_random_starts(search.form, starts))
    assert lowest.upper >= found.bound.lower_bound
    if found.is_closed:
        assert lowest.upper >= found.cost - search.tolerance(found.cost)
