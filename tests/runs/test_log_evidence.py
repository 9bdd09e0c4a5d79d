"""What was seen in a log or a folder: counts are the result's; pictures and the sample of a sheet come if they may."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_logs as made
from bad_logs import MOVING, WITH_IMAGES, images, picture

from gtsam_rwhec.detect.contact_sheet import Outcome
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.results.image_errors import CornerErrors, RatedView, SeenView
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.runs.detection_stage import detect_source, sheet_beside
from gtsam_rwhec.runs.image_pictures import outcome_of, sample
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
from gtsam_rwhec.runs.run_log import image_key, image_name, picture_file
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


FOUND, NOTHING = (Outcome.FOUND, "board"), (Outcome.NOTHING, "")
SMALL, BLURRED = (Outcome.REJECTED, "board: small"), (Outcome.REJECTED, "board: blurred")
FAILED = (Outcome.FAILED, "cut short")
RIG = """\
carriers: {sensors: base, targets: hand, poses: {frames: [base, hand]}}
sensors:
  camera: {images: image, poses: poses.txt, intrinsics: {K: [400, 400, 320, 240], size: [640, 480]}}
targets:
  tag: {type: tag, family: tag36h11, id: 0, size_m: 0.1}
"""


def test_each_kind_is_there_and_spread_over_time() -> None:
    outcomes = dict.fromkeys(range(1000), FOUND) | dict.fromkeys(range(300, 500), NOTHING)
    outcomes |= dict.fromkeys(range(100, 200), SMALL) | {150: BLURRED, 700: FAILED}
    chosen = sample(outcomes, 60)
    assert len(chosen) == 60
    assert chosen == sorted(set(chosen))
    kinds = [outcomes[stamp] for stamp in chosen]
    assert kinds.count(BLURRED) == kinds.count(FAILED) == 1
    assert kinds.count(SMALL) == 28  # half of the sheet is for what went wrong
    assert kinds.count(NOTHING) == kinds.count(FOUND) == 15
    found = [stamp for stamp in chosen if outcomes[stamp] == FOUND]
    assert (found[0], found[-1]) == (0, 999)


@pytest.mark.parametrize(
    ("counts", "expected"),
    [((5, 0, 0), (5, 0, 0)), ((100, 0, 0), (60, 0, 0)), ((0, 100, 100), (0, 30, 30)), ((2, 100, 3), (2, 55, 3)),
     ((100, 2, 3), (55, 2, 3)), ((100, 0, 100), (30, 0, 30)), ((0, 0, 0), (0, 0, 0))],
)  # fmt: skip
def test_what_a_kind_leaves_free_is_for_others(counts: tuple[int, int, int], expected: tuple[int, int, int]) -> None:
    kinds = [kind for kind, count in zip((SMALL, NOTHING, FOUND), counts, strict=True) for _ in range(count)]
    chosen = [kinds[i] for i in sample(dict(enumerate(kinds)), 60)]
    assert tuple(chosen.count(kind) for kind in (SMALL, NOTHING, FOUND)) == expected


def test_outcomes_in_words() -> None:
    used, small = (
        DetectionRecord(1, 1, "/d", "c", "f", name, reason=reason) for name, reason in (("a", ""), ("b", "small"))
    )
    assert outcome_of([used, small], "") == (Outcome.FOUND, "a; rejected b: small")
    assert outcome_of([small], "") == (Outcome.REJECTED, "b: small")
    assert outcome_of([], "") == (Outcome.NOTHING, "")
    fault = "topic /image, image at 17 ns: 60 bytes of a PNG file that is cut short"
    assert outcome_of([], fault) == (Outcome.FAILED, "60 bytes of a PNG file that is cut short")


def test_names_of_pictures_are_no_paths() -> None:
    names = {image_key("image", 17): "image/0001.png"}
    assert image_name(names, "image", 17) == "image/0001.png"
    assert image_name(names, "image", 18) == "18"
    assert picture_file("camera1", "image/0001.png") == "camera1_0001.png"
    assert picture_file("a/b", "18") == "a_b_18.png"
    for name in ("../../x", "..", "/etc/passwd", "a\x00b", "x" * 500):
        file = picture_file("../c", name)
        assert Path(file).name == file
        assert len(file) < 200


def folder_of(path: Path, count: int, family: int | None) -> Path:
    (path / "image").mkdir(parents=True)
    for i in range(count):
        (path / "image" / f"shot_{i}.png").write_bytes(picture(family))
    rows = [f"{0.1 * i} 0 0 {np.sin(0.1 * i)} 0 0 {np.cos(0.1 * i)}" for i in range(count)]
    (path / "poses.txt").write_text("\n".join(rows))
    return path


def test_detection_in_a_folder_draws_each_image(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "cell", 3, cv2.aruco.DICT_APRILTAG_36h11)
    (folder / "image" / "shot_1.png").write_bytes(picture())
    (folder / "image" / "shot_2.png").write_bytes(b"no picture")
    out = tmp_path / "detected.mcap"
    report = detect_source(folder, parse_rig(RIG, "rig.yaml"), out, draw=tmp_path / "drawn", workers=1)
    assert {track.target for track in report.tracks} == {"tag"}
    assert report.sources == ("cell.images.mcap",)
    assert {path.name for path in (tmp_path / "drawn").iterdir()} == {"camera_shot_0.png", "camera_shot_1.png"}
    assert {path.name for path in tmp_path.iterdir()} == {"cell", "detected.mcap", "detected.seen.png", "drawn"}
    with open_log(out) as log:
        assert not any(topic.has_images for topic in log.topics())


def test_both_are_there_where_nothing_is_found(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "cell", 2, None)
    out = tmp_path / "detected.mcap"
    sheet_beside(out).write_bytes(b"of an earlier run")
    with pytest.raises(LogError, match="no usable detection"):
        detect_source(folder, parse_rig(RIG, "rig.yaml"), out, draw=tmp_path / "drawn", workers=1)
    assert len(list((tmp_path / "drawn").iterdir())) == 2
    sheet = cv2.imread(str(sheet_beside(out)))
    assert sheet is not None
    assert not out.exists()


def test_images_that_cannot_be_used_are_on_the_sheet(tmp_path: Path) -> None:
    folder, out = folder_of(tmp_path / "cell", 2, None), tmp_path / "detected.mcap"
    smaller = parse_rig(RIG.replace("size: [640, 480]", "size: [320, 240]"), "rig.yaml")
    with pytest.raises(LogError, match=r"multiply fx, fy, cx and cy by 2 and write size: \[640, 480\]"):
        detect_source(folder, smaller, out, workers=1)
    assert sheet_beside(out).exists()


def test_a_drivers_detections_have_no_sheet(tmp_path: Path) -> None:
    log = made.write(tmp_path / "raw.mcap", made.recording(2.0))
    detect_source(log, made.rig(), tmp_path / "detected.mcap")
    assert not sheet_beside(tmp_path / "detected.mcap").exists()


def test_a_sheet_of_a_log_of_two_cameras(tmp_path: Path) -> None:
    log = made.write(tmp_path / "raw.mcap", MOVING + images(picture(cv2.aruco.DICT_APRILTAG_36h11)))
    detect_source(log, made.rig(**WITH_IMAGES), tmp_path / "detected.mcap", workers=1)
    sheet = cv2.imread(str(sheet_beside(tmp_path / "detected.mcap")))
    assert sheet is not None
    gray_rows = (sheet[:, 2] == 225).all(axis=1)  # each band begins with a gray header
    assert np.count_nonzero(np.diff(gray_rows.astype(int)) == 1) + int(gray_rows[0]) == 2
