"""Cells rendered to folders of images and calibrated by the command: is the truth where the results say it is?

    python benchmarks/rendered_cells.py [--cells 300] [--seed 1] [--jobs 1] [--kinds hand fixed alike] [--each]
        [--keep FILE] [--folder FOLDER]

A "hand" cell has one camera on the hand and a board that stands still; a "fixed" one two cameras with different lenses
beside the arm, and the board on its hand; an "alike" one four such cameras of one lens, stated alike. Intrinsics are
stated right, a pixel off in the centre, 1 % off in the focal length, or not at all (`estimate`). A third of the cells
have pinholes, half of them noise of 0.02 degrees and 0.1 mm on the arm's poses, half a board that is bent by 0.3 mm
about any axis, a third JPEGs. Nothing of this is told. Each camera has 25 to 40 images, each at a pose of its own. A
cell depends on its kind, the seed and its number alone.

Ellipsoids count where the verdict is not DO NOT USE. A checkerboard that looks the same upside down may be found so. A
bent board's frame is in its middle where its bend was estimated, else in the plane through its corners; that plane is
not the same in all images, and has no bar. Images count as left out where their board was read and is not used.

``--each`` prints a line a cell, ``--keep`` adds each to a file and goes on from it, ``--folder`` is where cells are
rendered and the log of their corners is written, once, and stay; else each is removed.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bars
import cv2
import numpy as np
import rendered_prints as prints
import rendered_scenes as scenes
from bars import Row, Share
from gallery_scene import REPEAT_M, REPEAT_RAD, looking, on_hand
from rendered_kinds import half_of, outline_of
from rendered_prints import Array, Print
from rwhec_factors.se3 import inverse
from simulated_arms import moved_by, white

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Charuco, Checkerboard
from gtsam_rwhec.errors import RwhecError

KINDS = {"hand": 1, "fixed": 2, "alike": 4}  # numbers of cameras
STATED = ("right", "1 px off", "1 % off", "missing")
BOARDS: tuple[Checkerboard | Charuco, ...] = (
    Checkerboard("board", 5, 7, 0.04),
    Checkerboard("board", 8, 11, 0.03),
    Checkerboard("board", 3, 4, 0.05),
    Charuco("board", "aruco_4x4_100", 7, 5, 0.048, 0.036),
)
WIDTHS = (960, 1024, 1152, 1280)
BEND_M, MOST_TILT_DEG = 3e-4, 45.0
MARGIN = 0.5  # white around a board, in squares
EXACT_PX = 1e-3  # a lens that `rendered_scenes` inverts worse, at the image's corners, is drawn anew
DRAWN = 1000  # poses, of which those count that have the board whole in the image
LEVEL, FAR = 0.95, 0.9999


@dataclass(frozen=True, eq=False)
class Cell:
    """What is true of a cell, and where its files are; what is stated of a camera is None where nothing is."""

    kind: str
    folder: Path
    board: Checkerboard | Charuco
    cameras: dict[str, Camera]
    stated: dict[str, Camera | None]
    X: Array
    Y: dict[str, Array]
    #: (2,): The board's height over its middle is the square of this along it, and `sign`.
    bend: Array
    sign: float
    drawn: dict[str, Any]

    @property
    def corners(self) -> Path:
        """The log of the corners that were found in its images."""
        return self.folder / "corners.mcap"

    def height(self, x: Array, y: Array) -> Array:
        """Of the board over its middle, metres."""
        return np.asarray(self.sign * (self.bend[0] * x + self.bend[1] * y) ** 2)


def lens(rng: np.random.Generator, pinhole: bool) -> Camera:
    """A usual one."""
    width = int(rng.choice(WIDTHS))
    size = np.array([width, 3 * width // 4])
    while True:
        fx = width * rng.uniform(0.8, 1.4)
        fy = fx * (1.0 + rng.normal(0.0, 1e-3) * (rng.random() < 0.5))
        cx, cy = (size - 1) / 2.0 + rng.normal(0.0, 0.01 * width, 2)
        k1 = rng.normal(-0.1, 0.1)
        D = np.array([k1, -0.5 * k1 + rng.normal(0.0, 0.05), *rng.normal(0.0, 5e-4, 2)]) * (not pinhole)
        camera = Camera(width, int(size[1]), "radtan", np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), D)
        rim = np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) * (size - 1.0)
        if np.abs(camera.pixels(scenes._undistorted(camera, rim)) - rim).max() < EXACT_PX:
            return camera


def as_stated(rng: np.random.Generator, camera: Camera, stated: str) -> Camera | None:
    """What the rig file has."""
    K, angle = camera.K.copy(), rng.uniform(0.0, 2.0 * np.pi)
    if stated == "1 px off":
        K[:2, 2] += np.cos(angle), np.sin(angle)
    if stated == "1 % off":
        K[[0, 1], [0, 1]] *= 1.0 + 0.01 * rng.choice([-1.0, 1.0])
    return None if stated == "missing" else replace(camera, K=K)


def stations(rng: np.random.Generator, camera: Camera, board: Checkerboard | Charuco, number: int) -> Array:
    """T_camera_board (N, 4, 4), from all sides, near and far, the board anywhere in the image."""
    distance, (towards, roll) = rng.uniform(0.5, 1.5, DRAWN), rng.uniform(-np.pi, np.pi, (2, DRAWN))
    tilt = np.radians(rng.uniform(0.0, MOST_TILT_DEG, DRAWN))
    T = looking(distance, tilt, towards, roll, rng.uniform(-0.4, 0.4, (DRAWN, 2)) * distance[:, None])
    found = [one for one in inverse(T) if scenes.is_whole(scenes.Pose(camera, one, 0.0), outline(board))]
    assert len(found) >= number, "the board is too large for the lens"
    return np.array(found[:number])


def outline(board: Checkerboard | Charuco) -> Array:
    """(n, 3) of the board."""
    half = 0.5 * board.square_m * board.columns, 0.5 * board.square_m * board.rows
    return outline_of(half if isinstance(board, Charuco) else half_of(board))


def printed(cell: Cell, pose: scenes.Pose) -> Print:
    """The board as sharp as the image asks for, as its plane would look if it had the pattern of the bent board."""
    board, finest = cell.board, scenes.pixel_m(pose, outline(cell.board))
    if isinstance(board, Charuco):
        parts = prints.charuco_unit(board)[0]
        sharp = prints.charuco(board, int(board.square_m / parts / finest), MARGIN * parts)
    else:
        sharp = prints.checkerboard(board, int(board.square_m / finest), MARGIN)
    if not cell.bend.any():
        return sharp
    middle = 0.5 * (np.array(sharp.picture.shape[::-1], dtype=np.float32) - 1)
    column, row = (np.arange(n, dtype=np.float32) for n in sharp.picture.shape[::-1])
    x, y = sharp.pixel_m * (column - middle[0])[None, :], sharp.pixel_m * (middle[1] - row)[:, None]
    eye = (-pose.T[:3, :3].T @ pose.T[:3, 3]).astype(np.float32)
    on_x, on_y = x, y
    for _ in range(2):  # along the ray from the plane to the eye
        share = (cell.height(on_x, on_y) / eye[2]).astype(np.float32)
        on_x, on_y = x + share * (eye[0] - x), y + share * (eye[1] - y)
    maps = (on_x / sharp.pixel_m + middle[0]).astype(np.float32), (middle[1] - on_y / sharp.pixel_m).astype(np.float32)
    picture = cv2.remap(sharp.picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return Print(np.asarray(picture, dtype=np.float32), sharp.pixel_m)


def made_cell(kind: str, seed: int, number: int, folder: Path) -> Cell:
    """Draw a cell, and write its images, poses and rig file."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode()), number])
    stated, board = str(rng.choice(STATED)), BOARDS[int(rng.integers(len(BOARDS)))]
    drawn: dict[str, Any] = {
        "stated": stated,
        "board": f"{type(board).__name__} {board.columns} x {board.rows}",
        "pinhole": bool(rng.random() < 1 / 3),
        "noisy": bool(rng.random() < 0.5),
        "bent": bool(rng.random() < 0.5),
        "jpeg": int(rng.integers(85, 96)) if rng.random() < 1 / 3 else None,
    }
    angle, far = rng.uniform(0.0, 2.0 * np.pi), np.linalg.norm(board.corners(), axis=1).max()
    bend = drawn["bent"] * np.sqrt(BEND_M) / far * np.array([np.cos(angle), np.sin(angle)])
    names = [f"camera{i + 1}" for i in range(KINDS[kind])]
    cameras = {name: lens(rng, drawn["pinhole"]) for name in names}
    of_stated = {name: as_stated(rng, camera, stated) for name, camera in cameras.items()}
    if kind == "alike":
        cameras, of_stated = dict.fromkeys(names, cameras[names[0]]), dict.fromkeys(names, of_stated[names[0]])
    n = len(names)
    tilt, around = np.radians(rng.uniform(30.0, 80.0, n)), 2.0 * np.pi * (np.arange(n) / n + rng.uniform(0.0, 1.0, n))
    beside = looking(rng.uniform(1.2, 1.8, n), tilt, around, rng.normal(0.0, 0.1, n), rng.normal(0.0, 0.1, (n, 2)))
    carried = on_hand(rng)
    X, Y = (inverse(beside[0]), [carried]) if kind == "hand" else (carried, list(beside))
    sign = float(rng.choice([-1.0, 1.0]))
    cell = Cell(kind, folder, board, cameras, of_stated, X, dict(zip(names, Y, strict=True)), bend, sign, drawn)
    if cell.corners.exists():
        return cell
    shutil.rmtree(folder, ignore_errors=True)
    for name in names:
        _write_images(cell, name, rng)
    (folder / "rig.yaml").write_text(rig_text(cell), encoding="utf-8")
    return cell


