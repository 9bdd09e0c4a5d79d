"""The cameras, with their poses, in one file of OpenCV's FileStorage."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.export.camera_info import ros_lacks
from gtsam_rwhec.export.camera_words import NOT_KNOWN, lacks, origin, plain_names, row, sorted_out
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.rig.rig_frames import RigFrames

#: OpenCV's own files begin so; without it OpenCV does not read them.
FIRST_LINES = "%YAML:1.0\n---\n"
_HEAD = """\
# Cameras for OpenCV, by name: cv::FileStorage("cameras.opencv.yaml")["cameras"]["NAME"]["camera_matrix"]
#   T_carrier_camera   pose of the camera's optical frame in carrier, metres: p_carrier = T_carrier_camera p_camera
#   fisheye_model      1: cv::fisheye, 0: the model of cv::projectPoints; xi: cv::omnidir
"""
_MODELS = ("pinhole", "radtan", "equidistant", "unified")
#: A pinhole has so many zeros, as cv::calibrateCamera writes them.
FIVE = 5


def opencv_yaml(frames: RigFrames) -> str:
    """The text of ``cameras.opencv.yaml``: each camera's matrix, coefficients, size of images, and pose on the carrier.

    Sensors without intrinsics are left out, and a comment names them.
    """
    kept, comments = sorted_out({name: _reason(frames.cameras.get(name)) for name in frames.sensors})
    plain = plain_names(frames.sensors)
    text = f'{FIRST_LINES}{_HEAD}{comments}carrier: "{frames.sensor_carrier}"\ncameras:{"" if kept else " {}"}\n'
    return text + "".join(_section(frames, name, plain[name], frames.cameras[name]) for name in kept)


def _section(frames: RigFrames, name: str, plain: str, camera: Camera) -> str:
    is_unified = camera.model == "unified"
    D = camera.D[1:] if is_unified else camera.D
    D = D if len(D) else np.zeros(FIVE)
    why = ros_lacks(camera)
    lines = [
        f"   # {origin(frames, name)}",
        *([f"   # without a file in camera_info: a camera {why}"] if why else []),
        f"   {plain}:",
        f'      name: "{name}"',
        f"      image_width: {camera.width}",
        f"      image_height: {camera.height}",
        f"      fisheye_model: {int(camera.model == 'equidistant')}",
        *_matrix("camera_matrix", camera.K),
        *([f"      xi: {row(camera.D[:1])[1:-1]}"] if is_unified else []),
        *_matrix("distortion_coefficients", D[None]),
        *_matrix("T_carrier_camera", frames.sensors[name]),
    ]
    return "\n".join(lines) + "\n"


def _matrix(key: str, matrix: Array) -> list[str]:
    rows, columns = matrix.shape
    return [
        f"      {key}: !!opencv-matrix",
        f"         rows: {rows}",
        f"         cols: {columns}",
        "         dt: d",
        f"         data: {row(matrix.ravel())}",
    ]


def _reason(camera: Camera | None) -> str:
    """Say why OpenCV cannot have a sensor; the text is empty if it can."""
    if camera is None:
        return NOT_KNOWN
    return "" if camera.model in _MODELS else lacks(camera, "OpenCV")
