"""Figure 2 of the DQ paper: the two multipliers' plane, the curves lambda_i(mu) and f_i(mu).

    python examples/papers/dq_figure_2.py

(a) The four eigenvalues of Z(mu) of a typical problem; the answer is the maximum of the smallest. (b) A problem, looked
for among random ones, whose number of real mu goes 8, 6, 4, 6, 4, 2, 0 as lambda grows, and (c) where two of its
curves come nearest: of all found, the problem with the nearest. (d) f_i = q_i . q_i' of (a): f_0 grows, and its only
root is mu*. ``--runs``: how many random problems are looked at for (b).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from dq_scenarios import Array, sample
from dq_sweep import requests
from in_processes import in_processes
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from reports import BLUE, GREEN, ORANGE, VERMILLION, arguments_of, plain, save_picture, save_text

from gtsam_rwhec.methods import DualQuaternionCost
from gtsam_rwhec.methods.dq_saddle import minimum

COLOURS = (BLUE, ORANGE, GREEN, VERMILLION)
WANTED = (8, 6, 4, 6, 4, 2, 0)
#: Degrees, metres and motions of (a), and of the problems among which (b) is looked for.
TYPICAL, NOISY = (30.0, 0.3, 10), (30.0, 0.5, 6)
CHUNK = 50


@dataclass(frozen=True)
class Curves:
    """Of one problem, over mu (n,), 1/m: ``lambdas`` and ``f`` (n, 4), ``best`` = mu*, in the cost's units."""

    mu: Array
    lambdas: Array
    f: Array
    best: float


def problem(seed: np.random.SeedSequence, degrees: float, metres: float, motions: int) -> DualQuaternionCost:
    """A random problem's matrices, alpha = 1/m."""
    rng = np.random.default_rng(seed)
    drawn = sample("Random", rng, motions, np.radians(degrees), metres, steps=motions)
    cost: DualQuaternionCost = requests(drawn, [1.0])[0].cost
    return cost


def curves(cost: DualQuaternionCost, low: float, high: float, points: int = 2001) -> Curves:
    """Eigenvalues of Z(mu) (eq. 12) and f_i = q_i'(mu Z2 - Z1 / 2) q_i (Algorithm 1)."""
    mu = np.linspace(low, high, points)
    derivative = mu[:, None, None] * cost.Z2 - 0.5 * cost.Z1
    values, vectors = np.linalg.eigh(cost.Z0 + mu[:, None, None] * (cost.Z1 - mu[:, None, None] * cost.Z2))
    f = np.einsum("nia,nij,nja->na", vectors, derivative, vectors)
    return Curves(mu, values, f, minimum(cost).mu)


def whole(cost: DualQuaternionCost, points: int = 2001) -> Curves:
    """From where every curve has come from below to where every one has gone there again."""
    # lambda = 0: (Z0 + mu Z1 - mu^2 Z2) q = 0, eight real mu (Section 3.1.2).
    M, zero = np.linalg.inv(cost.Z2), np.zeros((4, 4))
    companion = np.block([[zero, np.eye(4)], [M @ cost.Z0, M @ cost.Z1]])
    mu = np.linalg.eigvals(companion).real
    margin = 0.05 * np.ptp(mu)
    return curves(cost, mu.min() - margin, mu.max() + margin, points)


def numbers_of_roots(lambdas: Array) -> tuple[int, ...]:
    """How many real mu there are, as lambda grows from 0: two fewer at a maximum of a curve, two more at a minimum."""
    change = np.diff(lambdas, axis=0)
    maxima = (change[:-1] > 0.0) & (change[1:] <= 0.0)
    minima = (change[:-1] < 0.0) & (change[1:] >= 0.0)
    at = np.concatenate([lambdas[1:-1][maxima], lambdas[1:-1][minima]])
    steps = np.concatenate([np.full(maxima.sum(), -2), np.full(minima.sum(), 2)])[np.argsort(at)]
    return (8, *(8 + np.cumsum(steps)).tolist())


def nearest(lambdas: Array) -> tuple[float, int, int]:
    """Smallest gap between neighbouring curves above lambda = 0; its place in mu, and the lower curve."""
    gaps = np.where(lambdas[:, :-1] > 0.0, np.diff(lambdas, axis=1), np.inf)
    at, pair = np.unravel_index(int(gaps.argmin()), gaps.shape)
    return float(gaps[at, pair]), int(at), int(pair)


def wanted(seeds: list[np.random.SeedSequence]) -> list[float]:
    """Of each problem the nearest that two curves come, relative to the largest lambda; infinity if not wanted."""
    near = []
    for seed in seeds:
        lambdas = whole(problem(seed, *NOISY), 801).lambdas
        is_wanted = numbers_of_roots(lambdas) == WANTED
        near.append(nearest(lambdas)[0] / float(lambdas.max()) if is_wanted else np.inf)
    return near


