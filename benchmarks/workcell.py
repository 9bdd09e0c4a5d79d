"""Boards of a real workcell that are read right and wrong, and how long it takes.

    python benchmarks/workcell.py [--repetitions 3] [--splits 0]

39 images of 1080p of a checkerboard of 3 x 4 corners on an arm, five of them without it (davidea97's
Multi-Camera-Hand-Eye-Calibration, Apache-2.0, ``shared/data/workcell_camera2``; GTSAM_RWHEC_DATA names another folder).
A board is read right if each corner is within a pixel of where the joint solution of A X = Y B has it, with all hand
poses. The peer is OpenCV's classic detector with its fast check, in turns with ours, on one thread.

With ``--splits N`` the images are divided at random N times, and both halves are calibrated by the command, with the
data set's intrinsics as nominal ones: do the answers agree within what they claim together?
"""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import numpy.typing as npt
from bars import SHARED, Row, at_most, in_words, interleaved, run_script
from rich.progress import track

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.detect.many_images import detect_in_images
from gtsam_rwhec.files.yaml_lines import read_yaml
from gtsam_rwhec.logs.records import ImageRecord

FOLDER = SHARED / "workcell_camera2"
BOARD = Checkerboard("board", columns=3, rows=4, square_m=0.05)
#: A corner further than this from the joint solution's is wrong, pixels.
WRONG_PX = 1.0
#: The images are taken this often, so that processes are worth their start.
TIMES_OVER = 12
#: Images that show no board (looked at).
WITHOUT_A_BOARD = ("0001", "0020", "0140", "0150", "0160")

RIG = """carriers: {{sensors: base, targets: hand, poses: {{frames: [base, hand]}}}}
sensors: {{camera2: {{images: image, poses: pose, intrinsics: {{K: {K}, size: [1920, 1080]}}}}}}
targets: {{board: {{type: checkerboard, inner_corners: [3, 4], square_m: 0.05}}}}
"""
#: Halves agree where their difference is within what both claim at this level.
LEVEL = 0.99

Gray = npt.NDArray[np.uint8]


def the_camera() -> Camera:
    """The intrinsics that the data set states."""
    fields = read_yaml(FOLDER / "intrinsic_pars_file.yaml").data
    K = np.array([[fields["fx"], 0.0, fields["cx"]], [0.0, fields["fy"], fields["cy"]], [0.0, 0.0, 1.0]])
    return Camera.of(fields["img_width"], fields["img_height"], "none", K, np.zeros(0), "camera2")


def off_the_joint_solution(camera: Camera, images: dict[str, Gray]) -> dict[str, float]:
    """By the image's name, the largest distance of a corner from where the joint solution has it; inf if not read."""
    (*found,) = Detector(camera, [BOARD])(list(images.values()))
    read = {name: one.detections[0] for name, one in zip(images, found, strict=True) if one.detections}
    read = {name: one for name, one in read.items() if one.rejection is None}
    hand = {name: np.loadtxt(FOLDER / "pose" / f"{name}.csv") for name in read}
    problem = rw.Problem()
    problem.add("board", "camera", np.array(list(hand.values())), np.array([one.T[0] for one in read.values()]))
    solved = rw.solve(problem)
    X, Y = solved.X["board"].matrix(), solved.Y["camera"].matrix()
    off = dict.fromkeys(images, np.inf)
    for name, one in read.items():
        T = np.linalg.inv(Y) @ hand[name] @ X
        corners = BOARD.corners()[one.indices]
        pixels = cv2.projectPoints(corners, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K, np.zeros(4))[0][:, 0]
        off[name] = float(np.linalg.norm(pixels - one.corners_px, axis=1).max())
    return off


def classic(gray: Gray) -> object:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    return cv2.findChessboardCorners(gray, (BOARD.columns, BOARD.rows), flags=flags)


