"""How wide is the neighbourhood of exact data in which the relaxation is tight (Proposition 7 of the RWHEC paper)?

    python examples/tightness_neighbourhood.py [--problems 60]

Each problem is one X and one Y with exact measurements, and one random perturbation of each of them: a rotation by the
same angle for all about axes of their own, and a translation of 1 m a radian. The angle grows until optimality
cannot be proven any more: first with the constraints R'R = I alone (then their multipliers are unique, and the dual
certificate at the answer decides), then with the redundant ones too (R R' = I and R_a x R_b = R_c, eq. 50).
"""

from __future__ import annotations

import warnings

import numpy as np
from figures import BLUE, GREEN, VERMILLION, arguments_of, plain, save
from matplotlib.figure import Figure

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Motion, general
from gtsam_rwhec.solver import Multipliers

CASES = {
    "5 measurements": (5, Motion("general"), VERMILLION),
    "20 measurements": (20, Motion("general"), BLUE),
    "20 measurements, nearly planar": (20, Motion("planar", wobble_rad=0.05, wobble_m=0.05), GREEN),
}


def tight(A: np.ndarray, B: np.ndarray, axes: np.ndarray, shifts: np.ndarray, radians: float) -> tuple[bool, bool]:
    """Whether the perturbed problem is tight with R'R = I alone, and with all constraints."""
    W = np.zeros((len(axes), 3, 3))
    W[:, [2, 0, 1], [1, 2, 0]] = axes
    W -= W.transpose(0, 2, 1)
    perturbed = B.copy()
    perturbed[:, :3, :3] = B[:, :3, :3] @ (np.eye(3) + np.sin(radians) * W + (1.0 - np.cos(radians)) * (W @ W))
    perturbed[:, :3, 3] += radians * shifts
    problem = rw.Problem(scale="known", keep_measurements=False)
    problem.add("target", "sensor", A, perturbed, sigma=1.0, kappa=1.0)
    c = rw.solve(problem).certificate
    return c.is_optimal and c.path.multipliers is Multipliers.KKT, c.is_optimal


def widths(measurements: int, motion: Motion, degrees: np.ndarray, seed: int) -> list[float]:
    """The smallest angle at which one problem is not tight, without and with redundant constraints; or infinity."""
    simulation = general(1, 1, seed=seed, motion=motion, number_of_measurements=measurements)
    exact = simulation.problem.measurements("target0", "sensor0")
    generator = np.random.default_rng(seed)
    axes, shifts = generator.standard_normal((2, measurements, 3))
    axes, shifts = (v / np.linalg.norm(v, axis=1)[:, None] for v in (axes, shifts))
    lost = [np.inf, np.inf]
    for angle in degrees:
        for i, still in enumerate(tight(exact.A, exact.B, axes, shifts, np.radians(angle))):
            if not still:
                lost[i] = min(lost[i], angle)
        if np.isfinite(lost[1]):
            break
    return lost


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--problems", type=int, default=60, help="of each kind (%(default)s)")
    parser.add_argument("--step", type=float, default=3.0, help="degrees between angles tried (%(default)s)")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", rw.errors.RwhecWarning)  # what is not proven is counted
    degrees = np.arange(arguments.step, 180.0 + 1e-9, arguments.step)
    figure = Figure(figsize=(7.4, 5.0), layout="constrained")
    panel = figure.subplots()
    for label, (measurements, motion, colour) in CASES.items():
        lost = np.array([widths(measurements, motion, degrees, seed) for seed in range(arguments.problems)])
        for values, style, which in ((lost[:, 0], "--", "R'R = I alone"), (lost[:, 1], "-", "all constraints")):
            share = 100.0 * (values[:, None] > degrees).mean(axis=0)
            print(
                f"{label}, {which}: the first loss at {values.min():g} degrees, half of the problems by "
                f"{np.median(values):g}, {100.0 * np.isinf(values).mean():.0f} % tight at every angle"
            )
            panel.step(np.r_[0.0, degrees], np.r_[100.0, share], style, where="post", color=colour)
        panel.plot([], [], color=colour, label=label)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    styles = [panel.plot([], [], style, color="0.3")[0] for style in ("--", "-")]
    panel.legend(styles, ["with R'R = I alone", "with redundant constraints"], frameon=False, loc="lower left")
    panel.set(xlim=(0, 180), ylim=(0, 103), xticks=range(0, 181, 30))
    panel.set(xlabel="rotation error of each measurement (degrees)", ylabel="problems tight up to there (%)")
    panel.grid(color="0.92")
    plain(panel)
    save(figure, arguments.save, "tightness_neighbourhood.png")


if __name__ == "__main__":
    main()
