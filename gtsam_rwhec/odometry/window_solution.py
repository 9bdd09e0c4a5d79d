"""Maximises the exact likelihood, and says what the drive leaves free.

Gauss-Newton over all unknowns, with the windows' motions eliminated. H is the information that is left, and N the part
of it that the noise of the estimated motions alone produces. A direction is free if its H is no larger than N can be by
chance: the ratio follows an F distribution. Afterwards each free direction is compared with the prior knowledge, which
may determine it (design facts 8, 14 and 24).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from rwhec_factors import se3
from scipy.special import chdtri, fdtri

from gtsam_rwhec.errors import OutlierError, ScaleError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.joint_cost import joint_form, solved, star_starts
from gtsam_rwhec.odometry.odometry_record import JointCertificate
from gtsam_rwhec.odometry.prior_knowledge import GivenRows, Rows
from gtsam_rwhec.odometry.residual_noise import found_variances, outlying, uncertain_by
from gtsam_rwhec.odometry.trajectory_errors import TrajectoryErrors
from gtsam_rwhec.odometry.window_likelihood import (
    SCALE,
    Eliminated,
    Layout,
    Linear,
    State,
    covariance_of_motions,
    covariances,
    eliminated,
    information_of_noise,
    linearised,
    predicted,
    weights,
)
from gtsam_rwhec.odometry.window_motions import WindowMotions

#: The probability that a free direction counts as determined: a fleet has many drives.
SIGNIFICANCE = 1e-6
#: Prior knowledge with more information than this, per square metre or radian, determines a direction.
HOLDS = 1.0
#: A variance is infinite if its component of a free direction exceeds this part of the largest component.
REACHES = 0.02
#: Ridge, as a part of each diagonal entry, that keeps factorisations of singular information from failing.
RIDGE = 1e-13


@dataclass(frozen=True)
class Freedom:
    """The free directions, and the information about the others."""

    by_data: Array  #: (p, f): directions that the drive leaves free, in units of 1 rad, metres, a scale times e
    left: Array  #: (p, l): directions that prior knowledge leaves free too
    information: Array  #: (p, p): H - N along determined directions, plus that of prior knowledge
    score: Array  #: (p, p): H plus that of prior knowledge: the covariance of the gradient
    given: Array  #: (p, p): that of prior knowledge alone

    def complement(self) -> Array:
        """An orthonormal basis (p, p - l) of the directions that are determined."""
        if not self.left.shape[1]:
            return np.eye(len(self.left))
        return np.linalg.svd(self.left, full_matrices=True)[0][:, self.left.shape[1] :]

    def inverse(self) -> Array:
        """The inverse (p, p) of the information, zero along the directions that are left free."""
        return self.inverse_of(self.information)

    def inverse_of(self, matrix: Array) -> Array:
        """The inverse (p, p) of a matrix of the unknowns, zero along the directions that are left free."""
        Z = self.complement()
        inner = Z.T @ matrix @ Z
        return Z @ np.linalg.inv(inner + RIDGE * np.diag(np.diagonal(inner))) @ Z.T

    def covariance(self, ratio: float = 1.0) -> Array:
        """(p, p), zero along the directions that are left free; the motions' part of it larger by a ratio."""
        inverse = self.inverse()
        return inverse @ (ratio * (self.score - self.given) + self.given) @ inverse


def freedom(H: Array, N: Array, possible: Array, given: Array, layout: Layout, squares: float, spare: float) -> Freedom:
    """Test every direction.

    ``possible`` is N for the largest plausible noise: a direction that it explains is free. ``squares`` and
    ``spare`` are the F distribution's degrees of freedom: squares of noise in a direction's information, and
    spare equations, which determine the noise.
    """
    data = np.setdiff1d(np.arange(layout.size), layout.ground)
    Hd, Nd, Pd = (each[np.ix_(data, data)] for each in (H, N, possible))
    # A weak prior on clocks: a clock that the drive does not determine must not make a pose free.
    clocks = layout.at[layout.open[:, 7], 7]
    of_clocks = np.zeros(layout.size)
    of_clocks[clocks] = np.diagonal(given)[clocks]
    whole = Hd + np.diag(of_clocks[data])
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(whole) + np.diagonal(Pd), 1e-200))
    scaled = whole * unit[:, None] * unit + RIDGE * np.eye(len(data))
    # With V'HV = I and W = V^-T: H = W W', and a direction's share of noise is a diagonal entry of V'NV.
    share, V = scipy.linalg.eigh(Pd * unit[:, None] * unit, scaled)
    threshold = float(
        fdtri(squares, spare, 1.0 - SIGNIFICANCE) if spare > 0.0 else chdtri(squares, SIGNIFICANCE) / squares
    )
    is_free = share * threshold >= 1.0
    W = np.linalg.inv(V).T / unit[:, None]
    noise = V.T @ (Nd * unit[:, None] * unit) @ V
    told = np.eye(len(data)) - noise
    told[is_free], told[:, is_free] = 0.0, 0.0
    informed = np.zeros((layout.size, layout.size))
    informed[np.ix_(data, data)] = W @ told @ W.T
    informed -= np.diag(of_clocks)  # they come back with what is given
    by_data = np.zeros((layout.size, int(is_free.sum())))
    by_data[data] = V[:, is_free] * unit[:, None]
    by_data = np.linalg.qr(by_data)[0] if by_data.size else by_data
    return Freedom(by_data, _left(by_data, given, layout), informed + given, H + given, given)


