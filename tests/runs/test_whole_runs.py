"""All stages of a run: how often logs are read, problems made, corners refined; options that count for images alone."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import synthetic_logs as made
from given_commands import given
from mcap.reader import make_reader
from places import REPOSITORY

from gtsam_rwhec.calibration.stages import calibrate
from gtsam_rwhec.errors import LogError, OptionError
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.logs import ImageRecord, Log, LogWriter, open_log
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig import read_rig
from gtsam_rwhec.runs import calibrate_log, clean_log, detect_log, solve_into, solve_log


@pytest.fixture(scope="module", params=["detected.mcap", "calibration.mcap"])
def stage_log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of detections, or a cleaned log."""
    folder = tmp_path_factory.mktemp("stages")
    detected, clean = folder / "detected.mcap", folder / "calibration.mcap"
    detect_log(made.write(folder / "raw.mcap", made.recording(4.0)), made.rig(), detected)
    clean_log(detected, clean)
    return folder / request.param


def test_workers_are_refused_where_detection_is_skipped(stage_log: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=rf"workers=2 \(--workers\).*{stage_log.name}.*raw log"):
        calibrate_log(stage_log, None, tmp_path / "out", workers=2)
    assert not (tmp_path / "out").exists()


def test_images_are_refused_where_the_log_has_none(stage_log: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=rf"--images.*{stage_log.name} has no images or clouds to copy"):
        calibrate_log(stage_log, made.rig(), tmp_path / "out", images="copy")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_images_are_copied_where_the_log_has_them(tmp_path: Path) -> None:
    raw = made.write(tmp_path / "raw.mcap", made.recording(4.0))
    with LogWriter(tmp_path / "image.mcap") as out:
        out.compressed_image("/cam_0/image", made.BEGIN_NS, "cam_0", "png", b"an image")
    detect_log([raw, tmp_path / "image.mcap"], made.rig(), tmp_path / "detected.mcap", images="copy")
    calibrate_log(tmp_path / "detected.mcap", None, tmp_path / "out", images="copy")
    with open_log(tmp_path / "out" / "calibration.mcap") as log:
        (image,) = (record for record in log.records(["/cam_0/image"]) if isinstance(record, ImageRecord))
    assert bytes(image.data) == b"an image"


@pytest.mark.parametrize("stage", [detect_log, calibrate_log])
def test_a_drivers_detections_need_no_workers_and_have_no_images(stage: Any, tmp_path: Path) -> None:
    raw = made.write(tmp_path / "raw.mcap", made.recording(4.0))
    with pytest.raises(OptionError, match=r"workers=2 \(--workers\).*no sensor of the rig file has images: leave"):
        stage(raw, made.rig(), tmp_path / "out", workers=2)
    with pytest.raises(OptionError, match=r"--images.*raw\.mcap has no images or clouds to copy. Leave the option out"):
        stage(raw, made.rig(), tmp_path / "out", images="copy")
    assert list(tmp_path.iterdir()) == [raw]


def test_a_drivers_detections_cannot_be_drawn(tmp_path: Path) -> None:
    raw = made.write(tmp_path / "raw.mcap", made.recording(4.0))
    (tmp_path / "rig.yaml").write_text(made.rig_text(), encoding="utf-8")
    arguments = ["detect", raw, "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "d.mcap", "--draw", tmp_path / "pics"]
    done = given(*arguments)
    assert done.exit_code == 2
    assert "(--draw) counts only for images, and no sensor of the rig file has images" in " ".join(done.stderr.split())
    assert {path.name for path in tmp_path.iterdir()} == {"raw.mcap", "rig.yaml"}


def test_several_files_of_which_a_stage_wrote_one_are_refused(stage_log: Path, tmp_path: Path) -> None:
    raw = made.write(tmp_path / "raw.mcap", [made.transform(made.BEGIN_NS, "base", "hand", np.eye(4))])
    with pytest.raises(LogError, match="give that file alone"):
        calibrate_log([stage_log, raw], None, tmp_path / "out")


def test_a_run_opens_its_log_once_and_writes_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All stages at once, and each alone, find the same."""
    opened: list[Path] = []
    written: list[Path] = []
    of_reader, of_writer = Log.__init__, LogWriter.__init__

    def reading(self: Log, files: list[Any]) -> None:
        opened.extend(Path(file.path) for file in files)
        of_reader(self, files)

    def writing(self: LogWriter, path: Path) -> None:
        written.append(Path(path))
        of_writer(self, path)

    raw = made.write(tmp_path / "raw.mcap", made.recording(4.0))
    with monkeypatch.context() as counting:
        counting.setattr(Log, "__init__", reading)
        counting.setattr(LogWriter, "__init__", writing)
        calibrate_log(raw, made.rig(), tmp_path / "out")
    assert (opened, written) == ([raw], [tmp_path / "out" / "calibration.mcap"])

    detect_log(raw, made.rig(), tmp_path / "one.mcap")
    clean_log(tmp_path / "one.mcap", tmp_path / "one.mcap")
    solve_into(tmp_path / "one.mcap", None, tmp_path / "stages")
    assert messages_of(tmp_path / "stages" / "calibration.mcap") == messages_of(tmp_path / "out" / "calibration.mcap")


def messages_of(path: Path) -> list[tuple[str, int, bytes]]:
    """All messages of a log, by topic and time."""
    with path.open("rb") as stream:
        return sorted((c.topic, m.log_time, bytes(m.data)) for _, c, m in make_reader(stream).iter_messages())


CELL = REPOSITORY / "data" / "cell"


@pytest.mark.slow
def test_the_shipped_log_is_solved_by_one_calibration(tmp_path: Path) -> None:
    rig = read_rig(CELL / "rig.yaml")
    detect_log(CELL / "robot_cell.mcap", rig, tmp_path / "detected.mcap")
    clean_log(tmp_path / "detected.mcap", tmp_path / "cleaned.mcap", rig)
    codes = {
        getattr(function, "__wrapped__", function).__code__: name
        for name, function in (
            ("calibrations", calibrate), ("problems", Problem.__init__), ("refinements from corners", refine_corners),
        )
    }  # fmt: skip
    count = Counter[str]()

    def on_event(frame: FrameType, event: str, argument: object) -> None:
        if event == "call" and frame.f_code in codes:
            count[codes[frame.f_code]] += 1

    before = sys.getprofile()
    sys.setprofile(on_event)
    try:
        solve_log(tmp_path / "cleaned.mcap")
    finally:
        sys.setprofile(before)
    assert count["calibrations"] == 1
    assert 0 < count["problems"] <= 20
    assert 0 < count["refinements from corners"] <= 5
