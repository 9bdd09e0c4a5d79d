"""A camera of this machine, beside poses that somebody types, or another program writes, a line each."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

import cv2

from gtsam_rwhec.capture.sources import POLL_S, Message, Source, written_messages
from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.logs.mcap_writer import LogWriter
from gtsam_rwhec.logs.pose_tables import PoseStatement, poses_of, read_pose_table
from gtsam_rwhec.logs.records import Array
from gtsam_rwhec.rig import Rig

#: What the name of such a source begins with, and that of standard input as where poses come from.
PREFIX, STANDARD_INPUT = "camera:", "-"
#: Seconds between two images, and for which a pose holds that was typed: the robot may have gone on then.
EACH_S, HOLDS_S = 0.1, 3.0


class CameraSource(Source):
    """A camera by its number or its device, or a video file in its place; and lines of poses.

    Each line is a pose of the rig file's `tf`, T_parent_child, in metres: a position and a quaternion x, y, z, w, or 16
    numbers. It is where the robot stands now.

    Parameters
    ----------
    name : str
        "camera:0", "camera:/dev/video2", or "camera:video.avi".
    rig : Rig
        With one sensor that has images.
    poses : str
        A file that grows, or "-": standard input.

    Raises
    ------
    LogError
        There is no such camera or file, or the rig file does not fit.
    """

    def __init__(self, name: str, rig: Rig, poses: str) -> None:
        super().__init__(name, rig)
        self.reads_keys = poses != STANDARD_INPUT
        (self._sensor, sensor), *others = rig.sensors.items()
        if others or sensor.images is None or rig.carriers.poses.tf is None:
            raise LogError(
                f"{rig.source.place(('sensors', self._sensor))}: a camera of this machine takes a rig file with one "
                "sensor that has images: TOPIC, and carriers with poses: {tf: [PARENT, CHILD]}"
            )
        self._topic = sensor.images
        self.topics = {self._topic: "foxglove.CompressedImage", "/tf": "foxglove.FrameTransforms"}
        device = name.removeprefix(PREFIX)
        self.is_finite = Path(device).is_file()
        self._capture = cv2.VideoCapture(int(device) if device.isdecimal() else device)
        if not self._capture.isOpened():
            raise LogError(f"{name} cannot be opened: give camera:0, another number, or the path of a device")
        if self.reads_keys and not Path(poses).exists():
            raise LogError(f"--poses {poses} does not exist; make the file (or pipe) before, or give - to type them")
        self._lines: SimpleQueue[str] = SimpleQueue()
        self._is_over = False
        self._T: Array | None = None
        self._until_s = 0.0
        Thread(target=self._read_lines, args=(poses,), daemon=True).start()

    takes_poses = True

    def give_pose(self, line: str) -> None:
        """As `Source.give_pose`; the pose holds for some seconds."""
        self._T = poses_of(read_pose_table("a pose", line, stated=PoseStatement()), PoseStatement()).T[-1]
        self._until_s = time.monotonic() + HOLDS_S
        self.state = f"at {self._T[:3, 3].round(4).tolist()} m"

    async def messages(self) -> AsyncIterator[Message]:
        """Images, and before each the pose that holds; ends with a video."""
        self.is_connected, self.state = True, "waiting for a pose: x y z qx qy qz qw, in metres"
        each_s = 1.0 / (self._capture.get(cv2.CAP_PROP_FPS) or 30.0) if self.is_finite else 0.0
        sent_s = 0.0
        try:
            while True:
                begun_s = time.monotonic()
                there, image = await asyncio.to_thread(self._capture.read)  # also to empty the driver's buffer
                if not there:
                    self.state = "the camera gives no more images"
                    return
                while not self._lines.empty():
                    self._take_line(self._lines.get())
                if begun_s - sent_s >= EACH_S - 0.5 * each_s:
                    sent_s = begun_s
                    for message in await asyncio.to_thread(self._messages_of, image, time.time_ns()):
                        yield message
                await asyncio.sleep(max(0.0, begun_s + each_s - time.monotonic()))
        finally:
            self._is_over = True
            self._capture.release()

    def _take_line(self, line: str) -> None:
        if not line.strip():
            return
        try:
            self.give_pose(line)
        except FileFormatError as error:
            self.say("lines that are no pose", f"{brief(line)}: {error}")

    def _messages_of(self, image: cv2.typing.MatLike, stamp_ns: int) -> list[Message]:
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        data = cv2.imencode(".png", gray, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()

        def write(out: LogWriter) -> None:
            if self._T is not None and time.monotonic() < self._until_s:
                out.transforms("/tf", stamp_ns, [(*self.rig.carriers.poses.parent_and_child, self._T)])
            out.compressed_image(self._topic, stamp_ns, self.rig.frame_of(self._sensor), "png", data)

        return written_messages(write)

    def _read_lines(self, name: str) -> None:
        """Read lines until the session ends: a file that ends may grow."""
        with sys.stdin if name == STANDARD_INPUT else Path(name).open(errors="replace") as stream:
            line = ""
            while not self._is_over:
                line += stream.readline()
                if line.endswith("\n"):
                    self._lines.put(line)
                    line = ""
                else:
                    time.sleep(POLL_S)
