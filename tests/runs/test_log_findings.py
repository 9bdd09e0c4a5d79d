"""What a log's calibration says is wrong, with the line of the rig file to change; cameras with blurred images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_logs as made

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import Misreading
from gtsam_rwhec.calibration.other_readings import Mistake
from gtsam_rwhec.calibration.point_uncertainty import PointUncertainty
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import LogWriter, open_log
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs.log_findings import in_rig_file, known_to_nothing
from gtsam_rwhec.runs.sensor_detections import LookedAt, SensorDetections
from gtsam_rwhec.runs.unread_targets import blurred_images
from gtsam_rwhec.runs.whole_runs import calibrate_log

EXCHANGED = made.RIG.replace("sensors: hand", "sensors: base").replace("targets: base", "targets: hand")
ESTIMATED = "detections: /cam_{0}/tags\n    time_offset: estimate"


def judged(folder: Path, messages: Iterable[made.Message], text: str) -> rw.Judgement:
    """The judgement of the stages, without exports."""
    return made.solved(folder, messages, text).judgement


@pytest.mark.slow
def test_exchanged_carriers_are_named_with_their_lines_though_clocks_are_estimated(tmp_path: Path) -> None:
    text = EXCHANGED
    for number in range(2):
        text = text.replace(f"detections: /cam_{number}/tags", ESTIMATED.format(number))
    judgement = judged(tmp_path, made.recording(6.0), text.replace("sizes: known", "sizes: check"))
    assert judgement.verdict is rw.Verdict.DO_NOT_USE
    said = str(judgement)
    rig = tmp_path / "rig.yaml"
    assert said.startswith(
        "Do not use these poses: exchange `sensors` and `targets` in the rig file "
        f"({rig}, lines 2 and 3: carriers.sensors and carriers.targets): the median residual is "
    )
    assert "inverted" not in said
    assert "deg and" in said.split("the median residual is ")[1].split(" as read, and ")[0]
    assert "or, if base does carry the sensors, what publishes tf writes the inverse of T_base_hand" in said
    assert "contradict" not in said
    assert judgement.grounds == (Ground.MISREAD,)


def test_poses_of_a_topic_that_are_the_inverse_of_what_the_rig_file_says(tmp_path: Path) -> None:
    messages = []
    for message in made.recording(6.0):
        if message.topic != "/tf":
            messages.append(message)
            continue
        (part,) = message.content["transforms"]
        place = {"position": part["translation"], "orientation": part["rotation"]}
        content = {"timestamp": part["timestamp"], "frame_id": "base", "pose": place}
        messages.append(made.Message("/robot", "foxglove.PoseInFrame", content, message.logged_ns))
    text = made.rig_text(poses="{topic: /robot, parent: hand, child: base}")
    judgement = judged(tmp_path, messages, text)
    assert judgement.verdict is rw.Verdict.DO_NOT_USE
    said = str(judgement)
    assert "exchange parent and child in" in said
    assert "rig.yaml, line 4: carriers.poses.parent" in said


@pytest.mark.slow
def test_the_order_of_the_frames_of_tf_changes_nothing(tmp_path: Path) -> None:
    messages, found = made.recording(2.5), []
    for order in ("[base, hand]", "[hand, base]"):
        text = made.rig_text(poses=f"{{tf: {order}}}\n  noise: {{rotation_deg: 0.5, translation_mm: 0.1}}")
        found.append(made.solved(tmp_path, messages, text).refined)
    for name, T in found[0].Y.items():
        np.testing.assert_array_equal(found[1].Y[name].matrix(), T.matrix())
        np.testing.assert_array_equal(found[1].covariance(name), found[0].covariance(name))


def test_sizes_of_which_none_fits_the_motion_are_no_success(tmp_path: Path) -> None:
    """Where nothing tells the sizes from the carriers' unit of length, one judgement, as in Python."""
    log = made.recording(6.0, true_size=dict.fromkeys(made.TAGS, 1 / 1.17))
    judgement = judged(tmp_path, log, made.rig_text(sizes="sizes: check"))
    assert judgement.verdict is rw.Verdict.DO_NOT_USE
    said = str(judgement)
    assert "carriers' unit of length or the focal lengths" in said
    assert "rig.yaml, line 1" in said


