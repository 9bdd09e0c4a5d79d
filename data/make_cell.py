"""Make ``data/cell``: two camera logs of a made-up robot cell, and the truth (the rig files are written by hand).

``python data/make_cell.py`` writes everything again, which takes some minutes; the seed is fixed, so it comes out the
same. ``python data/make_cell.py --check cam_wide 17`` draws one image again and compares.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from cell_scene import fixed_cameras, hand_cameras
from cell_scene.cell import Cell
from cell_scene.fixed_cameras import FixedCameras
from cell_scene.hand_cameras import HandCameras
from cell_scene.poses import FloatArray
from cell_scene.rendering import Image, Lens
from cell_scene.ros2_log import Ros2Log

from gtsam_rwhec.logs import ImageRecord, IntrinsicsRecord, LogWriter, open_log

SEED = 20261121
FOLDER = Path(__file__).parent / "cell"
#: The lens models in Foxglove's words.
FOXGLOVE_MODELS = {"radtan": "plumb_bob", "equidistant": "kannala_brandt"}
#: Images are drawn beside one another; each takes two seconds.
PROCESSES = 2
CELLS: tuple[type[Cell], ...] = (HandCameras, FixedCameras)
#: Gray levels, root mean square over an image: what compressing changes, and what may differ between two releases of
#: OpenCV (rounding of single pixels) once both images are compressed.
MOST_COMPRESSED, MOST_AGAIN = 3.2, 1.0


def compressed(image: Image, quality: int) -> bytes:
    """A JPEG."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


@cache
def cell(kind: type[Cell], seed: int) -> Cell:
    """Made once a process: its lenses' rays take a while."""
    return kind(seed)


def cell_of(camera: str) -> Cell:
    """The cell that has a camera.

    Raises
    ------
    SystemExit
        None has.
    """
    for kind in CELLS:
        if camera in kind.lenses:
            return cell(kind, SEED)
    sys.exit(f"there is no camera {camera}; there are {', '.join(name for kind in CELLS for name in kind.lenses)}")


def drawn(kind: type[Cell], camera: str, number: int) -> bytes:
    """One image's JPEG."""
    return compressed(cell(kind, SEED).image(camera, number), kind.jpeg_quality)


def images(kind: type[Cell]) -> list[tuple[int, str, bytes]]:
    """(stamp, camera, JPEG) of all of a log's images, by stamp."""
    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")) as pool:
        parts = {
            (int(stamp), camera): pool.submit(drawn, kind, camera, number)
            for camera in kind.lenses
            for number, stamp in enumerate(cell(kind, SEED).stamps_ns(camera))
        }
        return [(stamp, camera, parts[stamp, camera].result()) for stamp, camera in sorted(parts)]


def write_hand_cameras(path: Path) -> None:
    """The Foxglove log: base to hand on /tf, two cameras' intrinsics and images."""
    stamps_ns, T_base_hand = hand_cameras.robot(SEED)
    pictures = images(HandCameras)
    with LogWriter(path) as log:
        for camera, lens in hand_cameras.LENSES.items():
            log.calibration(intrinsics(camera, int(stamps_ns[0]), lens))
        for stamp_ns, T in zip(stamps_ns.tolist(), T_base_hand, strict=True):
            while pictures and pictures[0][0] <= stamp_ns:
                when, camera, jpeg = pictures.pop(0)
                log.compressed_image(f"/{camera}/image", when, camera, "jpeg", jpeg)
            log.transforms("/tf", stamp_ns, [("base", "hand", T)])


def intrinsics(camera: str, stamp_ns: int, lens: Lens) -> IntrinsicsRecord:
    """A lens as Foxglove has it."""
    P = np.c_[lens.K, np.zeros(3)]
    return IntrinsicsRecord(
        stamp_ns, stamp_ns, f"/{camera}/camera_info", camera, lens.width, lens.height, FOXGLOVE_MODELS[lens.model],
        lens.K, lens.coefficients(), np.eye(3), P,
    )  # fmt: skip


