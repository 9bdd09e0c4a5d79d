"""Simulated problems of every scale mode, and poses as matrices."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from gtsam_rwhec.simulate import Noise, Simulation, general

NOISE = Noise(0.02, 300.0)
MODES: dict[str, dict[str, Any]] = {
    "known": dict(scale="known"),
    "shared": dict(scale="shared"),
    "per_target": dict(scale="per_target", known_sizes=("target1",)),
}


def simulated(mode: str, seed: int = 1, **options: Any) -> Simulation:
    return general(2, 2, seed=seed, **{"noise": NOISE, "number_of_measurements": 12, **MODES[mode], **options})


def matrices(poses: Any) -> dict[str, np.ndarray]:
    return {name: T.matrix() if isinstance(T, gtsam.Pose3) else T for name, T in poses.items()}