def _left(by_data: Array, given: Array, layout: Layout) -> Array:
    """The free directions that prior knowledge does not determine; the ground's unknowns are eliminated."""
    if not by_data.shape[1]:
        return by_data
    g = layout.ground
    inner = np.linalg.inv(given[np.ix_(g, g)] + RIDGE * np.eye(len(g)))
    held = given - given[:, g] @ inner @ given[g]
    clocks = layout.at[layout.open[:, 7], 7]
    held[clocks] = held[:, clocks] = 0.0
    values, vectors = np.linalg.eigh(by_data.T @ held @ by_data)
    left: Array = by_data @ vectors[:, values <= HOLDS]
    return left


def seven_each(directions: Array, layout: Layout) -> Array:
    """Directions (p, l) in identifiability's order, (7 (m - 1) + 1, l): each sensor's pose and scale; a zero."""
    padded = np.vstack([directions, np.zeros((1, directions.shape[1]))])
    rows = padded[layout.at[1:, : SCALE + 1].ravel()]
    return np.vstack([rows, np.zeros((1, directions.shape[1]))])


#: The most Gauss-Newton steps. Well-excited drives take four.
MAX_STEPS = 40
#: Converged when a step would lower the cost by less than this.
CONVERGED = 1e-9
#: The largest turn or shift of one step, rad and m.
LARGEST_STEP = 0.3


@dataclass(frozen=True)
class Fit:
    """The result of a refinement."""

    state: State
    linear: Linear
    normal: Eliminated
    rows: Rows  #: What was given
    cost: float  #: Half the weighted squares of all residuals
    converged: bool = False


def motions_fitted(windows: WindowMotions, W: Array, state: State, layout: Layout, steps: int = 3) -> State:
    """The state with the same poses and the best motion of each window."""
    still = np.zeros(layout.size)
    for _ in range(steps):
        normal = eliminated(linearised(windows, state), W, layout)
        state = state.moved(layout, still, normal.motions(still))
    return state


def refined(windows: WindowMotions, W: Array, state: State, layout: Layout, given: GivenRows, determined: Array) -> Fit:
    """Minimise the cost from a state, along the orthonormal columns of ``determined`` (p, q) only."""
    fit = _at(windows, W, motions_fitted(windows, W, state, layout, steps=2), layout, given)
    for _ in range(MAX_STEPS):
        normal, rows = fit.normal, fit.rows
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
        is_still = expected < CONVERGED * max(1.0, fit.cost)
        fit = _at(windows, W, fit.state.moved(layout, step, normal.motions(step)), layout, given)
        if is_still:
            return replace(fit, converged=True)
    return fit


def _at(windows: WindowMotions, W: Array, state: State, layout: Layout, given: GivenRows) -> Fit:
    linear = linearised(windows, state)
    normal = eliminated(linear, W, layout)
    rows = given.rows(state, layout)
    return Fit(state, linear, normal, rows, normal.cost + 0.5 * float(rows.r @ rows.r))


def settled(state: State, free: Array, layout: Layout) -> State:
    """Along free directions that are translations only, move the sensors as near to sensor 0 as possible."""
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


