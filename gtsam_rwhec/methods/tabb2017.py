"""Tabb and Ahmad Yousef 2017: two costs, separable and simultaneous, in three parameterisations of rotations.

::

    c1 = sum |A_i X - Y B_i|_F^2            c2 = sum |A_i - Y B_i X^-1|_F^2

A left multiplication by a pose changes no Frobenius norm, so c2 is sum |B_i X^-1 - Y^-1 A_i|_F^2: c1 of the inverted
equation. c1 is quadratic in the entries of X and Y, c2 in the entries of their inverses. "Simultaneous" minimises a
cost over rotations and translations together. "Separable" minimises its rotation part first, then finds the
translations for these rotations. The third cost, reprojection errors (rp1), needs images: see ``reprojection``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import ROTATION, of_rotations, to_rotations
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.levenberg_marquardt import descend_on_chart
from gtsam_rwhec.methods.linear_methods import start_of
from gtsam_rwhec.methods.method import UNWEIGHTED, Method, MethodOptions, Properties
from gtsam_rwhec.methods.unit_weights import UnitForm
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.descent import homogeneous
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import vec

Cost = Literal["c1", "c2"]
Mode = Literal["simultaneous", "separable"]
#: Euler angles about x, y and z (R = R_z R_y R_x), the rotation vector, the quaternion divided by its length.
Parameterisation = Literal["euler", "axis-angle", "quaternion"]
#: R (n, 3, 3) of parameters (n, k), and its derivatives (n, 9, k) column after column.
Chart = Callable[[Array], tuple[Array, Array]]


def tabb2017(
    problem: Problem,
    options: MethodOptions,
    cost: Cost = "c1",
    mode: Mode = "simultaneous",
    parameterisation: Parameterisation = "axis-angle",
) -> Outcome[Poses]:
    """Solve by a variant of the method, from a start, by Levenberg-Marquardt; OptionError for an unknown variant."""
    for value, known in ((cost, ("c1", "c2")), (mode, ("simultaneous", "separable")), (parameterisation, CHARTS)):
        if value not in known:
            raise OptionError(f"tabb2017: {value!r} is not one of {', '.join(map(repr, known))}")
    turned = cost == "c2"
    X, Y, _, starts_from = start_of(problem, options)
    form = UnitForm.of(problem, turned=turned)
    R = form.rotations_of(X, Y)
    cost_of_rotations = form.reduced if mode == "simultaneous" else form.rotations_alone
    return form.outcome(least(cost_of_rotations, R, parameterisation, options.max_iterations), starts_from)


def least(form: ReducedForm, R: Array, parameterisation: Parameterisation, max_iterations: int) -> Array:
    """Rotations (n, 3, 3) of a local minimum of x'Q'x, from the rotations R."""
    to_parameters, chart = CHARTS[parameterisation]
    n, k = to_parameters(R).shape

    def point(p: Array) -> tuple[Array, Array]:
        rotations, by_parameter = chart(p.reshape(n, k))
        derivatives = np.zeros((9 * n + 1, n * k))  # of x = [vec R_1, ..., vec R_n, 1]
        for frame in range(n):
            derivatives[9 * frame : 9 * frame + 9, k * frame : k * frame + k] = by_parameter[frame]
        return homogeneous(rotations), derivatives

    found = descend_on_chart(form.Q, point, to_parameters(R).ravel(), max_iterations)
    return chart(found.reshape(n, k))[0]


def from_euler(p: Array) -> tuple[Array, Array]:
    """R_z R_y R_x of angles (n, 3) about x, y, z."""
    x, y, z = (from_rotation_vectors(p[:, k, None] * np.eye(3)[k])[0] for k in range(3))
    hat_x, hat_y, hat_z = se3.hat(np.eye(3))
    columns = [z @ y @ x @ hat_x, z @ y @ hat_y @ x, z @ hat_z @ y @ x]
    return z @ y @ x, np.stack([vec(column) for column in columns], axis=2)


def to_euler(R: Array) -> Array:
    """Angles (n, 3) about x, y, z; at the poles, where x and z turn about one axis, x is zero."""
    y = np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))
    pole = np.abs(R[:, 2, 0]) > 1.0 - 1e-12
    x = np.where(pole, 0.0, np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    z = np.where(pole, np.arctan2(-R[:, 0, 1], R[:, 1, 1]), np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    return np.stack([x, y, z], axis=1)


def from_rotation_vectors(p: Array) -> tuple[Array, Array]:
    """The exponential of rotation vectors (n, 3), and its derivative by the right Jacobian."""
    R = se3.expmap(np.concatenate([p, np.zeros_like(p)], axis=1))[:, :3, :3]
    right_jacobian = np.linalg.inv(se3.so3_left_jacobian_inverse(-p))
    columns = [vec(R @ se3.hat(right_jacobian[:, :, k])) for k in range(3)]
    return R, np.stack(columns, axis=2)


def from_quaternions(p: Array) -> tuple[Array, Array]:
    """Rotations of quaternions (n, 4), scalar last, divided by their lengths."""
    length = np.linalg.norm(p, axis=1)[:, None]
    q = p / length
    by_q = 2.0 * np.einsum("nd,cdik->ncik", q, ROTATION)
    tangent = (np.eye(4) - q[:, :, None] * q[:, None, :]) / length[:, :, None]
    derivative = np.einsum("ncik,ncm->nkim", by_q, tangent).reshape(len(p), 9, 4)
    return to_rotations(q), derivative


CHARTS: dict[str, tuple[Callable[[Array], Array], Chart]] = {
    "euler": (to_euler, from_euler),
    "axis-angle": (se3.so3_logmap, from_rotation_vectors),
    "quaternion": (of_rotations, from_quaternions),
}


SOURCE = (
    "A. Tabb and K. Ahmad Yousef, Solving the robot-world hand-eye(s) calibration problem with iterative methods, "
    "Machine Vision and Applications 28, 2017"
)


def _method(cost: Cost, mode: Mode) -> Method[[Problem, MethodOptions]]:
    return Method(
        name=f"tabb2017_{cost}" + ("_separable" if mode == "separable" else ""),
        properties=Properties(
            "Euler angles, rotation vectors or quaternions", joint=mode == "simultaneous", multiple="Xs or Ys"
        ),
        source=SOURCE,
        assumes=f"{UNWEIGHTED} A start near the answer.",
        function=partial(tabb2017, cost=cost, mode=mode),
    )


C1 = _method("c1", "simultaneous")
C2 = _method("c2", "simultaneous")
C1_SEPARABLE = _method("c1", "separable")
C2_SEPARABLE = _method("c2", "separable")
