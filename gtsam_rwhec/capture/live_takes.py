"""The takes of a session on disk: a whole log for each, which are one log together; and the log that they make.

A take is written beside its place and gets its name once it is whole and on the disk. So a session that is killed at
any moment leaves a folder of whole logs, which `open_log` reads as one and a new session goes on with; and to undo a
take is to remove its file.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gtsam_rwhec.capture.sources import Message
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.logs import DetectionRecord, LogWriter
from gtsam_rwhec.logs.mcap_reader import open_log
from gtsam_rwhec.rig import Rig, rig_text
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.rig.sections import Sensor

#: In a session's folder: the takes, the log that they make, the rig file it is calibrated with, the calibration.
TAKES, RECORDED, RIG_FILE, CALIBRATION = "takes", "recorded.mcap", "rig.yaml", "calibration"
#: This metadata of a take says when it was, and whether the robot stood still.
TAKE_METADATA = "gtsam_rwhec.take"


def live_detections_topic(sensor: str) -> str:
    """The topic of what was seen in a take's images, for viewers; ``calibrate`` detects anew."""
    return f"/live/{sensor}/detections"


@dataclass(frozen=True)
class TakeInfo:
    """What the session itself needs of a take."""

    path: Path
    stamp_ns: int
    is_still: bool


class Takes:
    """The takes in a session's folder, which is made if it is not there.

    Raises
    ------
    LogError
        The folder cannot be made, or a take cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            (folder / TAKES).mkdir(parents=True, exist_ok=True)
            self._held = os.fdopen(os.open(folder / TAKES / ".session", os.O_CREAT | os.O_RDWR))
            fcntl.flock(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for unfinished in (folder / TAKES).glob(".*.part"):
                unfinished.unlink()
        except BlockingIOError as error:
            raise LogError(f"{folder} is in use by another session; end it, or give another folder (-o)") from error
        except OSError as error:
            raise LogError(f"{folder} cannot be used as the session's folder: {error.strerror}.") from error
        self.all = [_info(path) for path in sorted((folder / TAKES).glob("*.mcap"))]

    def add(
        self,
        messages: Iterable[tuple[int, Message]],
        seen: Mapping[str, Sequence[DetectionRecord]],
        stamp_ns: int,
        *,
        is_still: bool,
    ) -> None:
        """Write a take: messages with their log times, and what was seen by each sensor. It is on the disk then.

        Raises `LogError` where it cannot be written: the disk is full, say. Nothing is left of it.
        """
        path = self.folder / TAKES / f"{len(self.all) + 1:04d}.mcap"
        with LogWriter(path) as out:
            for logged_ns, message in sorted(messages, key=lambda each: each[0]):
                out.message(message.channel, message.schema, logged_ns, message.data)
            for sensor, records in seen.items():
                if records:
                    topic = live_detections_topic(sensor)
                    out.detections(topic, records[0].stamp_ns, records[0].frame, records)
            out.metadata(TAKE_METADATA, {"stamp_ns": str(stamp_ns), "is_still": str(int(is_still))})
        self.all.append(TakeInfo(path, stamp_ns, is_still))

    def undo(self) -> TakeInfo | None:
        """Remove the last take; None if there is none. Raises `LogError` where its file cannot be removed."""
        if not self.all:
            return None
        try:
            self.all[-1].path.unlink(missing_ok=True)
        except OSError as error:
            raise LogError(f"{self.all[-1].path} cannot be removed: {error.strerror}.") from error
        return self.all.pop()

    @property
    def paths(self) -> list[Path]:
        """The files of the takes, in the order in which they were made."""
        return [take.path for take in self.all]

    def record(self, rig: Rig) -> tuple[Path, Rig]:
        """Write the takes as one log, and the rig file for it beside it; both, as `calibrate_log` takes them."""
        path, told = self.folder / RECORDED, self.rig_for(rig)
        with open_log(self.paths) as log, LogWriter(path) as out:
            out.copy(log)
        write_atomically(self.folder / RIG_FILE, rig_text(told).encode())
        return path, told

    def rig_for(self, rig: Rig) -> Rig:
        """The rig file for these takes: no clock is looked for if the robot stood still at each, for then none counts.

        Files that it names have whole paths, as it stands in the session's folder.
        """
        sensors = {name: _sensor(each, rig, self.all) for name, each in rig.all_sensors.items()}
        text = rig_text(rig.model_copy(update={"all_sensors": sensors}))
        return parse_rig(text, str(self.folder / RIG_FILE), rig.folder)


def _sensor(sensor: object, rig: Rig, takes: Sequence[TakeInfo]) -> object:
    if not isinstance(sensor, Sensor):
        return sensor
    changed: dict[str, object] = {}
    if sensor.time_offset == "estimate" and all(take.is_still for take in takes):
        changed["time_offset"] = 0.0
    if sensor.intrinsics is not None:
        files = {name: getattr(sensor.intrinsics, name) for name in ("file", "kalibr")}
        whole = {name: str((rig.folder / file).resolve()) for name, file in files.items() if file is not None}
        changed["intrinsics"] = sensor.intrinsics.model_copy(update=whole)
    return sensor.model_copy(update=changed)


def _info(path: Path) -> TakeInfo:
    with open_log(path) as log:
        said = log.metadata().get(TAKE_METADATA)
        if said is None:
            raise LogError(f"{path} is no take of a session; give another folder (-o)")
        return TakeInfo(path, int(said["stamp_ns"]), said["is_still"] == "1")