def test_a_size_that_was_corrected_by_the_others_asks_for_care(tmp_path: Path) -> None:
    log = made.recording(6.0, true_size={"tag_1": 1 / 1.17})
    judgement = judged(tmp_path, log, made.rig_text(sizes="sizes: check"))
    assert judgement.verdict is rw.Verdict.CARE
    said = str(judgement)
    assert said.startswith("Use these poses with care: the stated size of tag_1 is 17 % too large (")
    assert "rig.yaml, line 13: targets.tag_1: the motion says 102." in said


@pytest.mark.slow
def test_two_clocks_that_are_both_late_are_named(tmp_path: Path) -> None:
    log = made.recording(8.0, offsets_s=dict.fromkeys(made.CAMERAS, 0.3))
    judgement = judged(tmp_path, log, made.rig_text(sizes="sizes: check"))
    assert judgement.verdict is rw.Verdict.DO_NOT_USE
    said = str(judgement)
    assert said.startswith("Do not use these poses: the time offset of cam_0 is 0 s in the rig file")
    offset_ms = float(said.split("carriers' at ")[1].split(" ms, to +-")[0])
    assert abs(offset_ms - 300.0) < 2.0
    assert "rig.yaml, line 7: sensors.cam_0.time_offset: write time_offset: estimate" in said
    assert "the time offset of cam_1 is 0 s" in said
    assert "rows of A" not in said


def test_what_cannot_be_written_is_told_before_anything_is_computed(tmp_path: Path) -> None:
    log = made.write(tmp_path / "raw.mcap", made.recording(1.0))
    (tmp_path / "rig.yaml").write_text(made.RIG, encoding="utf-8")
    for number, name in enumerate(("result.json", "calibration.mcap", "tf.yaml", "camera_info")):
        out = tmp_path / f"out_{number}"
        out.mkdir()
        if name == "camera_info":
            (out / name).write_text("a file")
        else:
            (out / name).mkdir()
        with pytest.raises(LogError, match=name):
            calibrate_log(log, parse_rig(made.RIG, "rig.yaml"), out, progress=_nothing_is_done)
        assert [path.name for path in out.iterdir()] == [name]


def _nothing_is_done(stage: str) -> None:
    raise AssertionError(stage)


def test_points_that_are_known_to_nothing_are_no_success_and_others_are() -> None:
    rig = parse_rig(made.RIG, "rig.yaml")
    point = PointUncertainty(
        point_m=np.array([0.0, 0.0, 1.5]), frame="cam_1", seen_from="hand", level=0.95, centre_m=np.zeros(3),
        covariance_m2=np.eye(3), axes=np.eye(3), half_lengths_mm=np.full(3, 800.0), radius_mm=870.0,
        measurement_mm=None,
    )  # fmt: skip
    (found,) = known_to_nothing([point, replace(point, radius_mm=20.0), replace(point, radius_mm=np.inf)], rig)
    assert found.ground.verdict is rw.Verdict.DO_NOT_USE
    assert found.words.startswith("a point 1.50 m from cam_1 is known to 870 mm only")
    assert "(rig.yaml, line 9: sensors.cam_1.intrinsics)" in found.words


@pytest.mark.parametrize("found", [("A is inverted",), ("B is inverted",), ("A is inverted", "B is inverted")], ids=str)
def test_in_images_an_inverse_is_an_exchange(found: tuple[str, ...]) -> None:
    """For one board in one camera A inverted is B inverted; and what is found in images is not inverted."""
    camera = "images: /cam_{0}/image\n    intrinsics: {{K: [400, 400, 320, 240], size: [640, 480]}}"
    rig = parse_rig(made.rig_text(cam_0=camera.format(0), cam_1=camera.format(1)), "rig.yaml")
    given = [Misreading(Mistake.INVERTED, likely, "", (9.0, 1.0), (9.0, 1.0)) for likely in found]
    (said,) = in_rig_file(given, rig)
    assert str(said).startswith("exchange `sensors` and `targets` in the rig file (rig.yaml, lines 2 and 3: ")
    assert "inverted" not in str(said)


def test_other_readings_are_said_beside_an_exchange() -> None:
    rig = parse_rig(made.RIG, "rig.yaml")
    given = [
        Misreading(mistake, likely, "", (9.0, 1.0), (9.0, 1.0), inverts_A=mistake is Mistake.INVERTED)
        for mistake, likely in ((Mistake.QUATERNION_ORDER, "quaternions"), (Mistake.INVERTED, "A is inverted"))
    ]
    assert [one.mistake for one in in_rig_file(given, rig)] == [Mistake.INVERTED, Mistake.QUATERNION_ORDER]
    (of_B,) = in_rig_file([replace(given[1], likely="B is inverted", of_B=True, inverts_A=False)], rig)
    assert of_B.cure.startswith("let the driver publish the target's pose")


