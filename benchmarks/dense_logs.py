"""A dense log: an arm with a camera on its hand before a board, every frame kept, and nothing as white as assumed.

The arm is not built as its controller believes (`simulated_arms.py`), the board's pose errs with where it is seen from,
a drift walks, and each frame has noise of its own, larger along the camera's axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors.se3 import inverse, pose
from simulated_arms import ARM, BENT_RAD, FloatArray, moved_by, white

import gtsam_rwhec as rw
from gtsam_rwhec.simulate.simulated_noise import rotations_of_vectors

RATE_HZ = 30.0
BOARD, CAMERA = "board", "camera"
#: White noise of a frame, rad and m; along the camera's axis the translation's is this many times as large.
WHITE, ALONG_AXIS = (float(np.radians(0.1)), 0.0005), 3.0
#: Errors of the board's pose by its view, rms.
BY_VIEW = (float(np.radians(0.15)), 0.0015)
#: Steps of the drift from frame to frame: 0.2 degrees and 2 mm in 1,500 of them.
DRIFT = (float(np.radians(0.005)), 5e-5)
#: An arm's joints are off by so many degrees and its links by so many mm, drawn evenly between in the logarithm.
JOINTS_DEG, LINKS_MM = (0.02, 0.1), (0.1, 0.5)
#: Waves that make up what depends on the view, and their frequency, rad over the view's usual range.
WAVES, FREQUENCY = 12, 1.5


@dataclass(frozen=True)
class DenseLog:
    """The truth X = T_base_board, Y = T_hand_camera, and what was recorded: A = T_hand_base and B (N, 4, 4)."""

    X: FloatArray
    Y: FloatArray
    A: FloatArray
    B: FloatArray
    stamps_ns: np.ndarray

    def problem(self, frames: slice = slice(None)) -> rw.Problem:
        """The problem of some frames, without a weight."""
        problem = rw.Problem()
        problem.add(BOARD, CAMERA, self.A[frames], self.B[frames], stamps_ns=self.stamps_ns[frames])
        return problem


def simulate(frames: int, generator: np.random.Generator) -> DenseLog:
    """One log of so many frames."""
    joints = _path(frames, generator)
    share = generator.uniform()
    off_by = [low * (high / low) ** share for low, high in (np.radians(JOINTS_DEG), 1e-3 * np.array(LINKS_MM))]
    T_base_hand = ARM.misbuilt(*off_by, generator).hand(joints)
    tilt = rotations_of_vectors(generator.normal(0.0, np.radians(10.0), 3))
    Y = pose(tilt, generator.uniform([-0.08, -0.08, 0.02], [0.08, 0.08, 0.12]))
    # The board is 0.6 m before the middle of the camera's path, and looks back at it.
    seen = pose(
        rotations_of_vectors([np.pi, 0.0, 0.0]) @ rotations_of_vectors(generator.normal(0.0, 0.3, 3)),
        np.append(generator.normal(0.0, 0.05, 2), generator.uniform(0.5, 0.8)),
    )
    X = ARM.hand(BENT_RAD[None])[0] @ Y @ seen
    B = inverse(T_base_hand @ Y) @ X
    errors = by_view(B, generator) + np.cumsum(white(frames, *DRIFT, generator), axis=0)
    errors += white(frames, *WHITE, generator) * [1.0, 1.0, 1.0, 1.0, 1.0, ALONG_AXIS]
    stamps = np.round(1e9 * (1.0 + np.arange(frames) / RATE_HZ)).astype(np.int64)
    return DenseLog(X, Y, inverse(ARM.hand(joints)), moved_by(B, errors), stamps)


def by_view(B: FloatArray, generator: np.random.Generator) -> FloatArray:
    """A smooth random function xi (N, 6) of where the board is seen: its direction, distance and tilt."""
    t = B[:, :3, 3]
    view = np.column_stack([t[:, :2] / t[:, 2:] / 0.3, (t[:, 2] - 0.6) / 0.2, B[:, :2, 2] / 0.4])
    waves = np.cos(view @ generator.normal(0.0, FREQUENCY, (5, WAVES)) + generator.uniform(0.0, 2.0 * np.pi, WAVES))
    amplitudes = generator.standard_normal((WAVES, 6)) * np.repeat(BY_VIEW, 3) * np.sqrt(2.0 / WAVES)
    return waves @ amplitudes


def _path(frames: int, generator: np.random.Generator) -> FloatArray:
    """Joint angles (N, 6): three slow waves for each joint, larger in the wrist."""
    times = np.arange(frames) / RATE_HZ
    sizes = np.radians([6.0, 5.0, 5.0, 12.0, 14.0, 40.0])
    cycles = generator.uniform(0.02, 0.2, (3, 6))
    phases = generator.uniform(0.0, 2.0 * np.pi, (3, 6))
    waves = np.sin(2.0 * np.pi * cycles * times[:, None, None] + phases)
    return BENT_RAD + sizes * waves.sum(axis=1) / np.sqrt(1.5)
