"""Random carrier poses with as much or as little excitation as a test asks for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.simulate.noise import Seed
from gtsam_rwhec.simulate.transforms import FloatArray, pose, random_directions, rotations_of_vectors

MotionKind = Literal["general", "planar", "single_axis", "none"]


@dataclass(frozen=True, slots=True)
class Motion:
    """How a carrier moves; every pose is drawn on its own.

    Parameters
    ----------
    kind
        ``"general"``: rotations about all axes, translations in a cube. ``"planar"``: rotations about one axis,
        translations across it. ``"single_axis"``: rotations about one axis, translations in a cube. ``"none"``: no
        rotation, translations in a cube.
    axis
        Rotation axis of planar and single-axis motion, in the frame that does not move; any length. z by default: the
        floor of a wheeled robot.
    max_angle_rad
        Rotation angles are uniform in [-max_angle_rad, max_angle_rad]; pi by default, the most that there is. Small
        values give poorly excited problems.
    extent_m
        Half-width of the cube, metres. One metre by default: a robot arm's reach.
    wobble_rad, wobble_m
        Standard deviations of a general Gaussian motion on top, about and along each axis: "nearly planar" and the
        like. None by default, so that the kind is exact.

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
        for name, size in (
            ("max_angle_rad", self.max_angle_rad),
            ("extent_m", self.extent_m),
            ("wobble_rad", self.wobble_rad),
            ("wobble_m", self.wobble_m),
        ):
            if not (math.isfinite(size) and size >= 0.0):
                raise OptionError(f"Motion: {name} is {size!r}, but must be finite and not negative")


def carrier_poses(motion: Motion, count: int, seed: Seed) -> FloatArray:
    """Draw poses T_world_carrier.

    Parameters
    ----------
    motion
        The kind and size of the motion.
    count
        Number of poses N.
    seed
        Seed, or a generator to draw from.

    Returns
    -------
    (N, 4, 4) poses, metres.
    """
    generator = np.random.default_rng(seed)
    axis = np.array(motion.axis) / math.hypot(*motion.axis)
    if motion.kind == "general":
        axes = random_directions(count, generator)
    elif motion.kind == "none":
        axes = np.zeros((count, 3))
    else:
        axes = np.broadcast_to(axis, (count, 3))
    angles = generator.uniform(-motion.max_angle_rad, motion.max_angle_rad, (count, 1))
    rotations = rotations_of_vectors(angles * axes)
    translations = generator.uniform(-motion.extent_m, motion.extent_m, (count, 3))
    if motion.kind == "planar":
        translations -= np.outer(translations @ axis, axis)
    if motion.wobble_rad > 0.0:
        rotations = rotations @ rotations_of_vectors(generator.normal(0.0, motion.wobble_rad, (count, 3)))
    translations = translations + generator.normal(0.0, motion.wobble_m, (count, 3))
    return pose(rotations, translations)
