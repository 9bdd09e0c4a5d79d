"""First rig files of folders of images: of two of other people `init` and a ruler are enough; and what fails."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from gtsam_rwhec.errors import RigError
from gtsam_rwhec.rig import CheckerboardTarget, Rig, parse_rig, propose_folder_rig
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