#: Rounds of the certified form. Each takes rotations, translations and weights from the round before.
ROUNDS = 8
#: The rounds end when no variance changes by more than this share.
SETTLED = 0.02
#: After them, rounds of refinement, each with new noise and free directions.
REFINED = 3
#: Free directions are tested with larger noise: by this many standard deviations, and at most by this factor.
UNSURE, MOST_UNSURE = 3.0, 30.0
#: The fewest windows that must be left, and the smallest share of each sensor's windows.
FEWEST, LEAST_SHARE = 6, 0.3


@dataclass(frozen=True)
class Task:
    """The inputs that do not depend on the windows."""

    names: tuple[str, ...]  #: Sensors; the poses are in the frame of the first
    #: scaled, stated: (m,) booleans: which sensors' scale is unknown, and which sensors' noise was stated
    scaled: np.ndarray
    stated: np.ndarray
    layout: Layout
    given: GivenRows
    reject: bool


@dataclass(frozen=True)
class Answer:
    """The solution on one set of windows."""

    windows: WindowMotions  #: Those that are used
    left_out: np.ndarray  #: (m, n') booleans: outlying windows of the set that was given
    variances: Array  #: (m, 2)
    fit: Fit
    W: Array  #: (m, n, 6, 6)
    freedom: Freedom
    errors: TrajectoryErrors
    certificate: JointCertificate
    certified: State  #: The certified answer, before the exact likelihood


def solve_windows(
    windows: WindowMotions, variances: Array, task: Task, start: State | None, progress: Progress
) -> Answer:
    """Solve, certify and refine on one set of windows; ``start`` is a solution on other windows."""
    progress("solving jointly")
    used = Used(windows, np.zeros_like(windows.used), windows, variances)
    certified, certificate, used = _certified(used, task, start)
    state = certified
    progress("refining the joint likelihood")
    for _ in range(REFINED):
        W = used.W
        free = freedom_at(used, motions_fitted(used.windows, W, state, task.layout), task)
        state = settled(state, free.left, task.layout)
        determined = free.complement()
        fit = refined(used.windows, W, state, task.layout, task.given, determined)
        state, used, change = _reweighed(used, fit.state, fit.linear, W, task)
        if change < 0.2 * SETTLED:
            break
    fit = refined(used.windows, used.W, state, task.layout, task.given, determined)
    progress("looking for biases, bends and drifts")
    measured, errors = used.windows, TrajectoryErrors.none(used.windows, task.layout)
    for _ in range(REFINED):
        free = freedom_at(used, fit.state, task)
        linear = replace(fit.linear, r=fit.linear.r + errors.motion)
        normal, given = eliminated(linear, used.W, task.layout), fit.rows.J.T @ fit.rows.r
        step = free.inverse_of(free.score)
        # effects on the measured motions would be proportional to their noise
        as_fitted = replace(measured, M=errors.put_on(predicted(fit.state)))
        errors = TrajectoryErrors.found(as_fitted, linear, used.W, normal, task.layout, step, given)
        windows = errors.taken_off(measured)
        linear = linearised(windows, motions_fitted(windows, used.W, fit.state, task.layout))
        taken = task.layout.size + round(errors.equations)
        variances = found_variances(windows, linear, used.variances, task.stated, fit.state.scale, taken)
        used = replace(used, windows=windows, variances=variances)
        fit = refined(windows, used.W, fit.state, task.layout, task.given, free.complement())
    free = freedom_at(used, fit.state, task)
    return Answer(used.windows, used.left_out, used.variances, fit, used.W, free, errors, certificate, certified)


@dataclass(frozen=True)
class Used:
    """The windows that are used, and their noise."""

    every: WindowMotions  #: With those that are not used
    left_out: np.ndarray  #: (m, n') booleans: outlying windows of ``every``
    windows: WindowMotions
    variances: Array  #: (m, 2)

    @property
    def W(self) -> Array:
        """The windows' inverse covariances (m, n, 6, 6)."""
        return weights(self.windows, *self.variances.T)


def _reweighed(used: Used, state: State, linear: Linear, W: Array, task: Task) -> tuple[State, Used, float]:
    """Find noise and new outlying windows; the largest change of a log variance, infinite with a new outlier."""
    windows = used.windows
    variances = found_variances(windows, linear, used.variances, task.stated, state.scale, task.layout.size)
    new = outlying(windows, linear, W, task.stated) if task.reject else np.zeros_like(windows.used)
    if not new.any():
        return state, replace(used, variances=variances), float(np.abs(np.log(variances / used.variances)).max())
    left_out = used.left_out.copy()
    left_out[:, np.searchsorted(used.every.start, windows.start)] |= new
    windows = used.every.without(left_out)
    for k, name in enumerate(task.names):
        still, had = int(windows.used[k].sum()), int(used.every.used[k].sum())
        if len(windows) < FEWEST or still < LEAST_SHARE * had:
            raise OutlierError(
                f"{name} contradicts the other sensors in {had - still} of {had} windows; does its track belong to "
                "this drive, is its clock the same, are its poses T_start_sensor and not inverted?"
            )
    state = State.at(state.T, state.scale, windows, state.height)
    return state, Used(used.every, left_out, windows, variances), np.inf


