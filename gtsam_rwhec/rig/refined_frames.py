"""Calibrated frames of a refinement, with the intrinsics that were estimated with the poses in place of stated ones."""

from __future__ import annotations

from collections.abc import Mapping

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.corners_refined import CornersRefined, RefinedIntrinsics
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.reprojection_record import Intrinsics
from gtsam_rwhec.rig.calibrated_frames import RigFrames

#: Parameters that are focal lengths and principal points, in pixels; coefficients follow them.
IN_PIXELS = 4
#: Pixels. A focal length that counts as exact has a smaller deviation.
EXACT_PX = 1e-3


def frames_of_refined(
    refined: RefinedPoses | CornersRefined,
    cameras: Mapping[str, Camera] | None = None,
    *,
    sensor_carrier: str = "sensorcarrier",
    target_carrier: str = "targetcarrier",
    warnings: tuple[str, ...] = (),
) -> RigFrames:
    """The frames and cameras of a refinement, for ``rw.export.export_all``.

    Parameters
    ----------
    refined : Refined, RefinedPoses or CornersRefined
        Of ``rw.refine``, ``rw.read_refined``, ``rw.refine_corners`` or ``rw.calibrate_corners(...).refined``.
    cameras : dict of str to Camera, optional
        Stated intrinsics by sensor: they count where none were estimated.
    sensor_carrier, target_carrier : str
        Names of the frames that carry the sensors and the targets.
    warnings : tuple of str
        Written into the head of every file.

    Raises
    ------
    FrameError
        A name cannot be a frame's, or `cameras` has a sensor that `refined` lacks.
    """
    known, origins = known_cameras(cameras or {}, refined.intrinsics)
    return RigFrames(
        sensor_carrier=sensor_carrier,
        target_carrier=target_carrier,
        sensors={name: pose.matrix() for name, pose in refined.Y.items()},
        targets={name: pose.matrix() for name, pose in refined.X.items()},
        cameras=known,
        camera_origins=origins,
        time_offsets_s=refined.time_offsets_s,
        warnings=warnings,
    )


def known_cameras(
    stated: Mapping[str, Camera], estimated: Mapping[str, Intrinsics] | Mapping[str, RefinedIntrinsics]
) -> tuple[dict[str, Camera], dict[str, str]]:
    """The cameras to use by sensor, estimated ones before stated ones; and where the former are from, in words."""
    cameras = {**stated, **{name: intrinsics.camera for name, intrinsics in estimated.items()}}
    return cameras, {name: _origin(intrinsics) for name, intrinsics in estimated.items()}


def _origin(intrinsics: Intrinsics | RefinedIntrinsics) -> str:
    if max(intrinsics.standard_deviations[:IN_PIXELS]) < EXACT_PX:
        return "as stated, which count as exact"
    deviations = [
        f"{name} {sigma:.2g}" for name, sigma in zip(intrinsics.names, intrinsics.standard_deviations, strict=True)
    ]
    pixels, coefficients = ", ".join(deviations[:IN_PIXELS]) + " px", deviations[IN_PIXELS:]
    words = f"estimated from the corners, standard deviations {', '.join([pixels, *coefficients])}"
    held = ", ".join(intrinsics.held_by_prior)
    return f"{words}; what was stated holds {held}, not the images" if held else words
