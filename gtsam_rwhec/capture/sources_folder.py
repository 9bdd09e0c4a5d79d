"""A folder that images and poses fall into: each image has its own pose, was taken at rest, and is a take."""

from __future__ import annotations

import asyncio
import time
import warnings
from collections.abc import AsyncIterator
from pathlib import Path

from gtsam_rwhec.capture.sources import POLL_S, Message, Source, written_messages
from gtsam_rwhec.errors import FileFormatError, LogError, LogWarning
from gtsam_rwhec.files.whole_files import read_whole
from gtsam_rwhec.logs.image_folder import FORMATS, LARGEST_IMAGE, images_in, match, read_poses
from gtsam_rwhec.logs.mcap_writer import LogWriter
from gtsam_rwhec.logs.pose_tables import stem_of
from gtsam_rwhec.logs.records import Array
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.recorded_logs import APART_NS, FIRST_NS

#: Seconds since a file was last changed before it counts as whole.
SETTLED_S = 0.3


class FolderSource(Source):
    """The images and poses of a folder, as messages of the log that ``calibrate`` makes of such a folder."""

    is_at_rest = True

    def __init__(self, name: str, rig: Rig) -> None:
        super().__init__(name, rig)
        self.folder = Path(name)
        #: The topics that have an image at a stamp, of all that came.
        self.instants: dict[int, frozenset[str]] = {}
        self._stamps: dict[tuple[str, str], int] = {}  # by sensor and the file's name
        self.topics = {"/tf": "foxglove.FrameTransforms"}
        self.topics |= {str(sensor.images): "foxglove.CompressedImage" for sensor in rig.sensors.values()}

    async def messages(self) -> AsyncIterator[Message]:
        """What is there and what comes; ends never."""
        self.is_connected = True
        while True:
            for stamp, images in (await asyncio.to_thread(self._arrived)).items():
                self.instants[stamp] = frozenset(str(self.rig.sensors[name].images) for name, _, _ in images)
                for message in await asyncio.to_thread(self._as_messages, stamp, images):
                    yield message
            await asyncio.sleep(POLL_S)

    def _arrived(self) -> dict[int, list[tuple[str, Path, Array]]]:
        """New images with their sensors and poses, by stamp."""
        stated = self.rig.carriers.poses.stated
        new: dict[int, list[tuple[str, Path, Array]]] = {}
        self.state = "watching the folder"
        for name, sensor in self.rig.sensors.items():
            try:
                if sensor.images is None or sensor.poses is None:
                    raise LogError(f"{self.rig.source.place(('sensors', name))}: a folder needs images and poses")
                files = [file for file in images_in(self.folder / sensor.images) if _is_settled(file)]
                poses = read_poses(self.folder / sensor.poses, stated)
                with warnings.catch_warnings(action="ignore", category=LogWarning):  # what has no pose yet waits
                    matched = match(files, poses, f"{self.folder}, {name}") if files else None
            except FileFormatError as error:
                self.state = f"waiting: {error}"
                continue
            for i, of_pose in zip(matched.images, matched.poses, strict=True) if matched else ():
                if (name, files[i].name) not in self._stamps:
                    stamp = self._stamp(name, files[i].name)
                    new.setdefault(stamp, []).append((name, files[i], poses.T[of_pose]))
        return new

    def _stamp(self, sensor: str, name: str) -> int:
        """The stamp of a new image: of one instant with another sensor's of its name, if the rig file says so."""
        same = [
            stamp
            for (other, of_other), stamp in self._stamps.items()
            if self.rig.carriers.poses.one_instant and stem_of(of_other) == stem_of(name) and other != sensor
        ]
        latest = max(self._stamps.values(), default=FIRST_NS - APART_NS)
        self._stamps[sensor, name] = same[0] if same else latest + APART_NS
        return self._stamps[sensor, name]

    def _as_messages(self, stamp: int, images: list[tuple[str, Path, Array]]) -> list[Message]:
        parent, child = self.rig.carriers.poses.parent_and_child

        def write(out: LogWriter) -> None:
            out.transforms("/tf", stamp, [(parent, child, images[0][2])])
            for name, file, _ in images:
                try:
                    data = read_whole(file, LARGEST_IMAGE, "An image was")
                except FileFormatError as error:
                    self.say("images that cannot be read", str(error))
                    data = b""
                topic, encoding = str(self.rig.sensors[name].images), FORMATS[file.suffix.lower()]
                out.compressed_image(topic, stamp, self.rig.frame_of(name), encoding, data)

        return written_messages(write)


def _is_settled(file: Path) -> bool:
    try:
        return time.time() - file.stat().st_mtime >= SETTLED_S
    except OSError:  # it was moved away
        return False