def decoded(data: bytes) -> Gray:
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def squared_difference(split: int) -> float:
    """Of the camera's poses from two random halves of the images: over the bound that their covariances claim."""
    names = np.random.default_rng(split).permutation(sorted(path.stem for path in (FOLDER / "image").glob("*.png")))
    found = []
    for half in np.array_split(names, 2):
        with TemporaryDirectory() as temporary:
            folder = Path(temporary)
            for part, ending in (("image", "png"), ("pose", "csv")):
                (folder / part).mkdir()
                for name in half:
                    (folder / part / f"{name}.{ending}").symlink_to((FOLDER / part / f"{name}.{ending}").resolve())
            (folder / "rig.yaml").write_text(RIG.format(K=the_camera().parameters.tolist()), encoding="utf-8")
            command = ["calibrate", str(folder), "--rig", str(folder / "rig.yaml"), "-o", str(folder / "out")]
            subprocess.run([sys.executable, "-m", "gtsam_rwhec", *command], capture_output=True, check=False)
            refined = rw.results.read_calibration(folder / "out").refined
            assert refined is not None
            found.append(refined)
    covariance = sum(one.covariance("camera2") for one in found)
    error = rw.pose_covariances.error_of(found[0].Y["camera2"], found[1].Y["camera2"].matrix())
    return float(error @ np.linalg.solve(covariance, error)) / max(one.squared_radius(6, LEVEL) for one in found)


def rows_of_halves(splits: int) -> list[Row]:
    """How many splits agree."""
    ratios = [squared_difference(split) for split in track(range(splits), "splits")]
    agree, least = sum(ratio <= 1.0 for ratio in ratios), int(np.ceil(0.95 * splits))
    figure = f"{agree} of {splits}; median of squares over the bound {np.median(ratios):.2f}, largest {max(ratios):.2f}"
    return [Row(f"halves of the images agree within {LEVEL:.0%}", figure, f">= {least}", agree >= least)]


def rows(repetitions: int, splits: int) -> list[Row]:
    """What is read, and times; whether halves agree."""
    if not FOLDER.is_dir():
        raise SystemExit(f"{FOLDER} does not exist: set GTSAM_RWHEC_DATA to the folder that holds workcell_camera2")
    cv2.setNumThreads(1)
    files = {path.stem: path.read_bytes() for path in sorted((FOLDER / "image").glob("*.png"))}
    camera, images = the_camera(), {name: decoded(data) for name, data in files.items()}
    off = off_the_joint_solution(camera, images)
    shown = [name for name in images if name not in WITHOUT_A_BOARD]
    right = [name for name in shown if off[name] <= WRONG_PX]
    wrong = [name for name in images if np.isfinite(off[name]) and name not in right]
    result = [
        Row("boards read right", f"{len(right)} of {len(shown)}", "all 34", len(right) == len(shown) == 34),
        Row("boards read wrong", f"{len(wrong)} {wrong or ''}", "0", not wrong),
        Row(" largest distance of a corner", f"{max(off[name] for name in right):.2f} px", "<= 1 px", not wrong),
    ]
    detector = Detector(camera, [BOARD])
    for words, names, bar in (("whose board is seen", shown, 3.0), ("without a board", WITHOUT_A_BOARD, 3.0)):
        times = interleaved(
            repetitions,
            {
                "ours": lambda names=names: [detector([images[name]]) for name in names],  # type: ignore[misc]
                "classic": lambda names=names: [classic(images[name]) for name in names],  # type: ignore[misc]
                "decode": lambda names=names: [decoded(files[name]) for name in names],  # type: ignore[misc]
            },
        )
        ratio = times.ratio("ours", "classic")
        each = {name: times.median(name) / len(names) for name in times.of}
        took = f" ({in_words(each['ours'])} over {in_words(each['classic'])})"
        result += [
            at_most(f"time of images {words} over classic", ratio, bar, "x", ".2f", took),
            Row(
                " images a second on one thread, decoded",
                f"{1.0 / (each['decode'] + each['ours']):.0f} (classic {1.0 / (each['decode'] + each['classic']):.0f})",
            ),
        ]
    many = [
        ImageRecord(k, k, "camera2", "camera2", "png", data) for k, data in enumerate(TIMES_OVER * list(files.values()))
    ]
    makers = {"camera2": partial(Detector, camera, [BOARD])}
    times = interleaved(1, {"ours": lambda: sum(1 for _ in detect_in_images(many, makers, workers=2))})
    rate = len(many) / times.median("ours")
    result += rows_of_halves(splits) if splits else []
    return [*result, Row("images a second, two workers, from files' bytes", f"{rate:.0f}", ">= 20", rate >= 20.0)]


if __name__ == "__main__":
    run_script("Workcell", rows, repetitions=3, splits=0)
