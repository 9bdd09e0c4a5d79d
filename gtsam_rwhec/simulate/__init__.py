"""Simulated calibration problems whose truth is known.

:func:`sphere` and :func:`cameras` are the RWHEC paper's Sections 8.1 and 8.2 (they place the noise as the paper does,
so there the camera is the ``target``; see their modules); :func:`general` makes problems of any size, graph, motion
and scale, with the noise on what the sensors see. Each returns a :class:`Simulation`.
"""

from gtsam_rwhec.simulate.camera_on_sphere import sphere
from gtsam_rwhec.simulate.fixed_cameras import cameras
from gtsam_rwhec.simulate.motion import Motion, carrier_poses
from gtsam_rwhec.simulate.noise import Noise, langevin_rotations, perturb
from gtsam_rwhec.simulate.rig import general
from gtsam_rwhec.simulate.simulation import Answer, CalibrationErrors, FrameDistance, Simulation, frame_distance

__all__ = [
    "Answer",
    "CalibrationErrors",
    "FrameDistance",
    "Motion",
    "Noise",
    "Simulation",
    "cameras",
    "carrier_poses",
    "frame_distance",
    "general",
    "langevin_rotations",
    "perturb",
    "sphere",
]
