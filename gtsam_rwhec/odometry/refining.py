"""The maximum of the exact likelihood: Gauss-Newton over all unknowns, the windows' motions eliminated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.given_rows import GivenRows, Rows
from gtsam_rwhec.odometry.likelihood import Eliminated, Linear, eliminated, linearised
from gtsam_rwhec.odometry.unknowns import Layout, State
from gtsam_rwhec.odometry.window_motions import WindowMotions

#: Steps at most. Well-excited drives take four.
MAX_STEPS = 40
#: Converged when a step would lower the cost by less than this.
CONVERGED = 1e-9
#: The largest turn or shift of one step, rad and m.
LARGEST_STEP = 0.3


@dataclass(frozen=True)
class Fit:
    """The end of a refinement.

    Attributes
    ----------
    state : State
    linear : Linear
    normal : Eliminated
    rows : Rows
        What was given.
    cost : float
        Half the weighted squares of all residuals.
    converged : bool
    """

    state: State
    linear: Linear
    normal: Eliminated
    rows: Rows
    cost: float
    converged: bool


def motions_fitted(windows: WindowMotions, W: Array, state: State, layout: Layout, steps: int = 3) -> State:
    """The same poses with each window's motion at its best."""
    still = np.zeros(layout.size)
    for _ in range(steps):
        normal = eliminated(linearised(windows, state), W, layout)
        state = state.moved(layout, still, normal.motions(still))
    return state


def refined(windows: WindowMotions, W: Array, state: State, layout: Layout, given: GivenRows, determined: Array) -> Fit:
    """Go down from a state along the directions ``determined`` (p, q), orthonormal columns."""
    state = motions_fitted(windows, W, state, layout, steps=2)
    converged = False
    for _ in range(MAX_STEPS):
        linear, normal, rows, cost = _at(windows, W, state, layout, given)
        H, g = normal.H + rows.information, normal.g - rows.J.T @ rows.r
        inner, right = determined.T @ H @ determined, determined.T @ g
        unit = 1.0 / np.sqrt(np.maximum(np.diagonal(inner), 1e-300))
        solved = unit * np.linalg.lstsq(inner * unit[:, None] * unit, unit * right, rcond=1e-13)[0]
        step = determined @ solved
        expected = float(right @ solved) + float(
            (normal.motions(step) * np.einsum("nab,nb->na", normal.D, normal.motions(step))).sum()
        )
        largest = float(np.abs(step).max(initial=0.0))
        step *= min(1.0, LARGEST_STEP / max(largest, 1e-300))
        state = state.moved(layout, step, normal.motions(step))
        if expected < CONVERGED * max(1.0, cost):
            converged = True
            break
    linear, normal, rows, cost = _at(windows, W, state, layout, given)
    return Fit(state, linear, normal, rows, cost, converged)


def _at(
    windows: WindowMotions, W: Array, state: State, layout: Layout, given: GivenRows
) -> tuple[Linear, Eliminated, Rows, float]:
    linear = linearised(windows, state)
    normal = eliminated(linear, W, layout)
    rows = given.rows(state, layout)
    return linear, normal, rows, normal.cost + 0.5 * float(rows.r @ rows.r)


def settled(state: State, free: Array, layout: Layout) -> State:
    """Free shifts taken out: along free directions of translations alone the sensors go where they are nearest."""
    if not free.shape[1]:
        return state
    moved = np.array([layout.spread(direction) for direction in free.T])[:, :, :6]  # (f, m, 6)
    shifts = np.einsum("mij,fmj->fmi", state.T[:, :3, :3], moved[:, :, 3:])
    _, s, Vt = np.linalg.svd(moved[:, :, :3].reshape(len(moved), -1).T, full_matrices=True)
    still = Vt[np.r_[s, np.zeros(len(moved) - len(s))] < 1e-2]  # combinations that turn nothing
    if not len(still):
        return state
    columns = np.einsum("sf,fmi->smi", still, shifts).reshape(len(still), -1).T
    t = state.T[:, :3, 3].ravel()
    nearest = t - columns @ np.linalg.lstsq(columns, t, rcond=1e-9)[0]
    T = state.T.copy()
    T[:, :3, 3] = nearest.reshape(-1, 3)
    T[0, :3, 3] = 0.0
    return replace(state, T=T)
