"""Rows of small problems, as the noise model has them."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.noise_rows import Instants, Rows
from gtsam_rwhec.fitting.pair_data import PairData
from gtsam_rwhec.fitting.unknowns import Variables
from gtsam_rwhec.problem.knowledge import ScaleMode


def random_poses(chance: np.random.Generator, count: int, angle: float = 1.0, length: float = 0.5) -> np.ndarray:
    return se3.expmap(np.hstack([angle * chance.normal(size=(count, 3)), length * chance.normal(size=(count, 3))]))


def problem_of(
    targets: int = 1, sensors: int = 1, count: int = 12, *,
    seed: int = 0, scale: ScaleMode = "known", shared: bool = True, missing: int = 0,
) -> rw.Problem:  # fmt: skip
    """Every sensor sees every target from the same carrier poses (``shared``), or from poses of its own.

    The first pair has no measurements at the last ``missing`` poses.
    """
    chance = np.random.default_rng(seed)
    problem = rw.Problem(scale=scale)
    X, Y = random_poses(chance, targets), random_poses(chance, sensors)
    A = random_poses(chance, count)
    for i in range(targets):
        for j in range(sensors):
            if not shared:
                A = random_poses(chance, count)
            B = np.linalg.inv(Y[j]) @ A @ X[i] @ random_poses(chance, count, 0.01, 0.004)
            kept = slice(0, count if i or j else count - missing)
            stamps = np.arange(count) * 100_000_000
            problem.add(f"tag_{i}", f"cam_{j}", A[kept], B[kept], stamps_ns=stamps[kept])
    return problem


def rows_of(problem: rw.Problem) -> tuple[Rows, list[PairData], Variables, JointCovariance]:
    """The rows at the certified answer."""
    variables = Variables.of(problem, ())
    data = [PairData.of(problem, pair, RefineOptions(), None) for pair in problem.pairs]
    size = sum(unknown.dimension for unknown in variables.unknowns)
    layout = JointCovariance.of(variables.unknowns, np.eye(size), np.zeros((size, 0)), np.ones(size))
    state = variables.start(rw.solve(problem))
    return Rows.of(data, variables, state, layout, Instants.of(data)), data, variables, layout
