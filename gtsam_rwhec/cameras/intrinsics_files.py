"""Intrinsics from files: Kalibr's camchains, ROS's camera_info YAML, OpenCV's FileStorage (YAML, XML, JSON), COLMAP."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from gtsam_rwhec.cameras.camera import MODELS, NAMES, PIXEL_CENTRE, Camera
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.yaml_lines import KeyPath, YamlFile, parse_storage, read_text, read_yaml, shown
from gtsam_rwhec.geometry.poses import Array

#: Kalibr's camera models that are supported, with the distortion models that go with them.
KALIBR_MODELS = {"pinhole": ("none", "radtan", "equidistant"), "omni": ("none", "radtan")}
_KALIBR_CAMERA = re.compile(r"cam\d+")
#: Keys of intrinsics in files of ROS, OpenCV's samples and users; here in lower case and without underscores.
_WIDTH, _HEIGHT = ("imagewidth", "width", "imgwidth", "w"), ("imageheight", "height", "imgheight", "h")
_SIZE = ("imagesize", "imgsize", "resolution", "size")
_MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "mtx", "m")
_COEFFICIENTS = ("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "d", "dist")
#: Plain numbers, as RealSense and NeRF name them too.
_PLAIN = (("fx", "flx"), ("fy", "fly"), ("cx", "ppx"), ("cy", "ppy"))
_MODEL = ("distortionmodel", "cameramodel")
#: OpenCV's omnidir writes this beside the matrix and four coefficients.
_XI = ("xi",)
#: Messages give the needed fields these names.
_FIELDS = {
    _WIDTH: "image_width", _HEIGHT: "image_height", _MATRIX: "camera_matrix", _COEFFICIENTS: "distortion_coefficients",
}  # fmt: skip


def read_kalibr_camchain(path: str | Path) -> dict[str, Camera]:
    """Read a Kalibr camchain (``camchain.yaml``, ``camchain-imucam.yaml``).

    Parameters
    ----------
    path
        Each camera has camera_model (pinhole or omni), intrinsics [fu, fv, pu, pv], or [xi, fu, fv, pu, pv] of omni,
        distortion_model (none, radtan, and equidistant of a pinhole), distortion_coeffs and resolution [width, height].
        Poses and time shifts are not read.

    Returns
    -------
    dict of str to Camera
        By Kalibr's names: ``cam0``, ``cam1`` and so on.

    Raises
    ------
    FileFormatError
        The file cannot be read or is not a camchain, or a field is missing or wrong. The message has the line.
    CameraError
        No camera has these intrinsics.
    """
    return _kalibr_cameras(read_yaml(path))


def _kalibr_cameras(file: YamlFile) -> dict[str, Camera]:
    chain = file.data if isinstance(file.data, dict) else {}
    names = [name for name in chain if _KALIBR_CAMERA.fullmatch(name)]
    if not names:
        other = " (it has a camera matrix: is it a calibration of ROS or OpenCV?)" if _found(chain, _MATRIX) else ""
        refuse(file, (), f"no cameras cam0, cam1, ...{other}; a Kalibr camchain was expected")
    return {name: _kalibr_camera(file, name) for name in names}


def _kalibr_camera(file: YamlFile, name: str) -> Camera:
    section = file.data[name]
    if not isinstance(section, dict):
        refuse(file, (name,), f"{shown(section)}; a camera's section was expected")
    for key in ("camera_model", "intrinsics", "distortion_model", "resolution"):
        if key not in section:
            refuse(file, (name, key), "is missing")
    camera_model, model = section["camera_model"], section["distortion_model"]
    if camera_model not in KALIBR_MODELS:
        advice = "calibrate with Kalibr's pinhole-radtan or, for wide lenses, pinhole-equi or omni-radtan"
        words = f"{shown(camera_model)} is not supported, only {' and '.join(KALIBR_MODELS)} are; {advice}"
        refuse(file, (name, "camera_model"), words)
    if model not in KALIBR_MODELS[camera_model]:
        refuse(file, (name, "distortion_model"), _unsupported(model, KALIBR_MODELS[camera_model]))
    is_omni = camera_model == "omni"
    *xi, fu, fv, pu, pv = numbers_of(file, (name, "intrinsics"), section["intrinsics"], 5 if is_omni else 4)
    resolution = numbers_of(file, (name, "resolution"), section["resolution"], 2)
    width, height = (pixels_of(file, (name, "resolution"), float(side)) for side in resolution)
    coefficients = section.get("distortion_coeffs", () if model == "none" else None)
    D = numbers_of(file, (name, "distortion_coeffs"), coefficients, None if model == "none" else 4)
    K = np.array([[fu, 0.0, pu], [0.0, fv, pv], [0.0, 0.0, 1.0]])
    return Camera.of(width, height, "unified" if is_omni else model, K, [*xi, *D], file.place((name,)))


def read_calibration_yaml(path: str | Path) -> Camera:
    """Read a camera from ROS's camera_info YAML (``ost.yaml``) or from a file of OpenCV's FileStorage.

    Parameters
    ----------
    path
        YAML, JSON or OpenCV's XML. Has image_width, image_height, camera_matrix, distortion_coefficients, and
        distortion_model; or the plain numbers fx, fy, cx, cy with the size, and coefficients k1, k2, p1, p2, k3 by
        name. Other tools' names of these keys are read too (K, D, mtx, dist, image_size). Without a distortion_model,
        fisheye_model (of OpenCV's sample) or xi (of its omnidir) gives the model; five coefficients or more mean
        radtan.

    Raises
    ------
    FileFormatError
        The file cannot be read, a field is missing or wrong, or four coefficients fit two models. The message has the
        line.
    CameraError
        No camera has these intrinsics.
    """
    file = parse_storage(read_text(path), str(path))
    fields = file.data if isinstance(file.data, dict) else {}
    if any(_KALIBR_CAMERA.fullmatch(name) for name in fields):
        refuse(file, (), "a Kalibr camchain; give it in the rig file as {kalibr: FILE, camera: cam0}")
    return _calibrated(file, "", None)


def read_cameras(path: str | Path, size: tuple[int, int] | None = None) -> dict[str, Camera]:
    """Read all cameras of a file of Kalibr, COLMAP, ROS or OpenCV, whichever it is.

    Parameters
    ----------
    path
        As `read_kalibr_camchain`, `read_colmap_cameras` or `read_calibration_yaml`; or a file of OpenCV's stereo
        calibration, with M1, D1, M2, D2; or of this library's ``cameras.opencv.yaml``.
    size : (int, int), optional
        Width and height in pixels, for files of OpenCV that do not have them.

    Returns
    -------
    dict of str to Camera
        By the file's names: ``cam0`` of Kalibr, ``1`` of COLMAP and of stereo files, the sensors' names of this
        library; a single camera without a name has the name "".

    Raises
    ------
    FileFormatError, CameraError
        As these functions.
    """
    text = read_text(path)
    if is_colmap(text):
        return read_colmap_cameras(path)
    file = parse_storage(text, str(path))
    fields = file.data if isinstance(file.data, dict) else {}
    if any(_KALIBR_CAMERA.fullmatch(name) for name in fields):
        return _kalibr_cameras(file)
    if isinstance(fields.get("cameras"), dict):
        return _by_name(file, size)
    numbered = [
        number for number in ("1", "2") if isinstance(fields.get(_found(fields, _MATRIX, number)), (dict, tuple))
    ]
    if numbered and _found(fields, _MATRIX) is None:
        return {number: _calibrated(file, number, size) for number in numbered}
    return {"": _calibrated(file, "", size)}


def _by_name(file: YamlFile, size: tuple[int, int] | None) -> dict[str, Camera]:
    """The cameras of `cameras`, each a calibration with its name in it, or else as its key."""
    if not file.data["cameras"]:
        refuse(file, ("cameras",), "no camera is in it")
    cameras: dict[str, Camera] = {}
    for key, section in file.sections("cameras").items():
        if not isinstance(section.data, dict):
            refuse(file, ("cameras", key), f"{shown(section.data)}; a camera's section was expected")
        name = str(section.data.get("name", key))
        if name in cameras:
            refuse(file, ("cameras", key), f"the name {shown(name)} is there twice; keep one")
        cameras[name] = _calibrated(section, "", size)
    return cameras


def _calibrated(file: YamlFile, number: str, size: tuple[int, int] | None) -> Camera:
    """The camera of a calibration; the keys of one of a stereo pair end with its number."""
    fields = file.data if isinstance(file.data, dict) else {}
    if not number and _found(fields, _MATRIX) is None and _found(fields, _PLAIN[0]) is not None:
        return _of_plain_numbers(file, size)
    width, height = _image_size(file, size)
    key = _key(file, _MATRIX, number)
    value = fields[key]
    if isinstance(value, tuple) and len(value) == 4:
        fx, fy, cx, cy = matrix_of(file, key, 4)
        K = np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
    else:
        K = matrix_of(file, key, 9)
    D = matrix_of(file, _key(file, _COEFFICIENTS, number), None)
    xi = _xi(file, number)
    model = "unified" if xi else _model(file, D, number)
    return Camera.of(width, height, model, K.reshape(3, 3), [*xi, *D], file.place((key,)))


def _xi(file: YamlFile, number: str = "") -> list[float]:
    """The xi of OpenCV's omnidir, a number or a matrix of one; empty for other models."""
    fields = file.data
    key, model = _found(fields, _XI, number), _found(fields, _MODEL)
    if key is None:
        return []
    if model is not None and MODELS.get(str(fields[model]).strip().lower(), "radtan") == "equidistant":
        refuse(
            file, (model,), f"{shown(fields[model])}, and xi, which only the unified model has; take one of both out"
        )
    if isinstance(fields[key], (dict, tuple)):
        return [float(matrix_of(file, key, 1)[0])]
    return [float(numbers_of(file, (key,), (fields[key],), 1)[0])]


def _image_size(file: YamlFile, size: tuple[int, int] | None) -> tuple[int, int]:
    """Width and height in pixels, from the file or as stated; a FileFormatError if both exist and differ."""
    fields = file.data if isinstance(file.data, dict) else {}
    whole, wide = _found(fields, _SIZE), _found(fields, _WIDTH)
    if whole is not None and wide is None:
        width, height = (
            pixels_of(file, (whole,), float(side)) for side in numbers_of(file, (whole,), fields[whole], 2)
        )
    elif wide is None and size is not None:
        return size
    else:
        width, height = (pixels_of(file, (key,), fields[key]) for key in (_key(file, _WIDTH), _key(file, _HEIGHT)))
    if size not in (None, (width, height)):
        refuse(file, (whole or wide or "",), f"{width} x {height} pixels, and size: {list(size or ())} was stated")
    return width, height


def _of_plain_numbers(file: YamlFile, size: tuple[int, int] | None) -> Camera:
    """A camera of numbers with names: fx, fy, cx, cy, and k1, k2, p1, p2, k3 to k6 of OpenCV's model.

    Files of multi-camera hand-eye tools count the coefficients from zero, dist_k0 to dist_k5 with dist_px and dist_py.
    """
    fields = file.data
    width, height = _image_size(file, size)

    def number(names: tuple[str, ...]) -> float:
        key = _found(fields, names)
        if key is None:
            refuse(file, (), f"no {names[0]}; plain intrinsics have fx, fy, cx and cy")
        return float(numbers_of(file, (key,), (fields[key],), 1)[0])

    fx, fy, cx, cy = map(number, _PLAIN)
    from_zero = _found(fields, ("distk0", "k0")) is not None
    names = ("0", "1", "px", "py", "2", "3", "4", "5") if from_zero else ("1", "2", "p1", "p2", "3", "4", "5", "6")
    wanted = [(f"dist{name}", name) if name[0] == "p" else (f"distk{name}", f"k{name}") for name in names]
    D = [number(each) if _found(fields, each) is not None else 0.0 for each in wanted]
    has = _found(fields, ("hasdistcoeff",))
    if has is not None and not fields[has]:
        D = []
    model = _model(file, np.array([])) if _found(fields, _MODEL) is not None else "radtan" if any(D) else "pinhole"
    xi = _xi(file)
    if xi:
        model, D = "unified", [*xi, *D]
    K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return Camera.of(width, height, model, K, D, file.place(()))


def _model(file: YamlFile, D: Array, number: str = "") -> str:
    fields = file.data
    key = _found(fields, _MODEL)
    if key is not None:
        word = fields[key]
        if not isinstance(word, str) or word.strip().lower() not in MODELS:
            refuse(file, (key,), _unsupported(word, filter(None, MODELS)))
        return word
    fisheye = _found(fields, ("fisheyemodel",))
    if fisheye is not None:
        if fields[fisheye] not in (0, 1):
            refuse(file, (fisheye,), f"{shown(fields[fisheye])}; give 0 or 1")
        return "fisheye" if fields[fisheye] else "radtan"
    if len(D) == 4 and D.any():
        words = "four coefficients can be of OpenCV's fisheye model or of its radtan model; add a line "
        words += "distortion_model: fisheye, or distortion_model: radtan"
        refuse(file, (_key(file, _COEFFICIENTS, number),), words)
    return "radtan"


def _found(fields: dict[str, Any], names: tuple[str, ...], number: str = "") -> str | None:
    """The key of the file that stands for one of `names`, or None."""
    plain = {key.lower().replace("_", ""): key for key in reversed(fields)}
    return next((plain[name + number] for name in names if name + number in plain), None)


def _key(file: YamlFile, names: tuple[str, ...], number: str = "") -> str:
    key = _found(file.data, names, number) if isinstance(file.data, dict) else None
    if key is None:
        words = f"no {_FIELDS[names]}; give a calibration with {', '.join(_FIELDS.values())}, as ROS's camera_info and "
        words += "OpenCV's samples have it"
        if names in (_WIDTH, _HEIGHT):
            words += "; or state the size in the rig file, intrinsics: {file: FILE, size: [width, height]}"
        refuse(file, (), words)
    return key


def _unsupported(value: Any, supported: Iterable[str]) -> str:
    return f"{shown(value)} is not supported; supported are {', '.join(supported)}"


def matrix_of(file: YamlFile, key: str, count: int | None) -> Array:
    """The numbers of a matrix, given as {rows, cols, data}, as a list, or as a list of rows."""
    value, path = file.data[key], (key,)
    if not isinstance(value, dict):
        if isinstance(value, tuple) and value and all(isinstance(row, tuple) for row in value):
            value = tuple(number for row in value for number in row)
        return numbers_of(file, path, value, count)
    if "sizes" in value and "rows" not in value:  # OpenCV 5: a vector, or a matrix of more than two dimensions
        return numbers_of(file, (*path, "data"), value.get("data"), count)
    for part in ("rows", "cols", "data"):
        if part not in value:
            refuse(file, (*path, part), "is missing; a matrix has rows, cols and data")
    numbers = numbers_of(file, (*path, "data"), value["data"], count)
    rows, cols = value["rows"], value["cols"]
    if not isinstance(rows, int) or not isinstance(cols, int) or rows * cols != len(numbers):
        refuse(file, (*path, "data"), f"{len(numbers)} numbers for {shown(rows)} rows and {shown(cols)} columns")
    return numbers


def numbers_of(file: YamlFile, path: KeyPath, value: Any, count: int | None) -> Array:
    """A list of finite numbers, as many as stated."""
    if value is None:
        refuse(file, path, "is missing" if path not in file.lines else "is empty")
    if not isinstance(value, tuple) or (count is not None and len(value) != count):
        many = f"a list of {count} numbers" if count is not None else "a list of numbers"
        refuse(file, path, f"{shown(value)}; {many} was expected")
    for i, number in enumerate(value):
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not math.isfinite(number):
            refuse(file, (*path, i), f"{shown(number)}; a finite number was expected")
    return np.array(value, dtype=float)


def pixels_of(file: YamlFile, path: KeyPath, value: Any) -> int:
    """A whole number of pixels."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value % 1:
        refuse(file, path, f"{shown(value)}; a whole number of pixels was expected")
    return int(value)


def refuse(file: YamlFile, path: KeyPath, words: str) -> NoReturn:
    """Raise FileFormatError with the file, the line and the key."""
    raise FileFormatError(file.fault(path, words) + ".")


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
_LINE = re.compile(r"\d+[\s,]+[A-Z][A-Z_]+[\s,]+\d+[\s,]+\d+[\s,]")


def is_colmap(text: str) -> bool:
    """Whether the first line that is not a comment is a camera of COLMAP."""
    lines = (line.strip() for line in text.splitlines())
    return _LINE.match(next((line for line in lines if line and line[0] != "#"), "")) is not None


def read_colmap_cameras(path: str | Path) -> dict[str, Camera]:
    """Read COLMAP's ``cameras.txt``, by its camera ids: ``1``, ``2`` and so on.

    The principal point is moved by half a pixel, from COLMAP's corner to the middle. Raises `FileFormatError` if the
    file cannot be read, has no cameras, or a line is no camera of a supported model (the message has the line and the
    models); `CameraError` if no camera has these intrinsics.
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
    D = [of.get(name, 0.0) for name in NAMES.get(model, "").split()]
    return Camera.of(int(fields[2]), int(fields[3]), model, K, D, where)
