"""First rig files of folders of images: what is found in the folders, what is guessed of it, and what fails."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.targets import Tag
from gtsam_rwhec.detect.detector import Detection
from gtsam_rwhec.errors import RigError
from gtsam_rwhec.rig import CheckerboardTarget, Rig, parse_rig, propose_folder_rig
from gtsam_rwhec.rig.folder_contents import FolderPoses, ImageFolder, cloud_folders, is_folder_without_logs, read_folder
from gtsam_rwhec.rig.folder_proposal import View, best_reading
from gtsam_rwhec.rig.target_sections import CircleGridTarget


def proposed(folder: Path) -> tuple[Rig, str, str]:
    text, notes = propose_folder_rig(folder, "rig.yaml")
    return parse_rig(text, "rig.yaml", folder), " ".join(text.replace("\n  #", "").split()), "\n".join(notes)


def some_of(folder: Path, whole: Path, images: str, number: int) -> Path:
    """The folder with this number of its images, spread over all, and the rest as it is."""
    shutil.copytree(whole, folder, ignore=shutil.ignore_patterns("*.png"))
    files = sorted((whole / images).glob("*.png"))
    for i in np.linspace(0, len(files) - 1, number).round().astype(int):
        shutil.copy(files[i], folder / images)
    return folder


def test_a_workcell_with_a_checkerboard_on_the_hand(workcell_camera2: Path, tmp_path: Path) -> None:
    rig, text, notes = proposed(some_of(tmp_path / "cell", workcell_camera2, "image", 9))
    assert (rig.carriers.sensors, rig.carriers.targets) == ("base", "hand")  # by solving both ways
    assert rig.carriers.poses.frames == ("base", "hand")
    assert "solved both ways over" in text
    assert "the cameras are on base, and the targets on hand" in notes
    (sensor,) = rig.sensors.values()
    assert (sensor.images, sensor.poses, sensor.time_offset) == ("image", "pose", 0.0)
    assert "were taken at rest, so no clock is estimated" in text
    assert sensor.intrinsics is not None
    assert sensor.intrinsics.file == "intrinsic_pars_file.yaml"
    (board,) = rig.targets.values()
    assert isinstance(board, CheckerboardTarget)
    assert sorted(board.inner_corners) == [3, 4]
    assert board.square_m == pytest.approx(0.05, rel=0.02)  # the motion says it
    assert text.count("TODO") == 2  # of the head, and of the board's size
    assert "9 with a pose in pose" in notes


def test_an_arm_with_a_camera_over_a_grid_of_circles(circle_grid_10x10: Path, tmp_path: Path) -> None:
    rig, text, _ = proposed(some_of(tmp_path / "grid", circle_grid_10x10, "images", 6))
    assert (rig.carriers.sensors, rig.carriers.targets) == ("hand", "base")
    (grid,) = rig.targets.values()
    assert isinstance(grid, CircleGridTarget)
    assert (grid.circles, grid.larger_dot) == ((10, 10), True)
    assert grid.spacing_m == pytest.approx(0.0254, rel=0.05)
    (sensor,) = rig.sensors.values()
    assert sensor.intrinsics is not None
    assert sensor.intrinsics.estimate == "any"  # no file has them, and the board's views determine them
    (shown,) = re.findall(r"views of the board: f = (\d+) px", text)
    assert float(shown) == pytest.approx(530, rel=0.05)
    assert "no file has them: the images say them (6 views" in text


def blank_images(folder: Path, number: int = 3) -> None:
    folder.mkdir(parents=True)
    for i in range(number):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((48, 64), 200, np.uint8))


def test_nothing_is_seen(tmp_path: Path) -> None:
    for camera in ("left", "right"):
        blank_images(tmp_path / camera / "images")
        lines = [f"{i}.png, {0.1 * i}, 0, 0.5, 0, 0, 0, 1" for i in range(3)]
        (tmp_path / camera / "poses.csv").write_text("\n".join(lines))
    rig, text, notes = proposed(tmp_path)
    assert [(s.images, s.poses) for s in rig.sensors.values()] == [
        ("left/images", "left/poses.csv"), ("right/images", "right/poses.csv"),
    ]  # fmt: skip
    assert list(rig.sensors) == ["left", "right"]
    assert "TODO an example: no targets were seen" in text
    assert "TODO the images cannot tell what carries the sensors" in text
    assert "TODO no file has them, and this is a usual lens" in text
    assert "no target in 6 images" in notes


def test_no_poses_and_no_images(tmp_path: Path) -> None:
    with pytest.raises(RigError, match="no folder in it has two images"):
        propose_folder_rig(tmp_path, "rig.yaml")
    blank_images(tmp_path / "images")
    with pytest.raises(RigError, match=r"images \(3 images\), and no file of poses that fits them. Put the robot's"):
        propose_folder_rig(tmp_path, "rig.yaml")


def with_poses(folder: Path) -> list[tuple[ImageFolder, FolderPoses]]:
    return [(camera, camera.poses) for camera in read_folder(folder) if camera.poses is not None]


TAG = Tag("tag", "tag36h11", 0, 0.1)
COUNT = 12


def written(folder: Path, rotation: str) -> list[View]:
    """A folder whose poses have rotations of this kind, and what a camera on the hand sees."""
    rng = np.random.default_rng(11)
    X, Y = se3.expmap(rng.normal(size=(2, 6)))
    T = se3.expmap(np.concatenate([0.8 * rng.normal(size=(COUNT, 3)), 0.4 * rng.normal(size=(COUNT, 3))], axis=1))
    B = se3.inverse(X) @ se3.inverse(T) @ Y @ se3.expmap(1e-3 * rng.normal(size=(COUNT, 6)))
    turned = Rotation.from_matrix(T[:, :3, :3])
    numbers = {
        "xyzw": turned.as_quat(),
        "wxyz": np.roll(turned.as_quat(), 1, axis=1),
        "xyz degrees": turned.as_euler("xyz", degrees=True),
        "ZYZ radians": turned.as_euler("ZYZ"),
        "vector": turned.as_rotvec(),
    }[rotation]
    lines = []
    for i in range(COUNT):
        cv2.imwrite(str(folder / f"view_{i}.png"), np.full((48, 64), 99, np.uint8))
        lines.append(", ".join([f"view_{i}.png", *(repr(float(x)) for x in (*T[i, :3, 3], *numbers[i]))]))
    (folder / "poses.csv").write_text("\n".join(lines), encoding="utf-8")
    views = []
    for i, name in enumerate(read_folder(folder)[0].files):
        number = int(name.stem.removeprefix("view_"))
        candidates = np.stack([B[number], np.full((4, 4), np.nan)])
        detection = Detection(
            "tag", np.zeros((4, 2)), np.arange(4), candidates, np.array([0.1, np.nan]), np.zeros(2),
            np.tile(1e-6 * np.eye(6), (2, 1, 1)), 50.0, 1.0,
        )  # fmt: skip
        views.append(View(0, i, "camera", TAG, detection))
    return views


@pytest.mark.parametrize(
    ("rotation", "stated"),
    [
        ("xyzw", (None, None, None)),
        ("wxyz", ("wxyz", None, None)),
        ("xyz degrees", (None, "xyz", "degrees")),
        ("ZYZ radians", (None, "ZYZ", "radians")),
        ("vector", (None, "rotation_vector", "radians")),
    ],
)
def test_the_reading_is_found(tmp_path: Path, rotation: str, stated: tuple[str | None, ...]) -> None:
    views = written(tmp_path, rotation)
    reading = best_reading(tmp_path, with_poses(tmp_path), views)
    said = reading.stated
    assert (said.quaternion, said.euler, said.angles) == stated
    assert reading.evidence.role == "child"
    assert (reading.otherwise is None) == (rotation == "xyzw")


def test_too_few_images_change_nothing(tmp_path: Path) -> None:
    views = written(tmp_path, "wxyz")[:4]
    reading = best_reading(tmp_path, with_poses(tmp_path), views)
    assert reading.stated.quaternion is None
    assert reading.evidence.role is None


OST = """\
image_width: 64
image_height: 48
camera_matrix: {rows: 3, cols: 3, data: [60, 0, 32, 0, 60, 24, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""


def images(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.full((48, 64), 99, np.uint8))


def lines(names: list[str], rest: str = "0, 0, 0, 1", step: float = 0.1) -> str:
    return "\n".join(f"{name}, {step * i}, 0, 0, {rest}" for i, name in enumerate(names))


def test_poses_beside_and_intrinsics_above(tmp_path: Path) -> None:
    names = [f"view_{i}.png" for i in range(4)]
    images(tmp_path / "a", names)
    (tmp_path / "robot.txt").write_text(lines(names[:3]))
    (tmp_path / "ost.yaml").write_text(OST)
    (tmp_path / "other.yaml").write_text(OST.replace("64", "640"))
    (tmp_path / "notes.txt").write_text("nothing of use\n")
    (folder,) = read_folder(tmp_path)
    assert (folder.path, folder.size, len(folder.files)) == ("a", (64, 48), 4)
    assert folder.poses is not None
    assert folder.poses.path == "robot.txt"
    np.testing.assert_allclose(folder.poses.T[:3, 0, 3], [0.0, 0.1, 0.2])
    assert np.isnan(folder.poses.T[3]).all()
    assert (folder.intrinsics, folder.camera_name) == ("ost.yaml", "")
    assert folder.camera is not None


def test_each_camera_has_its_own(tmp_path: Path) -> None:
    names = ["0001.png", "0002.png"]
    for camera in ("cam0", "cam1"):
        images(tmp_path / camera / "image", names)
        (tmp_path / camera / "poses.csv").write_text(lines(names))
        (tmp_path / camera / "camera.yaml").write_text(OST)
    found = read_folder(tmp_path)
    assert [(f.path, f.poses and f.poses.path, f.intrinsics) for f in found] == [
        (f"{c}/image", f"{c}/poses.csv", f"{c}/camera.yaml") for c in ("cam0", "cam1")
    ]


@pytest.mark.parametrize(
    ("rest", "step", "stated"),
    [("0, 0, 0, 1", 200.0, (None, "mm")), ("10, 20, 30", 0.1, ("ZYX", None)), ("0, 0, 90", 200.0, ("ZYX", "mm"))],
)
def test_what_files_do_not_say(tmp_path: Path, rest: str, step: float, stated: tuple[str | None, str | None]) -> None:
    names = ["1.png", "2.png", "3.png"]
    images(tmp_path, names)
    (tmp_path / "poses.csv").write_text(lines(names, rest, step))
    (folder,) = read_folder(tmp_path)
    assert folder.path == "."
    assert folder.poses is not None
    assert (folder.poses.stated.euler, folder.poses.stated.length) == stated


def test_stamps(tmp_path: Path) -> None:
    images(tmp_path / "images", [f"{1700000000 + i}000000000.png" for i in range(3)])
    (tmp_path / "tum.txt").write_text("\n".join(f"{1700000000 + 0.5 * i:.1f} {0.1 * i} 0 0 0 0 0 1" for i in range(5)))
    (folder,) = read_folder(tmp_path)
    assert folder.poses is not None
    assert folder.poses.stamps_ns is not None
    np.testing.assert_allclose(folder.poses.T[:, 0, 3], [0.0, 0.2, 0.4])


def test_logs_are_no_folders_of_images(tmp_path: Path) -> None:
    assert is_folder_without_logs(tmp_path)
    (tmp_path / "run.mcap").touch()
    assert not is_folder_without_logs(tmp_path)
    assert not is_folder_without_logs(tmp_path / "run.mcap")


def test_depth_images_are_clouds_and_their_intrinsics_are_asked_for(tmp_path: Path) -> None:
    """Each of calibrate and init said to use the other."""
    depths = np.full((40, 60), 500, np.uint16)
    depths[:5] = 0
    (tmp_path / "frames").mkdir()
    for number in range(3):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.Depth.png"), depths)
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.color.png"), depths.astype(np.uint8))
    (tmp_path / "poses.txt").write_text("0.1 0.2 0.3 0 0 0 1\n" * 3, encoding="utf-8")
    (found,) = cloud_folders(tmp_path)
    assert (found.path, found.size, len(found.files)) == ("frames/*Depth*.png", (60, 40), 3)
    with pytest.raises(RigError, match=r"depth images of 60 x 40 in .*Write frames/depth.yaml") as refused:
        rw.calibrate_log(tmp_path, None, tmp_path / "out")
    text = re.sub(r"\b[fc][xy]\b", "50.0", re.findall(r": (\{image_width.*\}), or", str(refused.value))[0])
    (tmp_path / "frames" / "depth.yaml").write_text(text, encoding="utf-8")
    (found,) = cloud_folders(tmp_path)
    assert found.camera is not None
    assert (found.intrinsics, found.camera.K[0, 0]) == ("frames/depth.yaml", 50.0)


def test_images_of_16_bits_that_see_something_everywhere_are_no_depths(tmp_path: Path) -> None:
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((40, 60), 500 + number, np.uint16))
    assert not cloud_folders(tmp_path)
    (found,) = read_folder(tmp_path)
    assert found.size == (60, 40)


def test_poses_that_are_more_than_the_clouds_are_said(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0.1, 1.0, (200, 3))
    for number in range(3):
        np.save(tmp_path / f"view{number}.npy", points)
    rows = ("0.1, 0.2, 0.3, 0.4, 0.5, 0.6\n" * 4, "0.1 0.2 0.3 0 0 0 1\n" * 4)
    for text in rows:
        (tmp_path / "poses.txt").write_text(text, encoding="utf-8")
        with pytest.raises(RigError, match=r"no file of poses that fits them; .*poses.txt: 3 clouds and 4 poses"):
            propose_folder_rig(tmp_path, tmp_path / "rig.yaml")