def draw(axes: Axes, found: Curves, of: Array, name: str) -> None:
    """Four curves, and mu*."""
    for i, colour in enumerate(COLOURS):
        axes.plot(found.mu, of[:, i], color=colour, label=rf"${name}_{i}$")
    axes.axvline(found.best, color="0.2", linestyle="--", linewidth=1.0, label=r"$\mu^*$")
    axes.set_xlabel(r"$\mu$ (1/m)")
    axes.grid(color="0.92")
    plain(axes)


def picture(typical: DualQuaternionCost, rare: DualQuaternionCost) -> tuple[Figure, float, float]:
    """The four panels; lambda_0(mu*) of the typical problem and the nearest two curves of the rare one."""
    figure = Figure(figsize=(9.5, 7.0), layout="constrained")
    (a, b), (c, d) = figure.subplots(2, 2)
    first, second = whole(typical), whole(rare, 20001)
    top = float(first.lambdas.max())
    draw(a, first, first.lambdas, r"\lambda")
    a.set(ylim=(-0.3 * top, 1.05 * top), title="(a) the answer: the maximum of the smallest")
    draw(b, second, second.lambdas, r"\lambda")
    top = float(second.lambdas.max())
    b.set(ylim=(-0.3 * top, 1.05 * top), title="(b) 8, 6, 4, 6, 4, 2, 0 real $\\mu$ as $\\lambda$ grows")
    gap, at, pair = nearest(second.lambdas)
    middle = float(second.lambdas[at, pair : pair + 2].mean())
    # So narrow that the gap shows; the slope that both have there is taken off, or it would hide it.
    bend = np.gradient(np.gradient(second.lambdas[:, pair + 1] - second.lambdas[:, pair], second.mu), second.mu)[at]
    width = 8.0 * float(np.sqrt(gap / bend)) if bend > 0.0 else 0.01 * float(np.ptp(second.mu))
    centre = float(second.mu[at])
    near = curves(rare, centre - width, centre + width)
    slope = float(np.gradient(second.lambdas[:, pair : pair + 2].mean(axis=1), second.mu)[at])
    for i in (pair, pair + 1):
        straight = middle + slope * (near.mu - centre)
        c.plot(near.mu, near.lambdas[:, i] - straight, color=COLOURS[i], label=rf"$\lambda_{i}$")
    c.set_title(rf"(c) of (b): $\lambda_{pair}$ and $\lambda_{pair + 1}$ come near and part")
    c.set_xlabel(r"$\mu$ (1/m)")
    c.grid(color="0.92")
    plain(c)
    b.plot(second.mu[at], middle, "o", markersize=16, markerfacecolor="none", color="0.2")
    draw(d, first, first.f, "f")
    top = 2.0 * float(np.abs(first.f[:, 1:]).max())
    d.set_ylim(-top, top)
    d.axhline(0.0, color="0.6", linewidth=0.8)
    d.set_title("(d) of (a): $f_0$ has its only root at the answer")
    for axes, label in ((a, r"$\lambda$"), (b, r"$\lambda$"), (c, r"$\lambda$ less its common slope"), (d, "$f$ (m)")):
        axes.set_ylabel(label)
        axes.title.set_size(10)
        axes.legend(
            frameon=False, fontsize=8, loc="upper left" if axes is d else "best" if axes is c else "upper right"
        )
    return figure, float(first.lambdas[:, 0].max()), gap


def main() -> None:
    arguments = arguments_of(__doc__, 4000, "random problems looked at for (b)").parse_args()
    typical, others = np.random.SeedSequence(arguments.seed).spawn(2)
    seeds = others.spawn(arguments.runs)
    calls = [(seeds[first : first + CHUNK],) for first in range(0, arguments.runs, CHUNK)]
    near = np.concatenate(in_processes(wanted, calls, arguments.workers, f"{CHUNK} problems each"))
    place = int(near.argmin())
    rare = problem(seeds[place], *NOISY)
    figure, answer, gap = picture(problem(typical, *TYPICAL), rare)
    text = (
        "# DQ paper, Figure 2\n\n"
        f"(a) lambda_0(mu*) = {answer:.6g}, the cost of the answer.\n\n"
        f"(b) {np.isfinite(near).sum()} of {len(near)} random problems have {', '.join(map(str, WANTED))} real mu as "
        f"lambda grows. The one shown is number {place}: "
        f"{', '.join(map(str, numbers_of_roots(whole(rare, 20001).lambdas)))}.\n\n"
        f"(c) Its curves' nearest approach: {gap:.3g}; they do not meet.\n"
    )
    save_text(text, arguments.output, "dq_figure_2.md")
    save_picture(figure, arguments.output, "dq_figure_2.png")


if __name__ == "__main__":
    main()
