"""Images and poses of other people's robots: the detected targets move as the robot reports."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest

from gtsam_rwhec.files.yaml_lines import read_yaml
from gtsam_rwhec.logs import ImageRecord, PoseRecord, open_log
from gtsam_rwhec.logs.image_folder import write_image_folder

#: Of the circles: views that differ; the camera's intrinsics are nominal ones, so that turns agree to a few degrees.
CIRCLES = (0, 6, 8)


def angle_deg(R: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(gtsam.Rot3(R)))))


def assert_turns_agree(seen: list[np.ndarray], hand: list[np.ndarray], tolerance_deg: float) -> None:
    """Between two images the target turned against the camera by the angle that the hand turned against the base."""
    for i, j in combinations(range(len(seen)), 2):
        turned_deg = angle_deg(hand[i][:3, :3] @ hand[j][:3, :3].T)
        assert turned_deg > 3.0
        assert angle_deg(seen[i][:3, :3] @ seen[j][:3, :3].T) == pytest.approx(turned_deg, abs=tolerance_deg)


def test_a_grid_of_circles_before_a_wrist(circle_grid_10x10: Path, tmp_path: Path) -> None:
    """The library reads no circles: OpenCV does, here; images and poses come from the log that the library makes."""
    poses = sorted((circle_grid_10x10 / "poses").glob("*.yaml"))
    columns = ("x", "y", "z", "qx", "qy", "qz", "qw")
    lines = [f"{path.stem}, " + ", ".join(repr(read_yaml(path).data[key]) for key in columns) for path in poses]
    (tmp_path / "poses.csv").write_text("\n".join(lines), encoding="utf-8")
    counts = write_image_folder(circle_grid_10x10 / "images", tmp_path / "poses.csv", tmp_path / "log.mcap")
    assert counts == (15, 15)
    with open_log(tmp_path / "log.mcap") as log:
        records = list(log.records())
    images = {record.stamp_ns: record.data for record in records if isinstance(record, ImageRecord)}
    hand = {record.stamp_ns: record.T for record in records if isinstance(record, PoseRecord)}
    fields = read_yaml(circle_grid_10x10 / "cal_data.yaml").data["intrinsics"]
    K = np.array([[fields["fx"], 0.0, fields["cx"]], [0.0, fields["fy"], fields["cy"]], [0.0, 0.0, 1.0]])
    points = 0.0254 * np.array([[column, row, 0.0] for row in range(10) for column in range(10)])
    seen = []
    for stamp in (sorted(images)[k] for k in CIRCLES):
        image = cv2.imdecode(np.frombuffer(images[stamp], np.uint8), cv2.IMREAD_GRAYSCALE)
        found, circles = cv2.findCirclesGrid(image, (10, 10))
        assert found
        _, turn, _ = cv2.solvePnP(points, circles, K, np.zeros(4))
        seen.append(cv2.Rodrigues(turn)[0])
    # Here the hand carries the camera.
    assert_turns_agree(seen, [np.linalg.inv(hand[sorted(images)[k]]) for k in CIRCLES], tolerance_deg=4.0)
