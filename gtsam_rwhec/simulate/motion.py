"""Random carrier poses, with as much or as little excitation as a test asks for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from rwhec_factors.se3 import pose

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate.noise import Seed
from gtsam_rwhec.simulate.transforms import random_directions, rotations_of_vectors

MotionKind = Literal["general", "planar", "single_axis", "none"]


@dataclass(frozen=True, slots=True)
class Motion:
    """How a carrier moves. Each pose is drawn independently.

    Attributes
    ----------
    kind : "general", "planar", "single_axis" or "none"
        ``"general"``: rotations about all axes, translations in a cube. ``"planar"``: rotations about one axis,
        translations perpendicular to it. ``"single_axis"``: rotations about one axis, translations in a cube.
        ``"none"``: no rotation, translations in a cube.
    axis : tuple of three floats
        Rotation axis of planar and single-axis motion, in the frame that does not move, of any length. The default z
        suits a wheeled robot's floor.
    max_angle_rad : float
        Rotation angles are uniform in [-max_angle_rad, max_angle_rad]. The default pi is the most there is; small
        values give poorly excited problems.
    extent_m : float
        Half-width of the cube, metres. The default of one metre is a robot arm's reach.
    wobble_rad, wobble_m : float
        Standard deviations of an added Gaussian motion, about and along each axis, for example for "nearly planar"
        motion. The default 0 keeps the kind exact.

    Raises
    ------
    OptionError
        For an unknown kind, a zero axis, or a size that is negative or not finite.
    """

    kind: MotionKind = "general"
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    max_angle_rad: float = math.pi
    extent_m: float = 1.0
    wobble_rad: float = 0.0
    wobble_m: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(MotionKind):
            raise OptionError(f"Motion: kind is {self.kind!r}; choose one of {', '.join(get_args(MotionKind))}")
        length = math.hypot(*self.axis)
        if not (math.isfinite(length) and length > 0.0):
            raise OptionError(f"Motion: axis is {self.axis}, but must be finite and not zero")
        for name in ("max_angle_rad", "extent_m", "wobble_rad", "wobble_m"):
            size = getattr(self, name)
            if not (math.isfinite(size) and size >= 0.0):
                raise OptionError(f"Motion: {name} is {size!r}, but must be finite and not negative")


def carrier_poses(motion: Motion, count: int, seed: Seed) -> Array:
    """Draw ``count`` poses T_world_carrier (N, 4, 4), metres; ``seed`` is a seed or a generator to draw from."""
    generator = np.random.default_rng(seed)
    axis = np.array(motion.axis) / math.hypot(*motion.axis)
    if motion.kind == "general":
        axes = random_directions(count, generator)
    else:
        axes = np.tile(axis if motion.kind != "none" else np.zeros(3), (count, 1))
    angles = generator.uniform(-motion.max_angle_rad, motion.max_angle_rad, (count, 1))
    rotations = rotations_of_vectors(angles * axes)
    translations = generator.uniform(-motion.extent_m, motion.extent_m, (count, 3))
    if motion.kind == "planar":
        translations -= np.outer(translations @ axis, axis)
    if motion.wobble_rad > 0.0:
        rotations = rotations @ rotations_of_vectors(generator.normal(0.0, motion.wobble_rad, (count, 3)))
    translations = translations + generator.normal(0.0, motion.wobble_m, (count, 3))
    return pose(rotations, translations)