def _write_images(cell: Cell, name: str, rng: np.random.Generator) -> None:
    """A camera's images, and the poses of the arm beside them."""
    camera = cell.cameras[name]
    scenes.WIDTH, scenes.HEIGHT = camera.width, camera.height
    T = stations(rng, camera, cell.board, int(rng.integers(25, 41)))
    A = cell.Y[name] @ T @ inverse(cell.X)  # T_sensorcarrier_targetcarrier
    T_base_hand = inverse(A) if cell.kind == "hand" else A
    if cell.drawn["noisy"]:
        T_base_hand = moved_by(T_base_hand, white(len(T), REPEAT_RAD, REPEAT_M, rng))
    blur, noise, gamma = rng.uniform(0.3, 1.0), rng.uniform(1.0, 3.0), float(np.exp(rng.uniform(-0.7, 0.2)))
    for part in ("image", "pose"):
        (cell.folder / name / part).mkdir(parents=True)
    jpeg = cell.drawn["jpeg"]
    of_file = [cv2.IMWRITE_PNG_COMPRESSION, 1] if jpeg is None else [cv2.IMWRITE_JPEG_QUALITY, jpeg]
    for k, one in enumerate(T):
        pose = scenes.Pose(camera, one, 0.0)
        light = replace(scenes.random_light(rng), blur_px=blur, motion_px=(0.0, 0.0), gamma=gamma, noise=noise)
        lit = scenes.BACKGROUNDS[int(rng.integers(len(scenes.BACKGROUNDS)))](rng)
        scenes.laid_over(lit, pose, printed(cell, pose), light)
        if rng.random() < 0.5:
            lit *= scenes.shade(rng, scenes.projected(camera, outline(cell.board), one))
        path = cell.folder / name / "image" / f"{k:03d}.{'png' if jpeg is None else 'jpg'}"
        cv2.imwrite(str(path), scenes.seen_by_camera(rng, lit, light), of_file)
        np.savetxt(cell.folder / name / "pose" / f"{k:03d}.csv", T_base_hand[k])


