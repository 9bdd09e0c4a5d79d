"""Mistakes of a first user, each as it is made on the command line: exit status not 0, the fault and its cure in words.

The cells are small: a board that is drawn into images of 320 x 240 pixels, and a log of detections.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import rendered
import synthetic_logs as made
from given_commands import command
from scipy.spatial.transform import Rotation

from gtsam_rwhec.cameras.targets import Checkerboard, Tag

pytestmark = pytest.mark.usefixtures("without_figures")

IMAGES = 10
INTRINSICS = "{K: [300.0, 302.0, 157.0, 121.5], size: [320, 240]}"
CELL = f"""\
carriers: {{sensors: hand, targets: base, poses: {{frames: [base, hand]}}}}
sensors:
  left: {{images: left/image, poses: left/pose, intrinsics: {INTRINSICS}}}
targets:
  board: {{type: checkerboard, inner_corners: [5, 4], square_m: 0.03}}
"""
OF_A_FILE = CELL.replace("left/pose", "poses.txt")
Change = Callable[[Path], object]


@pytest.fixture(scope="session")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a user has it: a board on a table, seen by a camera on a hand, and the hand's poses."""
    folder, rng = tmp_path_factory.mktemp("mistakes") / "cell", np.random.default_rng(1)
    for part in ("image", "pose"):
        (folder / "left" / part).mkdir(parents=True)
    board = rendered.printed(Checkerboard("board", 5, 4, 0.03))
    X, Y = made.pose((0, 0, 10), (0.4, 0.1, 0.0)), made.pose((4, -6, 20), (0.06, 0.02, 0.04))
    for i in range(IMAGES):
        aside = rng.uniform((-0.02, -0.02, 0.42), (0.02, 0.02, 0.52))
        seen = rendered.pose(tuple(rng.uniform((-35, -35, -70), (35, 35, 70))), tuple(aside))
        cv2.imwrite(
            str(folder / "left" / "image" / f"{i:04d}.png"), rendered.render(rendered.PINHOLE, [(board, seen)], seed=i)
        )
        np.savetxt(folder / "left" / "pose" / f"{i:04d}.csv", X @ np.linalg.inv(Y @ seen), delimiter=",")
    return folder


def poses_of(folder: Path) -> list[Path]:
    return sorted((folder / "left" / "pose").iterdir())


