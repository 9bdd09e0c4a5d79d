"""What was seen in a log: its counts are the result's, its pictures come from the log, and only if they may."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_logs as made

from gtsam_rwhec.logs import LogWriter, open_log
from gtsam_rwhec.results.image_errors import CornerErrors, RatedView, SeenView
from gtsam_rwhec.runs.log_evidence import (
    CLEANING,
    DETECTION,
    ROBUST,
    SHEET_BYTES,
    SHEET_WIDTH,
    Pictures,
    images_of,
    seen_in_log,
    small_sheet,
    stage_of,
)
from gtsam_rwhec.runs.solving_stage import Calibrated

pytestmark = pytest.mark.usefixtures("without_figures")

STAMP_NS = made.BEGIN_NS + 5


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Calibrated]:
    """A driver's detections with corners, calibrated: the log and the answer."""
    folder, text = tmp_path_factory.mktemp("seen"), made.rig_text()
    for name in made.CAMERAS:
        own = f"detections: /{name}/tags"
        text = text.replace(
            own, f"{own}\n    intrinsics: {{K: [{made.FOCAL}, {made.FOCAL}, 320, 240], size: [640, 480]}}"
        )
    return folder, made.solved(folder, made.recording(4.0, camera_hz=2.0), text)


def test_counts_are_those_of_the_result(calibrated: tuple[Path, Calibrated]) -> None:
    folder, answer = calibrated
    with open_log(folder / "detected.mcap") as log, open_log(folder / "raw.mcap") as raw:
        seen = seen_in_log(answer, log, Pictures(raw, folder / "seen.png"))
    assert seen.used == sum(count.used for count in answer.log.outliers)
    by_reason = {(one.target, one.sensor, one.reason): one.count for one in seen.removed_counts}
    for track in answer.log.cleaning.tracks:
        for reason, count in track.removed.items():
            assert by_reason[track.target, track.sensor, reason] == count
    assert sum(track.used + track.removed for track in seen.tracks) == seen.used + seen.removed
    assert seen.span_s == pytest.approx(3.05, abs=0.1)
    assert [camera.sensor for camera in seen.cameras] == list(made.CAMERAS)  # with the corners that the driver gave
    assert all(camera.rms_px < 3.0 for camera in seen.cameras)
    assert len(seen.worst) == 6
    assert seen.no_pictures.startswith("no sensor has images")
    assert seen.sheet is None
    assert all(one.picture is None for one in seen.worst)


def test_stages_of_reasons() -> None:
    assert stage_of("seen twice in one image") == DETECTION
    assert stage_of("turning fast (rad/s)") == CLEANING
    assert stage_of("outlier (robust estimation)") == ROBUST


def rated(sensor: str, stamp_ns: int) -> RatedView:
    pixels = np.array([[100.0, 100.0], [200.0, 100.0], [200.0, 180.0], [100.0, 180.0]])
    view = SeenView(pixels, np.zeros((4, 3)), np.zeros((4, 3, 6)), stamp_ns, "board")
    return RatedView(sensor, view, CornerErrors(np.full((4, 2), 0.5), np.ones(4, dtype=bool)), 0.5, 2.0)


def test_images_come_from_the_log_and_only_if_they_may(tmp_path: Path) -> None:
    text = made.rig_text().replace(
        "detections: /cam_0/tags", "images: /cam_0/image\n    intrinsics: {K: [500, 500, 320, 240], size: [640, 480]}"
    )
    rig = made.parse_rig(text, "rig.yaml")
    wanted = [rated("cam_0", STAMP_NS), rated("cam_1", STAMP_NS)]
    with LogWriter(tmp_path / "raw.mcap") as out:  # at its stamp, and later than its stamp
        for stamp in (STAMP_NS - 1, STAMP_NS):
            out.compressed_image("/cam_0/image", stamp, "cam_0", "png", b"an image")
    with open_log(tmp_path / "raw.mcap") as log:
        pictures = Pictures(log, tmp_path / "seen.png")
        found, _, why_not = images_of(pictures, rig, wanted)
        assert list(found) == [("cam_0", STAMP_NS)]
        assert why_not == ""
        hidden = Pictures(log, pictures.sheet, may_show=False)
        assert images_of(hidden, rig, wanted) == ({}, {}, "the report was made without images.")
        assert images_of(pictures, rig, [rated("cam_1", STAMP_NS)])[2].startswith("no sensor has images")
        assert "no images (any more)" in images_of(pictures, rig, [rated("cam_0", 7)])[2]


def test_the_sheet_of_a_page_is_small(tmp_path: Path) -> None:
    assert small_sheet(tmp_path / "seen.png") is None
    sheet = np.random.default_rng(0).integers(0, 255, (900, 1500, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "seen.png"), sheet)
    content = small_sheet(tmp_path / "seen.png")
    assert content is not None
    assert len(content) <= SHEET_BYTES
    read = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert read is not None
    assert read.shape[1] <= SHEET_WIDTH
    (tmp_path / "seen.png").write_bytes(b"no picture")
    assert small_sheet(tmp_path / "seen.png") is None
