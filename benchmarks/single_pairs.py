"""The real dataset's 73 pairs, each alone: certified or shown free, and never beaten by a hundred random starts.

    python benchmarks/single_pairs.py [--starts 100] [--scale known shared]

The random starts share no code with the library's forms: the cost is built here from the measurements themselves
(eqs. 18 and 24-33 of the RWHEC paper), translations and scale are projected out of the residuals, and all starts of all
pairs descend at once by Levenberg-Marquardt steps on SO(3) x SO(3).
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Sequence

import numpy as np
from bars import Row, run_script, utias_folder
from numpy.typing import NDArray

import gtsam_rwhec as rw

Array = NDArray[np.float64]
#: A random start beats an answer when it costs less by more than this part of it (and, where the answer is proven
#: optimal but not unique, by more than the gap that its certificate states); both costs come from the same form.
BEATEN = 1e-10


def pair_alone(problem: rw.Problem, target: str, sensor: str, scale: rw.ScaleMode) -> rw.Problem:
    """A problem with one pair of another's."""
    measured = problem.measurements(target, sensor)
    alone = rw.Problem(scale=scale)
    alone.add(target, sensor, measured.A, measured.B, sigma=1.0, kappa=1.0)
    return alone


def reduced_cost(A: Array, B: Array, scale: rw.ScaleMode) -> Array:
    """(19, 19) form over [vec R_X, vec R_Y, 1] from (N, 4, 4) measurements with unit weights, the 1/2 included."""
    count = len(A)
    t_A = A[:, :3, 3] - A[:, :3, 3].mean(axis=0)  # moves t_Y alone, which is eliminated
    R_A, R_B, t_B = A[:, :3, :3], B[:, :3, :3], B[:, :3, 3]
    eye = np.broadcast_to(np.eye(3), (count, 3, 3))
    # Columns: t_X, t_Y, alpha, vec R_X, vec R_Y.
    M_t = np.zeros((count, 3, 25))
    M_t[:, :, 0:3], M_t[:, :, 3:6], M_t[:, :, 6] = R_A, -eye, t_A
    M_t[:, :, 16:] = -np.einsum("nj,ik->nijk", t_B, np.eye(3)).reshape(count, 3, 9)
    M_R = np.zeros((count, 9, 25))
    M_R[:, :, 7:16] = np.einsum("jl,nik->njilk", np.eye(3), R_A).reshape(count, 9, 9)
    M_R[:, :, 16:] = -np.einsum("nlj,ik->njilk", R_B, np.eye(3)).reshape(count, 9, 9)
    M = np.concatenate([M_t.reshape(-1, 25), M_R.reshape(-1, 25)])
    if scale == "known":  # alpha is the homogenising entry
        eliminated, rest = M[:, :6], M[:, np.r_[7:25, 6]]
    else:
        eliminated, rest = M[:, :7], np.pad(M[:, 7:], ((0, 0), (0, 1)))
    U, s, _ = np.linalg.svd(eliminated, full_matrices=False)
    U = U[:, s > 1e-12 * s[0]]
    rest = rest - U @ (U.T @ rest)  # what no translation or scale takes away
    return 0.5 * rest.T @ rest


def random_rotations(shape: tuple[int, ...], generator: np.random.Generator) -> Array:
    """Rotations (..., 3, 3), uniform on SO(3): the orthogonal factor of a Gaussian matrix, signs fixed."""
    Q, R = np.linalg.qr(generator.standard_normal((*shape, 3, 3)))
    Q = Q * np.sign(np.einsum("...ii->...i", R))[..., None, :]
    return Q * np.linalg.det(Q)[..., None, None]  # -Q has the other determinant in three dimensions


def exponential(w: Array) -> Array:
    """exp(w^) of (..., 3) vectors (Rodrigues)."""
    theta = np.linalg.norm(w, axis=-1)[..., None, None]
    W = hat(w)
    return np.eye(3) + np.sinc(theta / np.pi) * W + 0.5 * np.sinc(theta / (2.0 * np.pi)) ** 2 * (W @ W)


