"""Where boards are in front of their cameras: geometries that determine intrinsics well, hardly, or not at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rwhec_factors import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """How boards are drawn in front of a camera.

    Attributes
    ----------
    depth_m : (float, float)
        Mean and standard deviation of the depth of the board's middle.
    tilt : float
        Standard deviation of the board's tilt about each of its axes, radians; 0: it is fronto-parallel.
    aim, spread : (float, float) each
        Where the board's middle is: normalised coordinates, mean and standard deviation.
    """

    depth_m: tuple[float, float] = (1.5, 0.15)
    tilt: float = 0.35
    aim: tuple[float, float] = (0.0, 0.0)
    spread: tuple[float, float] = (0.1, 0.1)

    def __call__(self, T_base_camera: Array, rng: np.random.Generator) -> Array:
        """Draw T_base_board: the board's z axis to the camera, tilted, and turned about it by any angle."""
        x = np.array(self.aim) + rng.normal(size=2) * self.spread
        depth = self.depth_m[0] + self.depth_m[1] * rng.normal()
        tilt = np.array([*rng.normal(scale=self.tilt, size=2), 0.0]) if self.tilt else np.zeros(3)
        turn = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
        R = np.diag([1.0, -1.0, -1.0]) @ se3.expmap(np.array([[*tilt, 0, 0, 0], [*turn, 0, 0, 0]]))[:, :3, :3]
        R = R[0] @ np.diag([1.0, -1.0, -1.0]) @ R[1]
        T: Array = T_base_camera @ se3.pose(R, depth * np.array([*x, 1.0]))
        return T


#: Small tilts, at one place in the middle of the image: intrinsics are hardly told.
WEAK = Placement(depth_m=(2.0, 0.1), tilt=0.1, spread=(0.05, 0.05))
#: What determines no intrinsics, or only some. Boards that are fronto-parallel to the last milliradian determine no
#: poses either.
UNDETERMINED = {
    "nearly fronto-parallel": Placement(tilt=0.005),
    "nearly fronto-parallel at one depth": Placement(depth_m=(1.5, 0.0), tilt=0.005),
    "at one depth": Placement(depth_m=(1.5, 0.0)),
    "in a corner of the image": Placement(depth_m=(2.5, 0.2), aim=(0.5, 0.28), spread=(0.02, 0.015)),
}
