"""Files of poses that do not say what their numbers mean: the reading that explains the images is found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

from gtsam_rwhec.cameras.targets import Tag
from gtsam_rwhec.detect.detector import Detection
from gtsam_rwhec.rig.folder_contents import read_folder
from gtsam_rwhec.rig.folder_proposal import View, best_reading

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
    reading = best_reading(tmp_path, read_folder(tmp_path), views)
    said = reading.stated
    assert (said.quaternion, said.euler, said.angles) == stated
    assert reading.evidence.role == "child"
    assert (reading.otherwise is None) == (rotation == "xyzw")


def test_too_few_images_change_nothing(tmp_path: Path) -> None:
    views = written(tmp_path, "wxyz")[:4]
    reading = best_reading(tmp_path, read_folder(tmp_path), views)
    assert reading.stated.quaternion is None
    assert reading.evidence.role is None
