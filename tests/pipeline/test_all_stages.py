"""Options that count only in detection are refused for a log that a stage wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic_logs as made

from gtsam_rwhec.errors import LogError, OptionError
from gtsam_rwhec.logs import ImageRecord, LogWriter, open_log
from gtsam_rwhec.pipeline import calibrate_log, clean_log, detect_log


@pytest.fixture(scope="module", params=["detected.mcap", "clean.mcap"])
def stage_log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of detections, or a cleaned log."""
    folder = tmp_path_factory.mktemp("stages")
    detected, clean = folder / "detected.mcap", folder / "clean.mcap"
    detect_log(made.write(folder / "raw.mcap", made.recording(4.0)), made.rig(), detected)
    clean_log(detected, clean)
    path: Path = folder / request.param
    return path


def test_workers_are_refused_where_detection_is_skipped(stage_log: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=rf"workers=2 \(--workers\).*{stage_log.name}.*raw log"):
        calibrate_log(stage_log, None, tmp_path / "out", workers=2)
    assert not (tmp_path / "out").exists()


def test_images_are_refused_where_the_log_has_none(stage_log: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=rf"--images.*{stage_log.name} has no images to copy"):
        calibrate_log(stage_log, made.rig(), tmp_path / "out", images="copy")
    assert not (tmp_path / "out").exists()


def test_images_are_copied_where_the_log_has_them(tmp_path: Path) -> None:
    raw = made.write(tmp_path / "raw.mcap", made.recording(4.0))
    with LogWriter(tmp_path / "image.mcap") as out:
        out.compressed_image("/cam_0/image", made.BEGIN_NS, "cam_0", "png", b"an image")
    detect_log([raw, tmp_path / "image.mcap"], made.rig(), tmp_path / "detected.mcap", images="copy")
    calibrate_log(tmp_path / "detected.mcap", None, tmp_path / "out", images="copy")
    with open_log(tmp_path / "out" / "clean.mcap") as log:
        (image,) = (record for record in log.records(["/cam_0/image"]) if isinstance(record, ImageRecord))
    assert bytes(image.data) == b"an image"


def test_several_files_of_which_a_stage_wrote_one_are_refused(stage_log: Path, tmp_path: Path) -> None:
    raw = made.write(tmp_path / "raw.mcap", [made.transform(made.BEGIN_NS, "base", "hand", np.eye(4))])
    with pytest.raises(LogError, match="give that file alone"):
        calibrate_log([stage_log, raw], None, tmp_path / "out")
