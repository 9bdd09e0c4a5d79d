"""Each camera in ROS's camera_info YAML, as camera_calibration_parsers writes it and camera_info_manager reads it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.export.camera_words import comment, lacks, origin, plain_names, row
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.rig.rig_frames import RigFrames

#: sensor_msgs/distortion_models: the name of a model by our model and the number of coefficients up to which it goes.
_MODELS = (
    ("pinhole", 5, "plumb_bob"),
    ("radtan", 5, "plumb_bob"),
    ("radtan", 8, "rational_polynomial"),
    ("equidistant", 4, "equidistant"),
)
_TEXT = """\
# {name}, on {carrier}: {origin}
# In the form of ROS's camera_calibration_parsers. The rectified image has the same K: projection_matrix is [K | 0].
image_width: {width}
image_height: {height}
camera_name: '{plain}'
camera_matrix:
  rows: 3
  cols: 3
  data: {K}
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: {D}
rectification_matrix:
  rows: 3
  cols: 3
  data: {R}
projection_matrix:
  rows: 3
  cols: 4
  data: {P}
"""


def camera_info_yaml(frames: RigFrames) -> dict[str, str]:
    """The texts of ``camera_info/NAME.yaml``, by the files' names; NAME is the sensor's, with _ in the place of /.

    Sensors are left out that have no intrinsics, or whose lens model ROS lacks (`ros_lacks`).
    """
    plain = plain_names(frames.sensors)
    return {
        f"{plain[name]}.yaml": _text(frames, name, plain[name], camera)
        for name in frames.sensors
        if (camera := frames.cameras.get(name)) is not None and not ros_lacks(camera)
    }


def ros_lacks(camera: Camera) -> str:
    """Say that ROS has no model for a camera's lens; the text is empty if it has one."""
    return "" if _model(camera) is not None else lacks(camera, "ROS (plumb_bob, rational_polynomial, equidistant)")


def _text(frames: RigFrames, name: str, plain: str, camera: Camera) -> str:
    found = _model(camera)
    assert found is not None
    model, D = found
    return _TEXT.format(
        name=comment(name),
        carrier=frames.sensor_carrier,
        origin=origin(frames, name),
        plain=plain,
        width=camera.width,
        height=camera.height,
        K=_flat(camera.K),
        model=model,
        count=len(D),
        D=row(D),
        R=_flat(np.eye(3)),
        P=_flat(np.column_stack([camera.K, np.zeros(3)])),
    )


def _model(camera: Camera) -> tuple[str, Array] | None:
    """ROS's name of a camera's model, and as many coefficients as it has there."""
    used = len(np.trim_zeros(camera.D, "b"))
    return next(
        (
            (word, np.pad(camera.D[:used], (0, count - used)))
            for ours, count, word in _MODELS
            if _is(camera, ours, count)
        ),
        None,
    )


def _is(camera: Camera, model: str, count: int) -> bool:
    return camera.model == model and not camera.D[count:].any()


def _flat(matrix: Iterable[Iterable[float]]) -> str:
    return row(value for line in matrix for value in line)