def rig_text(cell: Cell) -> str:
    """The rig file."""
    sensors, targets = ("hand", "base") if cell.kind == "hand" else ("base", "hand")
    lines = [f"carriers: {{sensors: {sensors}, targets: {targets}, poses: {{frames: [base, hand]}}}}", "sensors:"]
    for name, camera in cell.stated.items():
        intrinsics = "estimate"
        if camera is not None:
            K, D = np.round(camera.parameters[:4], 4).tolist(), np.round(camera.D, 8).tolist()
            model = f"model: radtan, D: {D}, " if any(D) else ""
            intrinsics = f"{{{model}K: {K}, size: [{camera.width}, {camera.height}]}}"
        lines.append(f"  {name}: {{images: {name}/image, poses: {name}/pose, intrinsics: {intrinsics}}}")
    board = cell.board
    words = f"type: checkerboard, inner_corners: [{board.columns}, {board.rows}]"
    if isinstance(board, Charuco):
        words = f"type: charuco, family: {board.family}, squares: [{board.columns}, {board.rows}]"
        words += f", marker_m: {board.marker_m}"
    return "\n".join([*lines, "targets:", f"  board: {{{words}, square_m: {board.square_m}}}", ""])


def run(kind: str, seed: int, number: int, folder: Path | None) -> dict[str, Any]:
    """Render a cell, calibrate it as a user does, and compare."""
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as temporary:
        begun = time.monotonic()
        cell = made_cell(kind, seed, number, (folder or Path(temporary)) / f"{kind}_{seed}_{number}")
        rendered, out = time.monotonic(), cell.folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        done = None
        if not cell.corners.exists():
            rig = ["--rig", str(cell.folder / "rig.yaml"), "--workers", "1"]
            done = command("detect", str(cell.folder), *rig, "-o", str(cell.corners))
        if done is None or done.returncode == 0:
            done = command("calibrate", str(cell.corners), "-o", str(out))
        one = {"kind": kind, "seed": seed, "number": number, **cell.drawn, "status": done.returncode}
        one |= {"render_s": rendered - begun, "calibrate_s": time.monotonic() - rendered}
        try:
            return one | compared(cell, rw.results.read_calibration(out))
        except RwhecError as error:
            return one | {"verdict": None, "said": f"{error}\n{done.stderr[-1500:]}"}


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command."""
    return subprocess.run(
        [sys.executable, "-m", "gtsam_rwhec", *arguments], capture_output=True, text=True, check=False
    )


def compared(cell: Cell, result: rw.results.Result) -> dict[str, Any]:
    """The verdict, and how far from the truth."""
    log, refined = result.log, result.refined
    if log is None or refined is None:
        return {"verdict": None, "said": result.judgement.reason}
    board = None if refined.reprojection is None else refined.reprojection.boards.get("board")
    middle = np.eye(4)
    if board is None or not any(name.startswith("warp") for name in board.names):
        middle[2, 3] = cell.height(*cell.board.corners()[:, :2].T).mean()
    turned = [cell.X @ middle @ np.diag([s, s, 1.0, 1.0]) for s in (1.0, -1.0)[: getattr(cell.board, "ways", 1)]]
    intrinsics: dict[str, Any] = {}
    for name, found in refined.intrinsics.items():
        if not intrinsics.keys() & set(found.shared_with):
            error = cell.cameras[name].parameters[:4] - found.values[:4]
            squared = float(error @ np.linalg.solve(refined.covariance(f"intrinsics:{name}")[:4, :4], error))
            inside = squared <= refined.squared_radius(4, LEVEL)
            intrinsics[name] = {"off_px": error.tolist(), "squared": squared, "inside": inside, "model": found.model}
    read = sum(track.used for track in log.detection.tracks)
    return {
        "verdict": result.judgement.verdict.value,
        "grounds": [ground.value for ground in result.judgement.grounds],
        "said": result.judgement.reason,
        "sensors": {name: off(refined, name, T) for name, T in cell.Y.items() if name in refined.Y},
        "targets": {"board": min((off(refined, "board", T) for T in turned), key=lambda at: float(at["deg"]))},
        "intrinsics": intrinsics,
        "images": sum(log.detection.images.values()),
        "read": read,
        "left_out": read - sum(count.used for count in log.outliers),
        "warp": [] if board is None else list(board.names),
    }


def off(refined: rw.fitting.RefinedPoses, name: str, truth: Array) -> dict[str, Any]:
    """The error of a frame, its squared deviations, and whether the truth is in the ellipsoids."""
    pose = (refined.X | refined.Y)[name]
    xi = rw.pose_covariances.error_of(pose, truth)
    return {
        "deg": float(np.degrees(np.linalg.norm(xi[:3]))),
        "mm": float(1e3 * np.linalg.norm(pose.translation() - truth[:3, 3])),
        "squared": float(xi @ refined.information(name) @ xi),
        "inside": refined.contains(name, truth, LEVEL),
        "far": not refined.contains(name, truth, FAR),
    }


def words(one: dict[str, Any]) -> str:
    """A cell in a line."""
    begin = f"{one['kind']:5} {one['number']:3} {one['stated']:8} {one['board']:18}"
    if one["verdict"] is None:
        return f"{begin} no answer: {' '.join(one['said'].split())[:200]}"
    each = "; ".join(f"{at['deg']:.4f} deg {at['mm']:.3f} mm {at['squared']:.1f}" for at in one["sensors"].values())
    return f"{begin} {one['verdict']:10} {each}; {one['left_out']} of {one['read']} left out, {one['images']} images"


def rows_of(name: str, found: list[dict[str, Any]], least: float, most: float) -> list[Row]:
    """The table of some cells."""
    answered = [one for one in found if one["verdict"] is not None]
    counted = [one for one in answered if one["verdict"] != "do_not_use"]
    table = []
    flat = [one for one in counted if not one["bent"]]
    for what, of in (("sensors", counted), ("targets", flat), ("intrinsics", counted)):
        share = Share.of([at["inside"] for one in of for at in one[what].values()])
        bar, met = f"{100 * least:.0f} to {100 * most:.0f} %", share.meets(least, most) if share.runs else None
        table.append(Row(f"{name}: {what} in their 95 % ellipsoids", str(share), bar, met))
    bent = Share.of([one["targets"]["board"]["inside"] for one in counted if one["bent"]])
    table.append(Row("  bent targets", str(bent)))
    far = [any(at["far"] for at in one["sensors"].values()) for one in answered if one["verdict"] == "use"]
    met = sum(far) <= max(1.0, len(found) / 300)
    table.append(Row("  USE, and a sensor is outside 99.99 %", f"{sum(far)} of {len(far)}", "<= 1 of 300", met))
    out, read, images = (sum(one[of] for one in answered) for of in ("left_out", "read", "images"))
    figure = f"{out} of {read}; {images} images"
    table.append(Row("  left out of those whose board is read", figure, "<= 1 %", out <= 0.01 * read))
    for unit in ("deg", "mm"):
        errors = [at[unit] for one in answered for at in one["sensors"].values()] or [np.nan]
        table.append(Row(f"  sensors' errors, {unit}: median, mean", f"{np.median(errors):.4f}, {np.mean(errors):.4f}"))
    counts = Counter([*(verdict.value for verdict in rw.Verdict), "no answer"])  # one too many of each
    counts.update(one["verdict"] or "no answer" for one in found)
    return [*table, Row("  verdicts", ", ".join(f"{verdict}: {count - 1}" for verdict, count in counts.items()))]


def rows(
    cells: int, seed: int, jobs: int, kinds: tuple[str, ...], folder: Path | None, keep: Path | None, each: bool
) -> list[Row]:
    """Run what is not kept yet; all tables."""
    asked = [(kinds[i % len(kinds)], seed, i // len(kinds)) for i in range(cells)]
    kept = {(one["kind"], one["seed"], one["number"]): one for one in bars.kept_lines(keep)}
    calls = [(*call, folder) for call in asked if call not in kept]
    for call, one in bars.each_done(run, calls, jobs, "cells"):
        bars.keep_line(keep, one)
        kept[call[:3]] = one
        if each:
            print(words(one), flush=True)
    found = [kept[call] for call in asked]
    table = [row for kind in kinds for row in rows_of(kind, [one for one in found if one["kind"] == kind], 0.92, 0.98)]
    return [*table, *rows_of("all", found, 0.93, 0.97)]


if __name__ == "__main__":
    bars.run_script(
        "{cells} rendered cells, calibrated by the command", rows, cells=300, seed=1, jobs=1, kinds=tuple(KINDS),
        folder=Path, keep=Path, each=False,
    )  # fmt: skip