def hat(w: Array) -> Array:
    """w^ of (..., 3) vectors."""
    W = np.zeros((*w.shape, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return W - np.swapaxes(W, -1, -2)


def descend(Q: Array, R: Array, iterations: int = 300) -> Array:
    """Costs at the ends of Levenberg-Marquardt on f = x'Qx; Q (S, 19, 19), R (S, 2, 3, 3)."""

    def homogeneous(R: Array) -> Array:
        return np.concatenate([np.swapaxes(R, -1, -2).reshape(len(R), 18), np.ones((len(R), 1))], axis=1)

    def value(Q: Array, x: Array) -> Array:
        return np.einsum("si,sij,sj->s", x, Q, x)

    generators = hat(np.eye(3))
    cost = value(Q, homogeneous(R))
    damping = np.full(len(Q), 1e-3) * np.einsum("sii->s", Q)
    active = np.arange(len(Q))
    settled = np.zeros(len(Q), dtype=int)
    for _ in range(iterations):
        Q_now, R_now = Q[active], R[active]
        columns = np.swapaxes(R_now[:, :, None] @ generators, -1, -2).reshape(len(active), 2, 3, 9)  # vec(R e_k^)
        J = np.zeros((len(active), 19, 6))
        J[:, 0:9, 0:3], J[:, 9:18, 3:6] = np.swapaxes(columns[:, 0], -1, -2), np.swapaxes(columns[:, 1], -1, -2)
        gradient = np.einsum("sip,sij,sj->sp", J, Q_now, homogeneous(R_now))
        H = np.swapaxes(J, -1, -2) @ Q_now @ J
        step = -np.linalg.solve(H + damping[active, None, None] * np.eye(6), gradient[..., None])[..., 0]
        candidate = R_now @ exponential(step.reshape(-1, 2, 3))
        candidate = 1.5 * candidate - 0.5 * candidate @ np.swapaxes(candidate, -1, -2) @ candidate
        new = value(Q_now, homogeneous(candidate))
        better = new < cost[active]
        gain = np.where(better, cost[active] - new, 0.0)
        settled[active] = np.where(gain > 1e-13 * np.abs(cost[active]), 0, settled[active] + 1)
        R[active[better]] = candidate[better]
        cost[active[better]] = new[better]
        damping[active] = np.where(better, damping[active] / 5.0, damping[active] * 4.0)
        active = active[settled[active] < 12]
        if not len(active):
            break
    return cost


def rows_of(scale: rw.ScaleMode, starts: int) -> list[Row]:
    """Solve every pair alone and let the random starts try."""
    problem = rw.read_csv(utias_folder(), sigma=1.0, kappa=1.0)
    generator = np.random.default_rng(0)
    forms, costs, bounds, verdicts, optimal, allowed = [], [], [], [], [], []
    paths: Counter[str] = Counter()
    unproven: list[str] = []
    refused: list[str] = []
    start = time.perf_counter()
    for target, sensor in problem.pairs:
        alone = pair_alone(problem, target, sensor, scale)
        try:
            with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):  # counted below
                solution = rw.solve(alone)
        except rw.errors.ScaleError:
            refused.append(f"{target}-{sensor}")
            continue
        c = solution.certificate
        free = not solution.identifiability.is_unique
        verdicts.append(f"{c.status}{', shown free' if free and not c.is_optimal else ''}")
        if not (c.is_certified or free):
            unproven.append(f"{target}-{sensor} (gap {c.relative_gap:.1e})")
        paths[c.path] += 1
        optimal.append(c.is_optimal)
        allowed.append(BEATEN if c.is_certified else BEATEN + c.relative_gap)
        measured = problem.measurements(target, sensor)
        form = reduced_cost(measured.A, measured.B, scale)
        forms.append(form)
        x = np.append([T.matrix()[:3, :3].T.ravel() for T in (solution.X[target], solution.Y[sensor])], 1.0)
        costs.append(x @ form @ x)
        bounds.append(c.lower_bound)
    solving = time.perf_counter() - start
    Q = np.repeat(np.array(forms), starts, axis=0)
    start = time.perf_counter()
    ends = descend(Q, random_rotations((len(Q), 2), generator)).reshape(-1, starts)
    descending = time.perf_counter() - start
    cost = np.array(costs)
    best = ends.min(axis=1)
    below = (cost - best) / cost  # how far random starts come below the answer, relative
    excess = float(((np.array(bounds) - best) / cost)[optimal].max())
    beaten = np.array(optimal) & (below > allowed)
    found = ends <= (cost * (1.0 + 1e-6))[:, None]
    trapped = int((~found.all(axis=1)).sum())
    name = f"73 pairs alone, {scale} scale"
    return [
        Row(
            f"{name}: certified, or shown free",
            ", ".join(f"{count} {verdict}" for verdict, count in sorted(Counter(verdicts).items())),
            f"all {len(problem.pairs)}",
            not unproven,
        ),
        *([Row("    refused: the scale is negative at the optimum", ", ".join(refused))] if refused else []),
        *([Row("    neither", ", ".join(unproven))] if unproven else []),
        Row("    by path", ", ".join(f"{count} {path}" for path, count in paths.most_common())),
        Row(
            f"    proven optimal, yet beaten by {starts} random starts (by {BEATEN:g}, or the gap stated)",
            f"{beaten.sum()} (closest {below[optimal].max():.1e})",
            "0",
            not beaten.any(),
        ),
        Row("    largest excess of a bound over the lowest cost found, relative (moments' rounding)", f"{excess:.1e}"),
        Row("    of the random starts, those that end at the answer", f"{found.mean():.1%}"),
        Row("    pairs in which some random start ends elsewhere", f"{trapped}"),
        Row("    seconds for all solves; for all random starts", f"{solving:.2f}; {descending:.2f}"),
    ]


def rows(starts: int, scale: Sequence[rw.ScaleMode]) -> list[Row]:
    """Every scale mode."""
    return [row for each in scale for row in rows_of(each, starts)]


if __name__ == "__main__":
    run_script("The real dataset's 73 pairs, each alone", rows, starts=100, scale=("known", "shared"))