def with_intrinsics() -> str:
    """The rig file with the topics of its cameras' intrinsics."""
    text = made.RIG
    for camera in made.CAMERAS:
        topic = f"detections: /{camera}/tags"
        text = text.replace(topic, f"{topic}\n    intrinsics: {{topic: /{camera}/camera_info}}")
    return text


def test_a_drivers_corners_outside_of_its_images_leave_the_poses_in_doubt(tmp_path: Path) -> None:
    """Intrinsics of another resolution, or a driver that makes corners up: its poses had no answer at all."""
    low = {"height": 400}  # the made-up tags are seen beyond the borders too
    messages = [*(made.camera_info(camera, **low) for camera in made.CAMERAS), *made.recording(2.5)]
    calibrated = made.solved(tmp_path, messages, with_intrinsics())
    assert calibrated.refined.reprojection is None
    assert rw.Ground.CORNERS_DOUBTED in calibrated.judgement.grounds
    assert "outside images of 640 x 400 pixels" in calibrated.judgement.reason
    assert calibrated.judgement.verdict is rw.Verdict.CARE


def test_corners_counterclockwise_as_of_the_apriltag_library_give_the_same_answer(tmp_path: Path) -> None:
    """Poses read them clockwise, and the refinement as they came: it had tags upside down, to 0.1 pixel."""
    text = with_intrinsics()
    wide = {"width": 1600, "height": 1200, "K": [400.0, 0.0, 800.0, 0.0, 400.0, 600.0, 0.0, 0.0, 1.0]}
    messages = [made.camera_info(camera, **wide) for camera in made.CAMERAS]
    for message in made.recording(2.5):
        content = dict(message.content)
        for one in content.get("detections", ()):
            moved = [{"x": corner["x"] + 480.0, "y": corner["y"] + 360.0} for corner in one["corners_px"]]
            one["corners_px"] = moved[::-1]
        messages.append(replace(message, content=content))
    refined = made.solved(tmp_path, messages, text).refined
    assert refined.reprojection is not None
    for name, truth in made.X.items():
        assert refined.X[name].matrix() == pytest.approx(truth, abs=0.05)


RIG = parse_rig(
    """
carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}
sensors: {camera: {images: /camera/image, intrinsics: {model: pinhole, K: [300, 300, 160, 120], size: [320, 240]}}}
targets: {tag: {type: tag, family: tag36h11, id: 0, size_m: 0.1}}
""",
    "rig.yaml",
)
CAMERA = Camera.of(320, 240, "plumb_bob", [[300, 0, 160], [0, 300, 120], [0, 0, 1]], [0, 0, 0, 0], "camera")


def seen(folder: Path, way_px: int, number: int = 6) -> tuple[str, ...]:
    """What is said of images without a target that moved by some pixels each."""
    rng = np.random.default_rng(4)
    looked_at = {}
    with LogWriter(folder / "log.mcap") as log:
        for stamp in range(1, number + 1):
            coarse = rng.uniform(30, 220, (12, 16)).astype(np.float32)
            sharp = cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_NEAREST)
            moved = cv2.filter2D(sharp, -1, np.full((1, way_px), 1.0 / way_px)) + rng.normal(0.0, 1.0, sharp.shape)
            _, png = cv2.imencode(".png", np.clip(moved, 0, 255).astype(np.uint8))
            log.compressed_image("/camera/image", stamp, "camera", "png", png.tobytes())
            looked_at[stamp] = LookedAt(stamp)
    found = {"camera": SensorDetections([], number, Counter(), images=looked_at)}
    with open_log(folder / "log.mcap") as log:
        return blurred_images(log, RIG, {"camera": CAMERA}, found)


def test_images_that_move_are_named_with_their_blur(tmp_path: Path) -> None:
    (words,) = seen(tmp_path, 11)
    assert words.startswith("no target is read in 6 of 6 images of camera, and motion blur hides it: 6 of 6 of them")


@pytest.mark.parametrize(("way_px", "number"), [(1, 6), (11, 2)])
def test_sharp_images_and_few_images_are_not(way_px: int, number: int, tmp_path: Path) -> None:
    assert seen(tmp_path, way_px, number) == ()