def _certified(used: Used, task: Task, start: State | None) -> tuple[State, JointCertificate, Used]:
    windows = used.windows
    w, s = windows.rotation_vectors(), windows.M[..., :3, 3]
    starts = star_starts(w, s, windows.used)
    if start is None:
        rough = np.tile(np.eye(4), (len(task.names), 1, 1))
        rough[1:, :3, :3] = starts[1]
        sizes = np.array([np.median(np.linalg.norm(s[k, windows.used[k]], axis=1)) for k in range(len(rough))])
        metric = float(np.median(sizes[~task.scaled]))
        scale = np.where(task.scaled, sizes / max(metric, 1e-12), 1.0)
        if not (scale > 0.0).all():
            name = task.names[int(np.argmin(scale))]
            raise ScaleError(f"the track of {name} does not move, so its scale cannot be told; is it the right topic?")
        state = State.at(rough, scale, windows, task.given.first_height)
    else:
        state = State.at(start.T, start.scale, windows, start.height)
        state = replace(state, tilt=start.tilt)
        starts = [start.T[1:, :3, :3], *starts]
    for _ in range(ROUNDS):
        form = joint_form(used.windows, state, used.variances, task.scaled, task.given.form_rows(state, task.scaled))
        y, certificate = solved(form, starts, axis=_main_axis(state.motion))
        T, scales = form.poses(y)
        if not (scales > 0.0).all():
            raise ScaleError(
                f"the scale of {task.names[1 + int(np.argmin(scales))]} is {scales.min():.3g} at the optimum; its "
                "motion does not fit the others': are its poses inverted?"
            )
        state = State.at(np.concatenate([np.eye(4)[None], T]), np.r_[1.0, scales], used.windows, state.height)
        W = used.W
        state = motions_fitted(used.windows, W, state, task.layout)
        state, used, change = _reweighed(used, state, linearised(used.windows, state), W, task)
        starts = [T[:, :3, :3], *starts[:3]]
        if change < SETTLED:
            break
    return state, certificate, used


def freedom_at(used: Used, state: State, task: Task) -> Freedom:
    """The free directions at a state."""
    windows, W, variances = used.windows, used.W, used.variances
    linear = linearised(windows, state)
    normal = eliminated(linear, W, task.layout)
    still = linear.r - np.einsum("mnij,nj->mni", linear.B, normal.motions(np.zeros(task.layout.size)))
    spare = 6.0 * float((windows.used.sum(axis=0) - 1).sum()) - task.layout.size
    # The largest plausible noise: the estimate may be too small, and stated noise may be too small for the residuals.
    unsure = uncertain_by(windows, linear, variances, task.stated, state.scale)
    excess = max(1.0, float(np.einsum("mni,mnij,mnj->", still, W, still)) / max(spare, 1.0))
    largest = variances * np.exp(np.minimum(UNSURE * unsure, np.log(MOST_UNSURE))) * excess
    known, possible = (
        information_of_noise(
            linear,
            W,
            task.layout,
            state,
            normal.D,
            covariance_of_motions(linear, W, normal.D, covariances(windows, *v.T)),
        )
        for v in (variances, largest)
    )
    rows = task.given.rows(state, task.layout)
    squares = 2.0 * len(windows)
    return freedom(normal.H, known, possible, rows.information, task.layout, squares, spare)


def _main_axis(motion: Array) -> Array:
    """The axis (3,) about which the vehicle turned most."""
    w = se3.so3_logmap(motion[:, :3, :3])
    return np.linalg.eigh(w.T @ w)[1][:, -1]


def too_few(count: int) -> UnderdeterminedError:
    """The error for a drive with too few windows."""
    return UnderdeterminedError(
        f"the tracks share {count} windows of time; at least {FEWEST} are needed. Record a longer drive, or look for "
        "gaps and for clocks that are apart"
    )
