"""What is found in folders: poses that fit the images, in any file; what they do not say; intrinsics of their size."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gtsam_rwhec.rig.folder_contents import is_folder_without_logs, read_folder

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
