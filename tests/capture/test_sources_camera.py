"""A camera of this machine, a video file in its place, beside poses that are typed or written to a file."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import pose, printed, render

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.capture.live_session import LiveOptions, Session, source_of
from gtsam_rwhec.capture.sources_camera import CameraSource
from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.results.result_file import read_result
from gtsam_rwhec.rig import parse_rig

#: The video: images a second, and of one station.
RATE, EACH = 10, 14
CAMERA = Camera.of(640, 480, "pinhole", [[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]], [], "a video")
RIG = """
carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}
sensors:
  cam:
    images: /cam
    intrinsics: {width: 640, height: 480, K: [600, 600, 319.5, 239.5], model: pinhole}
targets:
  board: {type: charuco, family: aruco_4x4_100, squares: [7, 5], square_m: 0.04, marker_m: 0.03}
"""
BOARD = parse_rig(RIG, "rig.yaml").target_list[0]
Y = pose((5.0, -3.0, 20.0), (0.03, 0.01, 0.08))
X = pose((0.0, 0.0, 10.0), (0.5, 0.1, 0.0))


def video(path: Path, count: int) -> list[np.ndarray]:
    """A camera that stands still at so many poses; T_base_hand of each."""
    out = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE, (640, 480))
    rng, hands = np.random.default_rng(1), []
    for i in range(count):
        turn = 25.0 * np.array([np.cos(2.4 * i), np.sin(2.4 * i)])
        B = pose((turn[0], turn[1], 30.0 * (i % 3)), (*rng.uniform(-0.04, 0.04, 2), 0.45 + 0.05 * (i % 4)))
        image = cv2.cvtColor(render(CAMERA, [(printed(BOARD), B)], seed=i), cv2.COLOR_GRAY2BGR)
        for _ in range(EACH):
            out.write(image)
        hands.append(X @ np.linalg.inv(B) @ np.linalg.inv(Y))
    out.release()
    return hands


def line_of(T: np.ndarray) -> str:
    """As a teach pendant's program would write it."""
    return " ".join(f"{value:.9f}" for value in T.ravel()) + "\n"


def test_a_camera_beside_poses_that_are_written_is_taken_from_and_calibrated(tmp_path: Path) -> None:
    hands, lines = video(tmp_path / "camera.avi", 5), tmp_path / "poses.txt"
    lines.write_text("")
    rig = parse_rig(RIG, "rig.yaml")
    source = source_of(f"camera:{tmp_path / 'camera.avi'}", rig, poses=str(lines))
    assert isinstance(source, CameraSource)

    async def run() -> Session:
        session = Session(source, rig, tmp_path / "out", LiveOptions(takes_when_still=True))
        running = asyncio.create_task(session.run())
        for i, T in enumerate(hands):
            while source.received["/cam"] < EACH * i + 3:
                assert not running.done()
                await asyncio.sleep(0.02)
            if i % 2:  # typed on the page
                with pytest.raises(FileFormatError, match="a pose, line 1"):
                    await session.take_at("1 2 3")
                await session.take_at(line_of(T).strip())
                continue
            with lines.open("a") as out:
                out.write("this is no pose\n" if i == 0 else "")
                out.write(line_of(T)[:20])  # a line comes in pieces
                out.flush()
                out.write(line_of(T)[20:])
        await running
        return session

    session = asyncio.run(run())
    assert len(session.takes.all) == 5, session.state()["said"]
    assert session.judgement is not None
    assert not any("the robot moved" in words for _, _, words in session.state()["said"])
    assert "lines that are no pose: 1; the first: " in str(source.troubles["lines that are no pose"])
    found = read_result(tmp_path / "out" / "calibration" / "result.json").refined.Y["cam"].matrix()
    assert np.linalg.norm(found[:3, 3] - Y[:3, 3]) < 1e-3


def test_what_does_not_fit_a_camera_is_said(tmp_path: Path) -> None:
    rig = parse_rig(RIG, "rig.yaml")
    with pytest.raises(LogError, match="camera:/no/such cannot be opened: give camera:0"):
        source_of("camera:/no/such", rig)
    video(tmp_path / "camera.avi", 1)
    with pytest.raises(LogError, match="does not exist; make the file"):
        source_of(f"camera:{tmp_path / 'camera.avi'}", rig, poses=str(tmp_path / "none"))
    with pytest.raises(LogError, match="one sensor that has images: TOPIC"):
        source_of("camera:0", parse_rig(RIG.replace("images: /cam", "detections: /cam/tags"), "rig.yaml"))


def test_a_pose_holds_for_a_while_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hands, lines = video(tmp_path / "camera.avi", 1), tmp_path / "poses.txt"
    lines.write_text(line_of(hands[0]))
    monkeypatch.setattr("gtsam_rwhec.capture.sources_camera.HOLDS_S", 0.35)
    source = source_of(f"camera:{tmp_path / 'camera.avi'}", parse_rig(RIG, "rig.yaml"), poses=str(lines))
    time.sleep(0.2)  # until the line is read

    async def topics() -> list[str]:
        return [message.channel.topic async for message in source.messages()]

    found = asyncio.run(topics())
    assert 2 <= found.count("/tf") <= 5 < found.count("/cam")
