"""The cameras as COLMAP's ``cameras.txt``."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_files import PIXEL_CENTRE
from gtsam_rwhec.export.camera_words import NOT_KNOWN, lacks, origin, sorted_out
from gtsam_rwhec.export.written_poses import number
from gtsam_rwhec.rig.rig_frames import RigFrames

#: COLMAP's model by our model and the number of coefficients up to which it goes, which are then as many.
_MODELS = (
    ("pinhole", 0, "PINHOLE"),
    ("radtan", 4, "OPENCV"),
    ("radtan", 8, "FULL_OPENCV"),
    ("equidistant", 4, "OPENCV_FISHEYE"),
)
_HEAD = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# COLMAP has the middle of the upper left pixel at (0.5, 0.5): cx and cy are half a pixel larger than in other files.
"""


def colmap_cameras_txt(frames: RigFrames) -> str:
    """The text of ``cameras.txt``: cameras 1, 2, ... in the order of the sensors.

    Sensors without intrinsics, and lenses of which COLMAP has no model, are left out, and a comment names each one.
    """
    kept, comments = sorted_out({name: _reason(frames.cameras.get(name)) for name in frames.sensors})
    lines = []
    for index, name in enumerate(kept, start=1):
        camera = frames.cameras[name]
        model, count = _model(camera)
        centre = camera.K[:2, 2] + PIXEL_CENTRE
        D = np.pad(camera.D[:count], (0, count - len(camera.D[:count])))
        numbers = " ".join(number(value) for value in [camera.K[0, 0], camera.K[1, 1], *centre, *D])
        lines.append(f"# {index}: {name}, {origin(frames, name)}\n")
        lines.append(f"{index} {model} {camera.width} {camera.height} {numbers}\n")
    return f"{_HEAD}# Number of cameras: {len(kept)}\n{comments}{''.join(lines)}"


def _reason(camera: Camera | None) -> str:
    """Say why COLMAP cannot have a sensor; the text is empty if it can."""
    if camera is None:
        return NOT_KNOWN
    return "" if _model(camera)[0] else lacks(camera, "COLMAP (PINHOLE, OPENCV, FULL_OPENCV, OPENCV_FISHEYE)")


def _model(camera: Camera) -> tuple[str, int]:
    """COLMAP's name of a camera's model, and how many coefficients it has there; the name is empty if there is none."""
    return next(
        ((word, count) for ours, count, word in _MODELS if camera.model == ours and not camera.D[count:].any()), ("", 0)
    )
