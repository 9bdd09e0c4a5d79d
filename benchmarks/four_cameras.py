"""A folder like a workcell: four fixed cameras of 1080p about an arm with a board on its hand, for `thousand_images`.

It begins with the real images and poses of ``workcell_camera2``. All others are rendered: the calibrated board, drawn
at further poses of the hand over a real picture without a board; the other cameras stand a quarter turn further about
the arm each. So X and Y are known: they are those of the real camera's calibration.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from bars import SHARED
from loky import ProcessPoolExecutor
from numpy.typing import NDArray
from rwhec_factors import se3
from rwhec_factors.se3 import expmap, inverse

import gtsam_rwhec as rw

Array = NDArray[np.float64]
CAMERAS = ("camera1", "camera2", "camera3", "camera4")
REAL = "camera2"
#: Squares, their side in metres, and the white margin in squares; pixels of the drawing along a square.
SQUARES, SQUARE_M, MARGIN, PER_SQUARE = (4, 5), 0.05, 0.5, 64
K = np.array([[1371.02278154, 0.0, 960.5], [0.0, 1371.02278154, 540.5], [0.0, 0.0, 1.0]])
SAMPLES = 4
#: A board that is seen at more than this angle is not drawn.
STEEPEST_DEG = 75.0
#: Renderings are as unsure as the real images, whose boards' poses err by this much about and along each axis.
UNSURE_DEG, UNSURE_M = 0.1, 5e-4
RIG = """\
carriers: {{sensors: base, targets: hand, poses: {{frames: [base, hand]}}}}
sensors:
{sensors}
targets:
  board: {{type: checkerboard, inner_corners: [3, 4], square_m: 0.05}}
"""


@dataclass(frozen=True, eq=False)
class Cell:
    """The folder, its rig file, and the true poses."""

    folder: Path
    rig: Path
    X: Array
    Y: dict[str, Array]
    images: int


def workcell() -> Path:
    """The folder with the real images."""
    return SHARED / "workcell_camera2"


def rig_text(cameras: tuple[str, ...], prefix: bool) -> str:
    """The rig file of cameras, each with a folder of its own if `prefix`."""
    lines = []
    for name in cameras:
        at = f"{name}/" if prefix else ""
        lines.append(f"  {name}: {{images: {at}image, poses: {at}pose, intrinsics: {at}intrinsic_pars_file.yaml}}")
    return RIG.format(sensors="\n".join(lines))


def made_cell(folder: Path, each: int, seed: int = 0) -> Cell:
    """Make the folder with `each` images a camera, unless it is there; the real ones count among camera2's."""
    folder.mkdir(parents=True, exist_ok=True)
    rig = folder.with_name(f"{folder.name}.yaml")
    rig.write_text(rig_text(CAMERAS, prefix=True), encoding="utf-8")
    X, real = _calibrated(folder.with_name(f"{folder.name}_real"))
    names = sorted(path.stem for path in (workcell() / "image").iterdir())
    A_real = np.array([np.loadtxt(workcell() / "pose" / f"{name}.csv") for name in names])
    middle = (A_real @ X)[:, :3, 3].mean(axis=0) * [1.0, 1.0, 0.0]
    Y = {name: _turned(real, middle, 90.0 * (k - 1)) for k, name in enumerate(CAMERAS)}
    cell = Cell(folder, rig, X, Y, each * len(CAMERAS))
    if (folder / "made").is_file() and (folder / "made").read_text() == f"{each} {seed}":
        return cell
    rng = np.random.default_rng(seed)
    A = np.concatenate([A_real, _further(A_real, X, middle, each - len(names), rng)])
    jobs = []
    for camera in CAMERAS:
        for kind in ("image", "pose"):
            shutil.rmtree(folder / camera / kind, ignore_errors=True)
            (folder / camera / kind).mkdir(parents=True)
        shutil.copyfile(workcell() / "intrinsic_pars_file.yaml", folder / camera / "intrinsic_pars_file.yaml")
        for k, T in enumerate(A):
            np.savetxt(folder / camera / "pose" / f"{k:04d}.csv", T)
            path = folder / camera / "image" / f"{k:04d}.png"
            if camera == REAL and k < len(names):
                shutil.copyfile(workcell() / "image" / f"{names[k]}.png", path)
            else:
                off = expmap(rng.normal(size=(1, 6)) * np.repeat([np.radians(UNSURE_DEG), UNSURE_M], 3))[0]
                jobs.append((path, inverse(Y[camera]) @ T @ X @ off))
    with ProcessPoolExecutor(2) as pool:
        list(pool.map(_draw, *zip(*jobs, strict=True), chunksize=16))
    (folder / "made").write_text(f"{each} {seed}")
    return cell


