"""The cameras of a calibrated rig as texts for other programs: ROS's camera_info, Kalibr, OpenCV, COLMAP.

A camera whose lens a format lacks is left out of it, and a comment names it.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from rwhec_factors.se3 import inverse

from gtsam_rwhec.cameras.camera import PIXEL_CENTRE, Camera
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.rig.rig_frames import RigFrames
from gtsam_rwhec.rig.section_types import number

#: A remark in a file has at most this many characters.
LONGEST_COMMENT = 2_000
NOT_KNOWN = "whose intrinsics are not known."

#: Our model, the most coefficients, and the model's name in sensor_msgs/distortion_models.
_ROS_MODELS = (
    ("pinhole", 5, "plumb_bob"),
    ("radtan", 5, "plumb_bob"),
    ("radtan", 8, "rational_polynomial"),
    ("equidistant", 4, "equidistant"),
)
#: The same for COLMAP, whose models have exactly this number of coefficients.
_COLMAP_MODELS = (
    ("pinhole", 0, "PINHOLE"),
    ("radtan", 4, "OPENCV"),
    ("radtan", 8, "FULL_OPENCV"),
    ("equidistant", 4, "OPENCV_FISHEYE"),
)
#: Models that Kalibr and OpenCV have.
_MODELS = ("pinhole", "radtan", "equidistant", "unified")
#: Kalibr's radial-tangential distortion has four coefficients: k1, k2, p1, p2.
RADTAN = 4
#: OpenCV's files have this many zeros for a pinhole, as cv::calibrateCamera writes them.
FIVE = 5
#: The beginning of OpenCV's own files; OpenCV reads no file without it.
FIRST_LINES = "%YAML:1.0\n---\n"
#: Metres. Fields of view are compared between these depths.
NEAR_M, FAR_M = 0.2, 20.0
#: The points that are tried in each field of view form a grid of pixels across, pixels down, and depths.
COLUMNS, ROWS, DEPTHS = 17, 13, 25

_CAMERA_INFO = """\
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
_CAMCHAIN = """\
# Cameras in the form of a Kalibr camchain. The frame {carrier}, which carries them, takes the place of the IMU:
#   T_cam_imu          pose of {carrier} in the camera, metres
#   T_cn_cnm1          pose of the previous camera in this camera
#   timeshift_cam_imu  seconds: stamp of {carrier}'s poses = stamp of the image + shift
#   cam_overlaps       cameras whose fields of view overlap this camera's field of view
"""
_OPENCV = """\
# Cameras for OpenCV, by name: cv::FileStorage("cameras.opencv.yaml")["cameras"]["NAME"]["camera_matrix"]
#   T_carrier_camera   pose of the camera's optical frame in carrier, metres: p_carrier = T_carrier_camera p_camera
#   fisheye_model      1: cv::fisheye, 0: the model of cv::projectPoints; xi: cv::omnidir
"""
_COLMAP = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# COLMAP has the middle of the upper left pixel at (0.5, 0.5): cx and cy are half a pixel larger than in other files.
"""


def camera_info_yaml(frames: RigFrames) -> dict[str, str]:
    """The texts of ``camera_info/NAME.yaml``, by the files' names; NAME is the sensor's, with _ in the place of /.

    Sensors without intrinsics, or with a lens that ROS lacks, are left out.
    """
    texts = {}
    for name, plain in _plain_names(frames.sensors).items():
        camera = frames.cameras.get(name)
        found = None if camera is None else _model(camera, _ROS_MODELS)
        if camera is None or found is None:
            continue
        model, count = found
        used = len(np.trim_zeros(camera.D, "b"))
        texts[f"{plain}.yaml"] = _CAMERA_INFO.format(
            name=comment(name),
            carrier=frames.sensor_carrier,
            origin=_origin(frames, name),
            plain=plain,
            width=camera.width,
            height=camera.height,
            K=_row(camera.K.ravel()),
            model=model,
            count=count,
            D=_row(np.pad(camera.D[:used], (0, count - used))),
            R=_row(np.eye(3).ravel()),
            P=_row(np.column_stack([camera.K, np.zeros(3)]).ravel()),
        )
    return texts


def camchain_yaml(frames: RigFrames) -> str:
    """The text of ``camchain.yaml`` for Kalibr: cam0, cam1, ... in the order of the sensors.

    Sensors are left out that have no intrinsics, a lens model that Kalibr lacks, or radial-tangential distortion beyond
    k1, k2, p1, p2: without these coefficients, points near the edges of the images would be off by pixels.
    """
    names, comments = _sorted_out({name: _not_in_kalibr(frames.cameras.get(name)) for name in frames.sensors})
    head = _CAMCHAIN.format(carrier=frames.sensor_carrier) + comments
    if not names:
        return f"{head}# No camera is left.\n{{}}\n"
    T_rig_camera = [frames.sensors[name] for name in names]
    cameras = [frames.cameras[name] for name in names]
    T_camera_rig = inverse(np.array(T_rig_camera))
    meeting = overlaps(cameras, T_rig_camera)
    sections = []
    for n, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        is_unified, K = camera.model == "unified", camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
        # A pinhole has four zeros: more programs read these than read distortion_model: none.
        xi, D = (camera.D[:1], camera.D[1:]) if is_unified else (camera.D[:0], np.pad(camera.D, (0, RADTAN))[:RADTAN])
        lines = [
            f"cam{n}:  # {name}",
            f"  # {_origin(frames, name)}",
            f"  camera_model: {'omni' if is_unified else 'pinhole'}",
            f"  intrinsics: {_row([*xi, *K])}",
            f"  distortion_model: {'equidistant' if camera.model == 'equidistant' else 'radtan'}",
            f"  distortion_coeffs: {_row(D)}",
            f"  resolution: [{camera.width}, {camera.height}]",
        ]
        if name in frames.topics:  # inside YAML's single quotes only the quote itself has a meaning
            lines.append("  rostopic: '{}'".format(frames.topics[name].replace("'", "''")))
        lines += ["  T_cam_imu:", *(f"  - {_row(line)}" for line in T_camera_rig[n])]
        if n:
            lines += ["  T_cn_cnm1:", *(f"  - {_row(line)}" for line in T_camera_rig[n] @ T_rig_camera[n - 1])]
        lines.append(f"  timeshift_cam_imu: {number(frames.time_offsets_s.get(name, 0.0))}")
        lines.append(f"  cam_overlaps: [{', '.join(map(str, meeting[n]))}]")
        sections.append("\n".join(lines) + "\n")
    return head + "".join(sections)


def opencv_yaml(frames: RigFrames) -> str:
    """The text of ``cameras.opencv.yaml``: matrix, coefficients, size of images, and pose of each camera."""
    kept, comments = _sorted_out({name: _lacks(frames.cameras.get(name), _MODELS, "OpenCV") for name in frames.sensors})
    plain = _plain_names(frames.sensors)
    text = f'{FIRST_LINES}{_OPENCV}{comments}carrier: "{frames.sensor_carrier}"\ncameras:{"" if kept else " {}"}\n'
    for name in kept:
        camera, is_unified = frames.cameras[name], frames.cameras[name].model == "unified"
        D = camera.D[1:] if is_unified else camera.D
        lines = [f"   # {_origin(frames, name)}"]
        if _model(camera, _ROS_MODELS) is None:
            why = _lacks(camera, (), "ROS (plumb_bob, rational_polynomial, equidistant)")
            lines.append(f"   # without a file in camera_info: a camera {why}")
        lines += [
            f"   {plain[name]}:",
            f'      name: "{name}"',
            f"      image_width: {camera.width}",
            f"      image_height: {camera.height}",
            f"      fisheye_model: {int(camera.model == 'equidistant')}",
            *_opencv_matrix("camera_matrix", camera.K),
            *([f"      xi: {_row(camera.D[:1])[1:-1]}"] if is_unified else []),
            *_opencv_matrix("distortion_coefficients", (D if len(D) else np.zeros(FIVE))[None]),
            *_opencv_matrix("T_carrier_camera", frames.sensors[name]),
        ]
        text += "\n".join(lines) + "\n"
    return text


def colmap_cameras_txt(frames: RigFrames) -> str:
    """The text of ``cameras.txt`` for COLMAP: cameras 1, 2, ... in the order of the sensors."""
    program, models = "COLMAP (PINHOLE, OPENCV, FULL_OPENCV, OPENCV_FISHEYE)", {}
    for name in frames.sensors:
        camera = frames.cameras.get(name)
        models[name] = None if camera is None else _model(camera, _COLMAP_MODELS)
    kept, comments = _sorted_out(
        {name: "" if found else _lacks(frames.cameras.get(name), (), program) for name, found in models.items()}
    )
    lines = []
    for index, name in enumerate(kept, start=1):
        camera, (model, count) = frames.cameras[name], models[name] or ("", 0)
        D = np.pad(camera.D[:count], (0, count - len(camera.D[:count])))
        values = [camera.K[0, 0], camera.K[1, 1], *(camera.K[:2, 2] + PIXEL_CENTRE), *D]
        lines.append(f"# {index}: {name}, {_origin(frames, name)}\n")
        lines.append(f"{index} {model} {camera.width} {camera.height} {' '.join(map(number, values))}\n")
    return f"{_COLMAP}# Number of cameras: {len(kept)}\n{comments}{''.join(lines)}"


def overlaps(cameras: list[Camera], T_rig_camera: list[Array]) -> list[list[int]]:
    """For each camera, the indices of others whose field of view overlaps its own, between `NEAR_M` and `FAR_M`.

    `T_rig_camera` has the cameras' poses (4, 4) in any common frame, metres. The relation is symmetric.
    """
    points = [_points_in_view(camera) for camera in cameras]
    T_camera_rig = inverse(np.array(T_rig_camera))
    sees = np.zeros((len(cameras), len(cameras)), dtype=bool)
    for i, T_rig_i in enumerate(T_rig_camera):
        for j, T_j_rig in enumerate(T_camera_rig):
            T_j_i = T_j_rig @ T_rig_i
            in_j = points[i] @ T_j_i[:3, :3].T + T_j_i[:3, 3]
            sees[i, j] = i != j and bool(cameras[j].inside(cameras[j].project(in_j)).any())
    return [np.flatnonzero(row).tolist() for row in sees | sees.T]


def comment(remark: str) -> str:
    """A remark on one line: names in it come from a log, and a line break would end the comment."""
    return shown(remark, LONGEST_COMMENT)


def _points_in_view(camera: Camera) -> Array:
    """Points (N, 3) that a camera sees, in the camera's frame, metres."""
    u, v = np.meshgrid(np.linspace(0.0, camera.width - 1.0, COLUMNS), np.linspace(0.0, camera.height - 1.0, ROWS))
    x = camera.undistort(np.stack([u, v], axis=-1).reshape(-1, 2))
    rays = np.column_stack([x, np.ones(len(x))])[np.isfinite(x).all(axis=1)]
    return (np.geomspace(NEAR_M, FAR_M, DEPTHS)[:, None, None] * rays).reshape(-1, 3)


