"""Cameras from COLMAP's ``cameras.txt``: a line for each, ``CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]``."""

from __future__ import annotations

import math
import re
from pathlib import Path

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.yaml_lines import read_text, shown
from gtsam_rwhec.vision.camera import Camera

#: The model here, and COLMAP's parameters in its order; one f is both focal lengths.
_MODELS = {
    "SIMPLE_PINHOLE": ("pinhole", "f cx cy"),
    "PINHOLE": ("pinhole", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("radtan", "f cx cy k1"),
    "RADIAL": ("radtan", "f cx cy k1 k2"),
    "OPENCV": ("radtan", "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": ("radtan", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "OPENCV_FISHEYE": ("equidistant", "fx fy cx cy k1 k2 k3 k4"),
}
#: OpenCV's order of the coefficients.
_ORDER = {"pinhole": "", "radtan": "k1 k2 p1 p2 k3 k4 k5 k6", "equidistant": "k1 k2 k3 k4"}
#: COLMAP has the middle of the upper left pixel at (0.5, 0.5), `Camera` at (0, 0).
PIXEL_CENTRE = 0.5
_LINE = re.compile(r"\d+[\s,]+[A-Z][A-Z_]+[\s,]+\d+[\s,]+\d+[\s,]")


def is_colmap(text: str) -> bool:
    """Whether the first line that is no comment is a camera of COLMAP."""
    lines = (line.strip() for line in text.splitlines())
    return _LINE.match(next((line for line in lines if line and line[0] != "#"), "")) is not None


def read_colmap_cameras(path: str | Path) -> dict[str, Camera]:
    """Read COLMAP's ``cameras.txt``; the principal point is moved by half a pixel, from COLMAP's corner to the middle.

    Returns
    -------
    dict of str to Camera
        By COLMAP's numbers: ``1``, ``2`` and so on.

    Raises
    ------
    FileFormatError
        The file cannot be read, has no cameras, or a line is no camera of a model that is supported. The message has
        the line, and the models.
    CameraError
        No camera has these intrinsics.
    """
    cameras: dict[str, Camera] = {}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        fields = re.split(r"[\s,]+", line.strip())
        if not fields[0] or fields[0].startswith("#"):
            continue
        where = f"{path}, line {number}"
        if fields[0] in cameras:
            raise FileFormatError(f"{where}: camera {fields[0]} is there twice; keep one.")
        cameras[fields[0]] = _camera(fields, where)
    if not cameras:
        raise FileFormatError(f"{path} has no cameras; COLMAP writes them as {_HEAD}.")
    return cameras


_HEAD = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"


def _camera(fields: list[str], where: str) -> Camera:
    if len(fields) < 4 or not all(re.fullmatch(r"\d{1,9}", fields[i]) for i in (0, 2, 3)):
        raise FileFormatError(f"{where}: {shown(' '.join(fields))} is no camera of COLMAP: {_HEAD}.")
    if fields[1] not in _MODELS:
        raise FileFormatError(
            f"{where}: the model {shown(fields[1])} is not supported; supported are {', '.join(_MODELS)}. COLMAP's "
            "bundle adjustment can fit one of these to the same images."
        )
    model, names = _MODELS[fields[1]]
    try:
        numbers = [float(field) for field in fields[4:]]
    except ValueError as error:
        raise FileFormatError(f"{where}: a parameter is no number: {error}.") from error
    if len(numbers) != len(names.split()) or not all(map(math.isfinite, numbers)):
        raise FileFormatError(f"{where}: {fields[1]} has the parameters {names}, and here are {len(numbers)} numbers.")
    of = dict(zip(names.split(), numbers, strict=True))
    fx, fy = of.get("fx", of.get("f", 0.0)), of.get("fy", of.get("f", 0.0))
    K = [[fx, 0.0, of["cx"] - PIXEL_CENTRE], [0.0, fy, of["cy"] - PIXEL_CENTRE], [0.0, 0.0, 1.0]]
    D = [of.get(name, 0.0) for name in _ORDER[model].split()]
    return Camera.of(int(fields[2]), int(fields[3]), model, K, D, where)