def each_pose(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Other poses in the files of a folder."""

    def changed(folder: Path) -> None:
        for path in poses_of(folder):
            np.savetxt(path, change(np.loadtxt(path, delimiter=",")), delimiter=",")

    return changed


def millimetres(T: np.ndarray) -> np.ndarray:
    return T * np.array([[1.0, 1.0, 1.0, 1000.0]] * 3 + [[1.0] * 4])


def one_file(rotation: Callable[[Rotation], np.ndarray], places: int = IMAGES) -> Change:
    """All poses in one file of rows with a name, a position and a rotation."""

    def written(folder: Path) -> None:
        rows = []
        for path in poses_of(folder)[:places]:
            T = np.loadtxt(path, delimiter=",")
            numbers = [*T[:3, 3].tolist(), *rotation(Rotation.from_matrix(T[:3, :3])).tolist()]
            rows.append(f"{path.stem}.png {' '.join(map(repr, numbers))}")
        (folder / "poses.txt").write_text("\n".join(rows))

    return written


def euler(**given: str) -> str:
    """A rig file of one file of Euler angles."""
    return OF_A_FILE.replace("hand]}", f"hand], {', '.join(f'{key}: {value}' for key, value in given.items())}}}")


def image(change: Callable[[Path], object], number: int = 3) -> Change:
    return lambda folder: change(folder / "left" / "image" / f"{number:04d}.png")


def of_a_tag(folder: Path) -> None:
    """Two of the images show a tag in place of the board."""
    tag = rendered.printed(Tag("tag", "tag36h11", 3, 0.1))
    for number in range(IMAGES):
        picture = rendered.render(rendered.PINHOLE, [(tag, rendered.pose((10.0 * (number % 3), 0, 0), (0, 0, 0.5)))])
        cv2.imwrite(str(folder / "left" / "image" / f"{number:04d}.png"), picture)


def few_images(folder: Path) -> None:
    for path in [*poses_of(folder)[3:], *sorted((folder / "left" / "image").iterdir())[3:]]:
        path.unlink()


def one_axis(folder: Path) -> None:
    """The hand turns about the board's normal alone; the images are what the camera then sees."""
    board, rng = rendered.printed(Checkerboard("board", 5, 4, 0.03)), np.random.default_rng(2)
    X, Y = made.pose((0, 0, 10), (0.4, 0.1, 0.0)), made.pose((4, -6, 20), (0.06, 0.02, 0.04))
    first = Y @ rendered.pose((10, -15, 0), (0, 0, 0.45)) @ np.linalg.inv(X)
    for number, path in enumerate(poses_of(folder)):
        A = first @ made.pose((0, 0, 14.0 * number), (0, 0, 0))
        seen = np.linalg.inv(Y) @ A @ X
        seen[:3, 3] = [*rng.uniform(-0.02, 0.02, 2), 0.47]
        A = Y @ seen @ np.linalg.inv(X)
        picture = rendered.render(rendered.PINHOLE, [(board, seen)], seed=number)
        cv2.imwrite(str(folder / "left" / "image" / f"{number:04d}.png"), picture)
        np.savetxt(path, np.linalg.inv(A), delimiter=",")


def blank_camera(folder: Path) -> None:
    shutil.copytree(folder / "left", folder / "right")
    for path in (folder / "right" / "image").iterdir():
        cv2.imwrite(str(path), np.full((240, 320), 128, dtype=np.uint8))


def db3(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 5}")
    (folder / "run_0.db3").write_bytes(b"SQLite format 3\0")


RIGHT = f"  right: {{images: right/image, poses: right/pose, intrinsics: {INTRINSICS}}}\ntargets:\n"
OF_A_LOG = CELL.replace("frames:", "tf:").replace("poses: left/pose, ", "")


@dataclasses.dataclass(frozen=True)
class Mistake:
    """A rig file, what is done to the folder, the exit status, and words that name the fault and the cure."""

    rig: str
    status: int
    words: tuple[str, ...]
    change: Change = lambda _: None


FOLDERS = {
    # The rig file
    "carriers exchanged": Mistake(
        CELL.replace("sensors: hand, targets: base", "sensors: base, targets: hand"), 6,
        ("exchange `sensors` and `targets` in the rig file", "line 1: carriers.sensors and carriers.targets",
         "or, if base does carry the sensors, the files have T_hand_base: write frames: [hand, base]"),
    ),
    "board in millimetres": Mistake(
        CELL.replace("0.03", "30"), 2, ("line 5: targets.board.square_m: 30 m", "if it is in millimetres, write 0.03"),
    ),
    "board 3 % too large": Mistake(
        CELL.replace("0.03}", "0.0309}"), 6,
        ("the stated size of board is 3", "% too large", "line 5", "measure the named targets again"),
    ),
    "columns and rows": Mistake(
        CELL.replace("inner_corners: [5, 4]", "columns: 5, rows: 4"), 2, ("inner_corners: is missing: [across, down]",),
    ),
    "a key that is misspelt": Mistake(
        CELL.replace("intrinsics:", "intrinsic:"), 2, ("line 3: sensors.left.intrinsic: unknown key; did you mean",),
    ),
    "no intrinsics": Mistake(
        CELL.replace(f", intrinsics: {INTRINSICS}", ""), 2, ("sensors.left: images without intrinsics; give FILE",),
    ),
    "a file of intrinsics that is not there": Mistake(
        CELL.replace(INTRINSICS, "left.yaml"), 2, ("left.yaml", "line 3: sensors.left.intrinsics"),
    ),
    "intrinsics of a model that is not supported": Mistake(
        CELL.replace(INTRINSICS, "cameras.txt"), 2,
        ("cameras.txt, line 1: the model 'FOV' is not supported; supported are SIMPLE_PIN", "sensors.left.intrinsics"),
        lambda folder: (folder / "cameras.txt").write_text("1 FOV 320 240 300 302 157 121 0.9\n"),
    ),
    "one of two cameras in a file, without its name": Mistake(
        CELL.replace(INTRINSICS, "cameras.txt"), 2,
        ("has no camera of the sensor's name, 'left'; it has 1, 2: write {file: cameras.txt, camera: '1'}",),
        lambda folder: (folder / "cameras.txt").write_text(
            "1 PINHOLE 320 240 300 302 157 121\n2 PINHOLE 320 240 300 302 157 121\n"
        ),
    ),
    "intrinsics of twice the size": Mistake(
        CELL.replace(INTRINSICS, "{K: [600.0, 604.0, 314.5, 243.5], size: [640, 480]}"), 2,
        ("320 x 240 pixels, but the intrinsics are for 640 x 480", "line 3: sensors.left.intrinsics"),
    ),
    "the same images for two cameras": Mistake(
        CELL.replace("targets:\n  board", RIGHT.replace("right/", "left/") + "  board"), 2,
        ("left/image is also the topic or path of sensor left; each sensor needs its own",),
    ),
    "poses of another pair of frames": Mistake(
        CELL.replace("[base, hand]", "[base, tool0]"), 2,
        ("poses of tool0 in base are not poses of the carriers; name hand and base",),
    ),
    "no poses": Mistake(CELL.replace("poses: left/pose, ", ""), 2, ("sensors.left: no poses. Name the file or",)),
    "poses that are not there": Mistake(
        CELL.replace("left/pose", "left/poses"), 2, ("left/poses", "sensors.left.poses"),
    ),
    "a folder of images that is not there": Mistake(
        CELL.replace("left/image", "left/images"), 2,
        ("there is no such folder of images", "left has images in image", "line 3: sensors.left.images"),
    ),
    "an IMU's file for poses": Mistake(
        CELL.replace("left/pose", "imu0.csv"), 2,
        ("imu0.csv, line 1: ", "Are they the rates and accelerations of an IMU?", "line 3: sensors.left.poses"),
        lambda folder: (folder / "imu0.csv").write_text(
            "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z\n" + "17,0,0,0,0,0,9.81\n" * 3
        ),
    ),
    "a rig file of a log for a folder": Mistake(
        OF_A_LOG, 2, ("carriers.poses is of a log", "write poses: {frames: [base, hand]}, and for each sensor"),
    ),
    "a bag for a folder": Mistake(OF_A_LOG, 2, ("is a ROS 2 bag of db3 files", "gtsam-rwhec convert"), db3),
    # The poses
    "poses in millimetres": Mistake(
        CELL, 2, ("Are they millimetres? Write length: mm where the rig file has the frames",), each_pose(millimetres),
    ),
    "transposed matrices": Mistake(
        CELL, 2, ("has the position in the last row: transpose it",), each_pose(np.transpose),
    ),
    "quaternions w, x, y, z": Mistake(
        OF_A_FILE, 6,
        ("the quaternions of A are wxyz, and were read as xyzw", "write quaternion: wxyz beside the frames"),
        one_file(lambda R: R.as_quat()[[3, 0, 1, 2]]),
    ),
    "Euler angles without a convention": Mistake(
        OF_A_FILE, 2, ("three angles", "euler:", "angles: degrees"), one_file(lambda R: R.as_euler("xyz")),
    ),
    "Euler angles of another convention": Mistake(
        euler(euler="ZYX", angles="radians"), 6,
        ("the files' angles are not euler: ZYX", "line 1: carriers.poses.euler", "write the axes in the order of the"),
        one_file(lambda R: R.as_euler("xyz")),
    ),
    "degrees for radians": Mistake(
        euler(euler="xyz", angles="radians"), 2,
        ("more than a turn in radians. Are they degrees? Write angles: degrees",),
        one_file(lambda R: R.as_euler("xyz", degrees=True)),
    ),
    "poses of other names": Mistake(
        CELL, 2, ("no pose has the name of an image", "Give both the same names or numbers"),
        lambda folder: [path.rename(path.with_name(f"at_{chr(97 + int(path.stem))}.csv")) for path in poses_of(folder)],
    ),
    # The images and the motion
    "a camera that saw nothing": Mistake(
        CELL.replace("targets:\n  board", RIGHT + "  board"), 6,
        ("right: 0 measurements (its 10 images show no target), at least 3 poses with two turning axes are needed",
         "Not written, as the poses are not to be used: static_tf.launch.py"),
        blank_camera,
    ),
    "too few images": Mistake(
        CELL, 3, ("3 measurements are too few to tell", "measure at 10 poses or more"), few_images,
    ),
    "one axis only": Mistake(
        CELL, 3, ("the measurements do not determine all poses", "turn the carriers about at least two different axes"),
        one_axis,
    ),
    "a tag of another family": Mistake(
        CELL.replace("checkerboard, inner_corners: [5, 4], square_m: 0.03", "tag, family: tag25h9, id: 3, size_m: 0.1"),
        2, ("tags of tag36h11",), of_a_tag,
    ),
    "squares counted for corners": Mistake(
        CELL.replace("[5, 4]", "[6, 5]"), 2, ("inner_corners: [5, 4]",), few_images,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FOLDERS)
def test_of_a_folder(name: str, cell: Path, tmp_path: Path) -> None:
    mistake, folder = FOLDERS[name], tmp_path / "cell"
    shutil.copytree(cell, folder)
    (tmp_path / "rig.yaml").write_text(mistake.rig, encoding="utf-8")
    mistake.change(folder)
    status, said = command("calibrate", folder, "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "out")
    assert status == mistake.status, said
    for words in mistake.words:
        assert words in said
    if status == 2:  # nothing is left behind that looks like a result
        assert not (tmp_path / "out" / "result.json").exists()


def corrupt(path: Path) -> None:
    path.write_bytes(b"not a picture")


def mirrored(path: Path) -> None:
    cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path)), 1))