def _origin(frames: RigFrames, name: str) -> str:
    """Where a camera's intrinsics come from, in words."""
    return comment(f"intrinsics {frames.camera_origins.get(name, 'as stated')}")


def _model(camera: Camera, models: Iterable[tuple[str, int, str]]) -> tuple[str, int] | None:
    """A program's name for a camera's model, and its number of coefficients; None if the program lacks the model."""
    fitting = ((word, count) for ours, count, word in models if camera.model == ours and not camera.D[count:].any())
    return next(fitting, None)


def _lacks(camera: Camera | None, models: tuple[str, ...], program: str) -> str:
    """Why a program with these models cannot use a camera; empty if it can."""
    if camera is None:
        return NOT_KNOWN
    known = camera.model in models
    return "" if known else f"whose lens model ({camera.model}, {len(camera.D)} coefficients) {program} lacks."


def _not_in_kalibr(camera: Camera | None) -> str:
    """Why a camchain cannot contain a camera; empty if it can."""
    lacks = _lacks(camera, _MODELS, "Kalibr")
    if lacks or camera is None or camera.model != "radtan" or not camera.D[RADTAN:].any():
        return lacks
    return (
        f"whose distortion has coefficients that Kalibr's radtan (k1, k2, p1, p2) lacks: {_row(camera.D[RADTAN:])} "
        "from the fifth on. Calibrate its intrinsics with four (k3 = 0), or with Kalibr itself; where corners "
        "estimate them, state four."
    )


def _sorted_out(reasons: dict[str, str]) -> tuple[list[str], str]:
    """The sensors without a reason to be left out; and a comment that names the others with their reasons."""
    kept = [name for name, reason in reasons.items() if not reason]
    return kept, "".join(f"# Left out: {name}, {reason}\n" for name, reason in reasons.items() if reason)


def _plain_names(names: Iterable[str]) -> dict[str, str]:
    """For each name, a new one of letters, digits and _. No two new names differ only in upper and lower case."""
    plain: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        wanted = base = name.replace("/", "_")
        count = 1
        while wanted.casefold() in taken:
            count += 1
            wanted = f"{base}_{count}"
        taken.add(wanted.casefold())
        plain[name] = wanted
    return plain


def _row(values: Iterable[float]) -> str:
    """Numbers as a list of YAML."""
    return f"[{', '.join(map(number, values))}]"


def _opencv_matrix(key: str, matrix: Array) -> list[str]:
    rows, columns = matrix.shape
    return [
        f"      {key}: !!opencv-matrix",
        f"         rows: {rows}",
        f"         cols: {columns}",
        "         dt: d",
        f"         data: {_row(matrix.ravel())}",
    ]
