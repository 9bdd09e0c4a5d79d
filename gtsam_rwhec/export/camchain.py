"""The cameras as a Kalibr camchain."""

from __future__ import annotations

import numpy as np
from rwhec_factors.se3 import inverse

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.export.camera_words import NOT_KNOWN, lacks, origin, row, sorted_out
from gtsam_rwhec.export.overlaps import overlaps
from gtsam_rwhec.export.written_poses import number
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.rig.rig_frames import RigFrames

_HEAD = """\
# Cameras in the form of a Kalibr camchain. The frame {carrier}, which carries them, takes the place of the IMU:
#   T_cam_imu          pose of {carrier} in the camera, metres
#   T_cn_cnm1          pose of the previous camera in this camera
#   timeshift_cam_imu  seconds: stamp of {carrier}'s poses = stamp of the image + shift
#   cam_overlaps       cameras whose fields of view overlap this camera's field of view
"""
#: Kalibr's radial-tangential distortion has four coefficients: k1, k2, p1, p2.
RADTAN = 4
_MODELS = ("pinhole", "radtan", "equidistant", "unified")


def camchain_yaml(frames: RigFrames) -> str:
    """The text of ``camchain.yaml``: cam0, cam1, ... in the order of the sensors.

    Sensors are left out, and a comment names each one, that have no intrinsics, a lens model that Kalibr lacks, or
    radial-tangential distortion beyond k1, k2, p1, p2. Without these coefficients, points near the edges of the images
    would be off by pixels.
    """
    names, comments = sorted_out({name: _reason(frames.cameras.get(name)) for name in frames.sensors})
    head = _HEAD.format(carrier=frames.sensor_carrier) + comments
    if not names:
        return f"{head}# No camera is left.\n{{}}\n"
    T_rig_camera = [frames.sensors[name] for name in names]
    cameras = [frames.cameras[name] for name in names]
    T_camera_rig = inverse(np.array(T_rig_camera))
    meeting = overlaps(cameras, T_rig_camera)
    sections = []
    for n, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        is_unified, K = camera.model == "unified", camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
        xi, D = (camera.D[:1], camera.D[1:]) if is_unified else (camera.D[:0], _four(camera))
        lines = [
            f"cam{n}:  # {name}",
            f"  # {origin(frames, name)}",
            f"  camera_model: {'omni' if is_unified else 'pinhole'}",
            f"  intrinsics: {row([*xi, *K])}",
            f"  distortion_model: {'equidistant' if camera.model == 'equidistant' else 'radtan'}",
            f"  distortion_coeffs: {row(D)}",
            f"  resolution: [{camera.width}, {camera.height}]",
        ]
        if name in frames.topics:
            lines.append(f"  rostopic: {_quoted(frames.topics[name])}")
        lines += _matrix("T_cam_imu", T_camera_rig[n])
        if n:
            lines += _matrix("T_cn_cnm1", T_camera_rig[n] @ T_rig_camera[n - 1])
        lines.append(f"  timeshift_cam_imu: {number(frames.time_offsets_s.get(name, 0.0))}")
        lines.append(f"  cam_overlaps: [{', '.join(map(str, meeting[n]))}]")
        sections.append("\n".join(lines) + "\n")
    return head + "".join(sections)


def _reason(camera: Camera | None) -> str:
    """Say why a camchain cannot have a sensor; the text is empty if it can."""
    if camera is None:
        return NOT_KNOWN
    if camera.model not in _MODELS:
        return lacks(camera, "Kalibr")
    more = camera.D[RADTAN:] if camera.model == "radtan" else np.zeros(0)
    if more.any():
        return (
            f"whose distortion has coefficients that Kalibr's radtan (k1, k2, p1, p2) lacks: {row(more)} "
            "from the fifth on. Calibrate its intrinsics with four (k3 = 0), or with Kalibr itself; where corners "
            "estimate them, state four."
        )
    return ""


def _four(camera: Camera) -> Array:
    """k1, k2, p1, p2. A pinhole has zeros: more programs read these than read distortion_model: none."""
    return np.pad(camera.D, (0, RADTAN))[:RADTAN]


def _matrix(key: str, T: Array) -> list[str]:
    return [f"  {key}:"] + [f"  - {row(line)}" for line in T]


def _quoted(text: str) -> str:
    """Text in YAML's single quotes: inside them only the quote itself has a meaning."""
    return "'" + text.replace("'", "''") + "'"