def test_one_bad_image_costs_one_image_and_is_named(cell: Path, tmp_path: Path) -> None:
    """No mistake that ends a run: the others have the answer, so the exit status is 0, and the image is named."""
    folder = shutil.copytree(cell, tmp_path / "cell")
    corrupt(folder / "left" / "image" / "0003.png")
    mirrored(folder / "left" / "image" / "0005.png")
    (tmp_path / "rig.yaml").write_text(CELL, encoding="utf-8")
    run = ("calibrate", folder, "--rig", tmp_path / "rig.yaml", "--verbose", "-o", tmp_path / "out")
    status, said = command(*run)
    assert status == 0, said
    assert "1 image of left could not be used. The first: left/image/0003.png" in said
    assert "of board-left), because they are farther off than the noise of the others explains" in said

    # And what is there is not replaced, unless that is said.
    status, again = command(*run)
    assert status == 2
    assert "--force" in again
    out = tmp_path / "mine"
    out.mkdir()
    (out / "thesis.tex").write_text("text")
    status, foreign = command(*run[:-1], out)
    assert status == 2
    assert "thesis.tex" in foreign
    assert [path.name for path in out.iterdir()] == ["thesis.tex"]
    assert command("export", tmp_path / "out" / "calibration.mcap", "-o", tmp_path / "files", "--anyway")[0] == 0


def test_images_without_a_rig_file(cell: Path, tmp_path: Path) -> None:
    status, said = command("calibrate", cell, "-o", tmp_path / "out")
    assert status == 2
    assert "has images. They need a rig file: --rig FILE" in said
    assert "gtsam-rwhec init" in said
