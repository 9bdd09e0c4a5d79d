"""The commands on logs as people type them, one after the other, on the beginning of the shipped log."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from given_commands import given
from ros2_twin import CELL, write_twins
from typer.testing import Result

import gtsam_rwhec as rw
from gtsam_rwhec.logs import ImageRecord, open_log

IMAGES = 5
#: `init` looks for the tags of every family in each image.
IMAGES_OF_INIT = 1


def run(*arguments: object, status: int = 0) -> Result:
    done = given(*arguments)
    assert done.exit_code == status, done.output
    return done


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ROS 2 bag of a few images."""
    folder = tmp_path_factory.mktemp("log")
    write_twins(folder / "json.mcap", folder / "ros2.mcap", IMAGES)
    return folder / "ros2.mcap"


def test_stage_by_stage(log: Path, tmp_path: Path) -> None:
    # The offset is given: so few images do not tell it.
    text = (CELL / "rig.yaml").read_text(encoding="utf-8")
    left, wide = text.split("  cam_wide:")
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        left.replace("estimate", "0.0") + "  cam_wide:" + wide.replace("estimate", "0.035", 1), encoding="utf-8"
    )
    detected, cleaned, out = tmp_path / "detected.mcap", tmp_path / "cleaned.mcap", tmp_path / "out"

    said = run("detect", log, "--rig", rig, "-o", detected, "--draw", tmp_path / "drawn", "--images").stdout
    assert "detections to use" in said
    assert f"Pictures of each image: {tmp_path / 'drawn'}" in said
    assert (tmp_path / "detected.seen.png").exists()
    pictures = sorted((tmp_path / "drawn").iterdir())
    assert len(pictures) == 2 * IMAGES
    picture = cv2.imread(str(pictures[0]))
    assert picture is not None
    blue = (np.abs(picture.astype(int) - [178, 114, 0]) < 40).all(axis=2)
    assert blue.sum() > 50  # something is drawn, and in the colour of what is used
    with open_log(detected) as opened:  # images on request
        assert sum(isinstance(r, ImageRecord) for r in opened.records(["/cam_left/image"])) == IMAGES

    assert "measurements to use" in run("clean", detected, "-o", cleaned).stdout
    assert "board" in run("solve", cleaned, "-o", out, "--verbose").stdout
    assert rw.read_solution(out / "result.json").certificate.status.value == "certified"
    assert sorted(path.name for path in out.iterdir()) == [".written.json", "calibration.mcap", "result.json"]
    written = run("export", out / "calibration.mcap", "-o", out).stdout.splitlines()
    assert all(Path(path).is_file() for path in written)
    assert {"camchain.yaml", "tf.yaml"} <= {Path(path).name for path in written}
    assert set(rw.read_refined(out / "result.json").Y) == {"cam_left", "cam_wide"}


def test_init_writes_a_rig_file_once(tmp_path: Path) -> None:
    log, rig = tmp_path / "ros2.mcap", tmp_path / "first.yaml"
    write_twins(tmp_path / "json.mcap", log, IMAGES_OF_INIT)
    done = run("init", log, "-o", rig)
    assert "tag36h11" in rig.read_text(encoding="utf-8")
    assert f"Written to {rig}" in done.stdout
    written = rig.read_text(encoding="utf-8").splitlines()
    *said, call = done.stdout.split("take the mark TODO away:\n")[1].splitlines()
    assert len(said) == sum("TODO" in line for line in written[3:])
    for line in said:
        number, key = line.split(": ")[0].removeprefix("  line ").split(", ")
        assert written[int(number) - 1].strip().startswith(f"{key}:")
    assert call == f"Then: gtsam-rwhec calibrate {log} --rig {rig} -o out"
    again = run("init", log, "-o", rig, status=2)
    assert "exists already" in again.stderr


def test_a_folder_of_images_becomes_a_log(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    lines = []
    for i in range(3):
        cv2.imwrite(str(images / f"view_{i}.png"), np.full((20, 30), 60 * i, dtype=np.uint8))
        lines.append(f"view_{i}.png, {0.1 * i}, 0, 0.5, 0, 0, 0, 1")
    (tmp_path / "poses.csv").write_text("\n".join(lines), encoding="utf-8")
    assert "--poses FILE" in run("convert", images, "-o", tmp_path / "log.mcap", status=2).stderr
    said = run("convert", images, "--poses", tmp_path / "poses.csv", "-o", tmp_path / "log.mcap").stdout
    assert said.startswith(f"Written to {tmp_path / 'log.mcap'}: 3 images and 3 poses.\n")
    with open_log(tmp_path / "log.mcap") as opened:
        assert {topic.name: topic.count for topic in opened.topics()} == {"/camera/image": 3, "/tf": 3}


def plain(text: str) -> str:
    """Without the frame that usage errors come in."""
    return " ".join(text.replace("│", " ").split())


def test_what_does_not_go_together_is_refused(log: Path, tmp_path: Path) -> None:
    assert "-o FOLDER" in plain(run("calibrate", log, "--rig", CELL / "rig.yaml", status=2).stderr)
    told = run("calibrate", log, "--rig", CELL / "rig.yaml", "-o", tmp_path, "--sigma", "0.1", status=2)
    assert "--sigma: not for a log. Its rig file states sizes, noise and names" in plain(told.stderr)
    assert "needs a rig file" in run("calibrate", log, "-o", tmp_path / "out", status=2).stderr
    assert not (tmp_path / "out").exists()
