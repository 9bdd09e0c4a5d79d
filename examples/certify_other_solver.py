"""Somebody else's calibration, certified; and made optimal where it is not.

    python examples/certify_other_solver.py

The other solver is OpenCV's closed form ``calibrateRobotWorldHandEye`` where OpenCV 4 is installed, otherwise the same
idea in a few lines: rotations first, then translations that fit them. ``rw.certify`` says how far above the optimum
any such answer can be, ``rw.solve(method="local", initial=...)`` goes down from it, and the picture compares both.
"""

from __future__ import annotations

import numpy as np
from figures import BLUE, VERMILLION, arguments_of, plain, save
from matplotlib.figure import Figure

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general

try:
    import cv2

    opencv_closed_form = getattr(cv2, "calibrateRobotWorldHandEye", None)  # version 5 has dropped it
except ImportError:
    opencv_closed_form = None


def nearest_rotation(M: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(M * np.sign(np.linalg.det(M)))
    return U @ Vt


def closed_form(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """X and Y of A X = Y B (Shah 2013): R_X, R_Y from the SVD of sum R_B (x) R_A, then translations."""
    if opencv_closed_form is not None:
        blocks = [list(part) for T in (A, B) for part in (T[:, :3, :3], T[:, :3, 3:])]
        R_X, t_X, R_Y, t_Y = opencv_closed_form(*blocks)
    else:
        K = sum(np.kron(R_B, R_A) for R_A, R_B in zip(A[:, :3, :3], B[:, :3, :3], strict=True))
        U, _, Vt = np.linalg.svd(K)  # K vec(R_X) = N vec(R_Y) without noise
        R_X, R_Y = (nearest_rotation(v.reshape(3, 3).T) for v in (Vt[0], U[:, 0]))
        rows = np.concatenate([A[:, :3, :3], -np.broadcast_to(np.eye(3), (len(A), 3, 3))], axis=2).reshape(-1, 6)
        right = (B[:, :3, 3] @ R_Y.T - A[:, :3, 3]).ravel()
        t_X, t_Y = np.split(np.linalg.lstsq(rows, right)[0], 2)
    X, Y = np.eye(4), np.eye(4)
    X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3] = R_X, np.ravel(t_X), R_Y, np.ravel(t_Y)
    return X, Y


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--runs", type=int, default=200, help="for the picture (%(default)s)")
    arguments = parser.parse_args()
    solver = "OpenCV" if opencv_closed_form is not None else "closed form"
    errors, excess = [], []
    for seed in range(arguments.runs):
        simulation = general(1, 1, seed=seed, number_of_measurements=20, noise=Noise(sigma_m=0.01, kappa=125.0))
        problem = simulation.problem
        measured = problem.measurements("target0", "sensor0")
        X, Y = closed_form(measured.A, measured.B)
        theirs = rw.certify(problem, X={"target0": X}, Y={"sensor0": Y}, scale=1.0)
        solution = rw.solve(problem, method="local", initial=({"target0": X}, {"sensor0": Y}, 1.0))
        if seed == 0:
            print(f"{solver}, certified: {theirs}")
            print(f"After local descent: {solution.certificate}")
        ours = simulation.errors(solution).X["target0"].translation_mm
        errors.append((1e3 * np.linalg.norm(X[:3, 3] - simulation.X["target0"][:3, 3]), ours))
        excess.append(theirs.cost / theirs.lower_bound)
    their_errors, our_errors = np.array(errors).T
    print(f"Median of {solver}'s cost over the proven bound: {np.median(excess):.2f}")
    print(f"Median error of t_X: {np.median(their_errors):.2f} mm, ours {np.median(our_errors):.2f} mm")

    figure = Figure(figsize=(8.6, 3.9), layout="constrained")
    cost, error = figure.subplots(1, 2)
    cost.hist(excess, bins=np.geomspace(1.0, 1.05 * max(excess), 30), color=VERMILLION)
    cost.set(xscale="log", xticks=[1, 2, 5, 10, 20], xlabel=f"{solver}'s cost over the proven bound", ylabel="runs")
    cost.set_xticklabels(["1 (optimal)", "2", "5", "10", "20"])
    cost.minorticks_off()
    error.plot(their_errors, our_errors, "o", color=BLUE, markersize=3, alpha=0.6)
    limit = (0.8 * min(their_errors.min(), our_errors.min()), 1.25 * max(their_errors.max(), our_errors.max()))
    error.plot(limit, limit, color="0.6", linewidth=1.0)
    error.set(xscale="log", yscale="log", xlim=limit, ylim=limit, aspect="equal")
    error.set(xlabel=f"{solver}'s error of t_X (mm)", ylabel="error after descent (mm)")
    error.set(xticks=(ticks := [1, 2, 5, 10, 20, 50]), yticks=ticks, xticklabels=ticks, yticklabels=ticks)
    error.minorticks_off()
    for axes in (cost, error):
        plain(axes)
    save(figure, arguments.save, "certify_other_solver.png")


if __name__ == "__main__":
    main()
