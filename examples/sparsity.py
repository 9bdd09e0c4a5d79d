"""A star costs time linear in its leaves, whichever side is the star (RWHEC paper, Appendix B and Figure 10).

    python examples/sparsity.py [--leaves 2 4 ... 1024]

Eight cameras that see one target, or one camera that sees eight targets: on the left the entries of Q', the cost with
translations and scale eliminated. With many Y the elimination couples all leaves with one another (vermillion); with
many X it couples no two frames that were not coupled before, and fills the one Y's own block alone. This library
follows the graph of all variables where frames are many, so on the right both stars take time linear in the leaves.
"""

from __future__ import annotations

import time
import warnings

import numpy as np
from figures import BLUE, GREY, VERMILLION, arguments_of, plain, save
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import parts_of

NOISE = Noise(sigma_m=0.01, kappa=1e3)


def star(leaves: int, side: str) -> rw.Problem:
    """Leaves on one side ("X": targets, "Y": sensors), one frame on the other, one unknown scale."""
    targets, sensors = (leaves, 1) if side == "X" else (1, leaves)
    return general(targets, sensors, seed=1, noise=NOISE, scale="shared", keep_measurements=False).problem


def draw_fill(axes: Axes, side: str) -> None:
    """Entries of Q': there before translations and the scale were eliminated, or filled by that."""
    (part,) = parts_of(star(8, side))
    forms = PartForm.of(part)
    at = np.r_[(13 * np.arange(len(part.free))[:, None] + np.arange(4, 13)).ravel(), 13 * len(part.free) + 1]
    before = np.abs(forms.full.dense()[np.ix_(at, at)]) > 1e-9 * forms.reduced.magnitude
    after = np.abs(forms.reduced.Q) > 1e-9 * forms.reduced.magnitude
    picture = np.where(before, 1, np.where(after, 2, 0))
    axes.imshow(picture, cmap=ListedColormap(["white", BLUE, VERMILLION]), vmin=0, vmax=2, interpolation="nearest")
    borders = np.arange(9, len(picture), 9) - 0.5
    axes.set_xticks(borders, labels=[])
    axes.set_yticks(borders, labels=[])
    axes.grid(color="0.85", linewidth=0.6)
    axes.tick_params(length=0)
    axes.set_title(f"8 {side}, 1 {'Y' if side == 'X' else 'X'}: {after.mean():.0%} filled", fontsize=10)
    print(
        f"8 {side}: the elimination fills {before.mean():.1%} of Q' up to {after.mean():.1%}, and brings the pairs of "
        f"frames that are coupled from {coupled_pairs(before)} to {coupled_pairs(after)}"
    )


def coupled_pairs(entries: Array) -> int:
    """How many pairs of frames share an entry; the last row and column is that of the homogenizing variable."""
    frames = len(entries) // 9
    blocks = entries[: 9 * frames, : 9 * frames].reshape(frames, 9, frames, 9).any(axis=(1, 3))
    return int(np.triu(blocks, 1).sum())


def milliseconds(problem: rw.Problem) -> float:
    """Of ``solve``, identifiability included: the fastest of five."""
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        rw.solve(problem)
        seconds.append(time.perf_counter() - start)
    return 1e3 * min(seconds)


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--leaves", type=int, nargs="+", default=[2, 4, 8, 16, 32, 64, 128, 256, 512, 1024])
    arguments = parser.parse_args()
    warnings.simplefilter("error", rw.errors.NotCertifiedWarning)
    figure = Figure(figsize=(11.0, 3.9), layout="constrained")
    many_y, many_x, times = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.35))
    draw_fill(many_y, "Y")
    draw_fill(many_x, "X")
    for side, other, colour, marker in (("Y", "X", VERMILLION, "s"), ("X", "Y", BLUE, "o")):
        taken = [milliseconds(star(leaves, side)) for leaves in arguments.leaves]
        print(f"many {side}: " + ", ".join(f"{n} {t:.3g} ms" for n, t in zip(arguments.leaves, taken, strict=True)))
        times.loglog(arguments.leaves, taken, color=colour, marker=marker, label=f"many {side}, one {other}")
    steep = np.array(arguments.leaves[-2:])
    times.loglog(steep, 0.6 * taken[-1] * steep / steep[-1], ":", color=GREY, label="linear")
    times.set(xlabel="leaves of the star", ylabel="solve (ms)")
    times.grid(color="0.92")
    plain(times)
    times.legend(frameon=False)
    for label, colour in (("there from the start", BLUE), ("filled by eliminating t and scale", VERMILLION)):
        many_y.plot([], [], "s", color=colour, label=label)
    figure.legend(*many_y.get_legend_handles_labels(), loc="outside lower left", ncols=2, frameon=False)
    save(figure, arguments.save, "sparsity.png")


if __name__ == "__main__":
    main()
