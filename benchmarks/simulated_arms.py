"""Arms that are not built as their controllers believe, and noise on poses: what the simulated benchmarks share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rwhec_factors.se3 import pose

from gtsam_rwhec.simulate.simulated_noise import rotations_of_vectors

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Arm:
    """A serial arm by its Denavit-Hartenberg parameters, each (6,): lengths and offsets in m, angles in rad."""

    length_m: FloatArray
    offset_m: FloatArray
    twist_rad: FloatArray
    zero_rad: FloatArray

    def hand(self, joints_rad: FloatArray) -> FloatArray:
        """T_base_hand (N, 4, 4) at joint angles (N, 6)."""
        T = np.tile(np.eye(4), (len(joints_rad), 1, 1))
        for i, angles in enumerate((joints_rad + self.zero_rad).T):
            c, s = np.cos(angles), np.sin(angles)
            ca, sa = np.cos(self.twist_rad[i]), np.sin(self.twist_rad[i])
            link = np.zeros_like(T)
            link[:, 0] = np.stack([c, -s * ca, s * sa, self.length_m[i] * c], axis=1)
            link[:, 1] = np.stack([s, c * ca, -c * sa, self.length_m[i] * s], axis=1)
            link[:, 2] = [0.0, sa, ca, self.offset_m[i]]
            link[:, 3, 3] = 1.0
            T = T @ link
        return T

    def misbuilt(self, angles_rad: float, lengths_m: float, generator: np.random.Generator) -> Arm:
        """The arm as it was built: every angle and length is off, with these standard deviations."""
        angles = generator.normal(0.0, angles_rad, (2, 6))
        lengths = generator.normal(0.0, lengths_m, (2, 6))
        return Arm(
            self.length_m + lengths[0],
            self.offset_m + lengths[1],
            self.twist_rad + angles[0],
            self.zero_rad + angles[1],
        )


#: Six joints and a reach of 0.9 m, as many arms of a laboratory have.
ARM = Arm(
    length_m=np.array([0.0, -0.425, -0.392, 0.0, 0.0, 0.0]),
    offset_m=np.array([0.163, 0.0, 0.0, 0.133, 0.1, 0.1]),
    twist_rad=np.array([0.5, 0.0, 0.0, 0.5, -0.5, 0.0]) * np.pi,
    zero_rad=np.zeros(6),
)
#: Elbow bent, hand over the table.
BENT_RAD = np.radians([0.0, -70.0, 100.0, -120.0, -90.0, 0.0])


def moved_by(poses: FloatArray, xi: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) with R Exp(omega) and t + eps, of xi = [omega (rad), eps (m)] (N, 6)."""
    return pose(poses[:, :3, :3] @ rotations_of_vectors(xi[:, :3]), poses[:, :3, 3] + xi[:, 3:])


def white(count: int, rotation_rad: float, translation_m: float, generator: np.random.Generator) -> FloatArray:
    """Gaussian xi (N, 6), independent of each other."""
    return generator.standard_normal((count, 6)) * np.repeat([rotation_rad, translation_m], 3)