def _calibrated(out: Path) -> tuple[Array, Array]:
    """X of the board and Y of the real camera, from its real images."""
    rig = out.with_suffix(".yaml")
    rig.write_text(rig_text((REAL,), prefix=False), encoding="utf-8")
    if not (out / "result.json").is_file():
        rw.calibrate_log(workcell(), rw.rig.read_rig(rig), out)
    result = rw.results.read_result(out / "result.json")
    assert result.refined is not None
    return result.refined.X["board"].matrix(), result.refined.Y[REAL].matrix()


def _turned(Y: Array, middle: Array, degrees: float) -> Array:
    """The camera, turned about the vertical through the arm."""
    turn = se3.pose(cv2.Rodrigues(np.radians([0.0, 0.0, degrees]))[0], np.zeros(3))
    turn[:3, 3] = middle - turn[:3, :3] @ middle
    return turn @ Y


def _further(A_real: Array, X: Array, middle: Array, number: int, rng: np.random.Generator) -> Array:
    """Further poses of the hand: real ones turned by any angle about the arm, and moved a little."""
    result = []
    for k in range(number):
        moved = se3.pose(cv2.Rodrigues(rng.normal(scale=np.radians(12.0), size=3))[0], rng.normal(scale=0.05, size=3))
        result.append(_turned(A_real[k % len(A_real)], middle, rng.uniform(0.0, 360.0)) @ X @ moved @ inverse(X))
    return np.array(result).reshape(-1, 4, 4)


def _print() -> Array:
    """The board's picture, 0 to 1, with its margin."""
    rows, columns = np.indices(SQUARES[::-1])
    squares = ((rows + columns) % 2).astype(float)
    picture = np.kron(squares, np.ones((PER_SQUARE, PER_SQUARE)))
    return np.pad(picture, round(MARGIN * PER_SQUARE), constant_values=1.0)


def _draw(path: Path, T: Array) -> None:
    """Write one picture: the board at T_camera_board over a real picture without one."""
    empty = sorted((workcell() / "image").iterdir())[0]
    image = cv2.imread(str(empty), cv2.IMREAD_GRAYSCALE).astype(np.float64)
    picture = _print()
    height, width = picture.shape
    step = SQUARE_M / PER_SQUARE
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]) - 0.5
    plane = step * (corners - 0.5 * (np.array([width, height]) - 1.0)) * [1.0, -1.0]
    in_camera = np.column_stack([plane, np.zeros(4)]) @ T[:3, :3].T + T[:3, 3]
    angle = np.degrees(np.arccos(-(T[:3, 2] @ T[:3, 3]) / np.linalg.norm(T[:3, 3])))
    if in_camera[:, 2].min() > 0.2 and angle < STEEPEST_DEG:
        pixels = in_camera @ K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 4, 0)
        high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 5, [image.shape[1], image.shape[0]])
        if (high - low > 8).all():
            fine = SAMPLES * (pixels - low + 0.5) - 0.5
            H = cv2.getPerspectiveTransform(corners.astype(np.float32), fine.astype(np.float32))
            size = tuple(int(n) for n in SAMPLES * (high - low))
            drawn = cv2.warpPerspective(picture.astype(np.float32), H, size, borderValue=-1.0)
            here = np.kron(image[low[1] : high[1], low[0] : high[0]], np.ones((SAMPLES, SAMPLES)))
            here = np.where(drawn >= 0.0, 255.0 * drawn, here)
            mean = here.reshape(high[1] - low[1], SAMPLES, high[0] - low[0], SAMPLES).mean(axis=(1, 3))
            image[low[1] : high[1], low[0] : high[0]] = mean
    colour = cv2.cvtColor(np.clip(np.rint(image), 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    if not cv2.imwrite(str(path), colour):
        raise OSError(f"{path} cannot be written")