def write_fixed_cameras(path: Path) -> None:
    """The ROS 2 log: the arm's links on /tf and /tf_static, two cameras' infos and images."""
    stamps_ns, T_base_link, T_link_flange = fixed_cameras.arm(SEED)
    pictures = images(FixedCameras)
    with Ros2Log(path) as log:
        first = int(stamps_ns[0])
        log.transforms(
            "/tf_static",
            first,
            [("world", "base", fixed_cameras.T_WORLD_BASE), ("flange", "hand", fixed_cameras.T_FLANGE_HAND)],
        )
        for camera, lens in fixed_cameras.LENSES.items():
            log.camera_info(f"/{camera}/camera_info", first, camera, lens)
        for i, stamp_ns in enumerate(stamps_ns.tolist()):
            while pictures and pictures[0][0] <= stamp_ns:
                when, camera, jpeg = pictures.pop(0)
                log.image(f"/{camera}/image/compressed", when, camera, jpeg)
            log.transforms("/tf", stamp_ns, [("base", "link", T_base_link[i]), ("link", "flange", T_link_flange[i])])


def truth() -> dict[str, dict[str, Any]]:
    """File name to what is true: poses (4, 4), seconds, metres."""
    tags = {name: hand_cameras.TAG_M for name in hand_cameras.T_BASE_TARGET if name != "board"}
    return {
        "truth.json": {
            "T_hand_camera": _lists(hand_cameras.T_HAND_CAMERA),
            "T_base_target": _lists(hand_cameras.T_BASE_TARGET),
            "time_offset_s": hand_cameras.OFFSET_S,
            "length_m": {**tags, "board": hand_cameras.SQUARE_M},
            "scale": {**dict.fromkeys(tags, 1.0), "board": hand_cameras.STATED_SQUARE_M / hand_cameras.SQUARE_M},
            "poster": {
                "target": "tag_2",
                "camera": "cam_left",
                "stamps_ns": [int(HandCameras(SEED).stamps_ns("cam_left")[i]) for i in hand_cameras.T_CAMERA_POSTER],
            },
        },
        "eye_to_hand_truth.json": {
            "T_base_camera": _lists(fixed_cameras.T_BASE_CAMERA),
            "T_hand_target": _lists({"tag_7": fixed_cameras.T_HAND_TAG}),
            "time_offset_s": dict.fromkeys(fixed_cameras.LENSES, 0.0),
            "length_m": {"tag_7": fixed_cameras.TAG_M},
            "scale": {"tag_7": 1.0},
        },
    }


def _lists(poses: dict[str, FloatArray]) -> dict[str, list[list[float]]]:
    return {name: T.tolist() for name, T in poses.items()}


def check(camera: str, number: int, folder: Path = FOLDER) -> tuple[float, float]:
    """Draw an image again.

    Returns
    -------
    tuple of float
        Differences from what is decoded from the log, gray levels, root mean square: of what was drawn, and of that
        after compressing it.
    """
    cell = cell_of(camera)
    image = cell.image(camera, number)
    with open_log(folder / cell.file) as log:
        found = [r for r in log.records() if isinstance(r, ImageRecord) and r.frame == camera]
    stored = decoded(found[number].data)
    return rms(image, stored), rms(decoded(compressed(image, cell.jpeg_quality)), stored)


def decoded(jpeg: bytes) -> Image:
    """A gray image."""
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE))


def rms(one: Image, other: Image) -> float:
    """Root mean square of the difference."""
    return float(np.sqrt(np.mean((one.astype(float) - other) ** 2)))


def write(folder: Path) -> None:
    """Write all that this script makes."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in truth().items():
        (folder / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    write_hand_cameras(folder / HandCameras.file)
    write_fixed_cameras(folder / FixedCameras.file)


def main(arguments: list[str] | None = None) -> int:
    """Write, or check."""
    parser = argparse.ArgumentParser(description="Make data/cell, or check an image of it.")
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--check", nargs=2, metavar=("CAMERA", "NUMBER"), help="draw one image again and compare")
    given = parser.parse_args(arguments)
    if given.check is None:
        write(given.folder)
        return 0
    as_drawn, as_stored = check(given.check[0], int(given.check[1]), given.folder)
    print(f"root mean square of the difference: {as_drawn:.2f} gray levels as drawn, {as_stored:.2f} compressed alike")
    return 0 if as_drawn <= MOST_COMPRESSED and as_stored <= MOST_AGAIN else 1


if __name__ == "__main__":
    sys.exit(main())
