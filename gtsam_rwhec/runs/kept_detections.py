"""The detections so far, on disk, from which an interrupted run goes on.

The file has one line for each batch of images, appended when the batch is done: a checksum and JSON. The first line has
the inputs that the detections depend on, the last one says that no image is missing. A killed run may leave an
incomplete line. Its checksum is wrong, so it is dropped, and its images are searched again. Arrays keep every bit.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.detections import Detection, ImageDetections, Rejection
from gtsam_rwhec.detect.many_images import DetectedImage, Kept
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.files.whole_files import appending_stream, write_atomically
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, Log
from gtsam_rwhec.results.log_history import ObjectReport
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.run_log import IMAGES_METADATA

#: A message says at most this many differences, each value with at most this many characters.
MOST_SAID, LONGEST = 5, 80
#: Before the name of a file, and between its state and its stamp.
_FILE, _STAMP = "file ", ", stamp "


def inputs_of(log: Log, rig: Rig, cameras: Mapping[str, Camera], folder: Path | None = None) -> dict[str, str]:
    """What the detections depend on: values by their names in messages.

    Files count by name, size and time of change. `folder` is the one whose images the log has; then its images count
    in place of the log.
    """
    inputs = {"gtsam-rwhec": version("gtsam-rwhec"), "OpenCV": cv2.__version__}
    if folder is None:
        parents = os.path.commonpath([file.path.absolute().parent for file in log.files])
        inputs |= {_FILE + os.path.relpath(file.path, parents): _state(file.path) for file in log.files}
    else:
        of_image = log.metadata().get(IMAGES_METADATA, {})
        inputs |= {_FILE + name: f"{_state(folder / name)}{_STAMP}{key}" for key, name in of_image.items()}
    for name, sensor in rig.sensors.items():
        if sensor.clouds is not None:
            inputs |= {f"sensors.{name}.clouds": sensor.clouds, f"sensors.{name}.unit_m": repr(sensor.unit_m)}
        if name in cameras and sensor.detections is None:
            camera, place = cameras[name], f"sensors.{name}"
            inputs[f"{place}.images"] = str(sensor.images)
            inputs[f"{place}.intrinsics"] = f"{camera.model} {camera.K.tolist()} {camera.D.tolist()}"
            inputs[f"{place}.size"] = f"{camera.width} x {camera.height}"
    for name, section in rig.targets.items():
        inputs |= {f"targets.{name}.{key}": repr(value) for key, value in section.model_dump().items()}
    return inputs | _values("detection", rig.detection_options)


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """A message with the inputs that changed, their values before and now; empty if none changed."""
    other = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    return some([_difference(name, before.get(name), now.get(name)) for name in other], MOST_SAID, between="; ")


def _difference(name: str, before: str | None, now: str | None) -> str:
    words = name.removeprefix(_FILE)
    if before is None or now is None:
        return f"{words} is {'new' if before is None else 'gone'}"
    if words == name:
        return f"{name} was {_short(before)} and is {_short(now)}"
    is_same = before.partition(_STAMP)[0] == now.partition(_STAMP)[0]
    return f"{words} {'has another pose, or another place in its folder' if is_same else 'was changed'}"


def _short(words: str) -> str:
    return words if len(words) <= LONGEST else f"{words[: LONGEST - 3]}..."


def _state(path: Path) -> str:
    try:
        status = path.stat()
    except OSError as error:
        return error.strerror or "cannot be read"
    return f"{status.st_size} bytes, changed at {status.st_mtime_ns} ns"


def _values(place: str, of: object) -> dict[str, str]:
    """The fields of a dataclass."""
    values = dataclasses.asdict(of)  # type: ignore[call-overload]
    return {f"{place}.{name}": repr(value) for name, value in values.items()}


#: The kinds of objects that a line has, by the names that it has for them.
_KINDS: dict[str, Any] = {kind.__name__: kind for kind in (DetectedImage, ImageDetections, Detection, DetectionRecord)}
#: Arrays may have these types.
_DTYPES = ("<f8", "<f4", "<i8", "<i4")


class KeptOfLog(Kept, Protocol):
    """The detections of a log that are kept, in a file or in memory."""

    @property
    def done(self) -> int:
        """How many images are kept, so that an unfinished run goes on."""

    @property
    def is_whole(self) -> bool:
        """Whether no image is missing."""

    def all(self) -> Iterator[DetectedImage]:
        """What was found in all images."""

    def finish(self) -> None:
        """Note that no image is missing."""


class KeptDetections:
    """A file of detections to which batches are appended. The file is made with the first batch."""

    def __init__(self, path: Path, inputs: Mapping[str, str], total: int) -> None:
        self.path = path
        self.inputs = dict(inputs)  #: what the detections depend on
        self.total = total  #: how many images there are
        self.is_whole = False  #: whether no image is missing
        #: Where the line of each batch begins, its length, and how many images it has.
        self._places: dict[int, tuple[int, int, int]] = {}
        #: Where the line of each sensor's registered clouds begins, and its length.
        self._objects: dict[str, tuple[int, int]] = {}
        self._stream: BinaryIO | None = None

    @property
    def done(self) -> int:
        """How many images are kept."""
        return sum(count for _, _, count in self._places.values())

    def go_on(self) -> None:
        """Find which batches the file has; cut off an incomplete last line."""
        with self.path.open("r+b") as stream:
            end = len(stream.readline())
            while line := stream.readline():
                content = _content(line)
                if content is None:
                    break
                if "batch" in content:
                    self._places[int(content["batch"])] = end, len(line), int(content["count"])
                elif "object" in content:
                    self._objects[str(content["object"])] = end, len(line)
                else:
                    self.is_whole = content.get("whole") == self.done
                end += len(line)
            stream.truncate(end)

    def known(self, number: int, batch: Sequence[ImageRecord]) -> list[DetectedImage] | None:
        """The detections of the batch with this number; None if the file lacks it, or its images differ."""
        if number not in self._places:
            return None
        found = self._read(number)
        of_batch = [(image.topic, image.stamp_ns) for image in batch]
        return found if [(image.topic, image.stamp_ns) for image in found] == of_batch else None

    def all(self) -> Iterator[DetectedImage]:
        """What was found in all images, in the order of the batches."""
        for number in sorted(self._places):
            yield from self._read(number)

    def keep(self, number: int, found: list[DetectedImage]) -> None:
        """Append what was found in the batch of this number."""
        place = self._append({"batch": number, "count": len(found), "images": _plain(found)})
        self._places[number] = *place, len(found)

    def known_object(self, sensor: str, of: str) -> tuple[list[DetectionRecord], ObjectReport] | None:
        """What the registration of a sensor's clouds gave; None if the file lacks it, or it is `of` other inputs."""
        content = self._line_at(*self._objects[sensor]) if sensor in self._objects else None
        if content is None or content["of"] != of:
            return None
        return content["records"], ObjectReport.model_validate_json(content["report"])

    def keep_object(self, sensor: str, of: str, records: list[DetectionRecord], report: ObjectReport) -> None:
        """Append what the registration of a sensor's clouds gave; `of` is a checksum of its inputs."""
        line = {"object": sensor, "of": of, "records": _plain(records), "report": report.model_dump_json()}
        self._objects[sensor] = self._append(line)

    def finish(self) -> None:
        """Write the last line, which says that no image is missing."""
        if self.done and not self.is_whole:
            self._append({"whole": self.done})
            self.is_whole = True

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _append(self, content: Mapping[str, Any]) -> tuple[int, int]:
        """Append a line; return where it begins, and its length."""
        line = _line(content)
        try:
            if self._stream is None:
                if not self.path.exists():
                    write_atomically(self.path, _line({"inputs": self.inputs}))
                self._stream = appending_stream(self.path)
            self._stream.write(line)
            self._stream.flush()  # a killed process loses nothing that is flushed
            return self._stream.tell() - len(line), len(line)
        except OSError as error:
            raise LogError(f"{self.path} cannot be written: {error.strerror}.") from error

    def _read(self, number: int) -> list[DetectedImage]:
        start, length, _ = self._places[number]
        content = self._line_at(start, length)
        found: list[DetectedImage] = [] if content is None else content["images"]
        return found

    def _line_at(self, start: int, length: int) -> dict[str, Any] | None:
        try:
            with self.path.open("rb") as stream:
                stream.seek(start)
                content = _content(stream.read(length))
            return None if content is None else {key: _object(value) for key, value in content.items()}
        except (OSError, LookupError, TypeError, ValueError) as error:
            raise LogError(f"{self.path} cannot be read: {error!r}. Remove this file, and start again") from error


def kept_inputs(path: Path) -> dict[str, str] | None:
    """The inputs of the detections that a file keeps; None if there is no such file, or it keeps nothing."""
    try:
        with path.open("rb") as stream:
            content = _content(stream.readline())
    except OSError:
        return None
    inputs = None if content is None else content.get("inputs")
    return inputs if isinstance(inputs, dict) else None


def _line(content: Mapping[str, Any]) -> bytes:
    text = json.dumps(content, separators=(",", ":")).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _content(line: bytes) -> dict[str, Any] | None:
    """The content of a line; None if the line is incomplete."""
    sum_, _, text = line.removesuffix(b"\n").partition(b" ")
    if not line.endswith(b"\n") or sum_ != b"%08x" % zlib.crc32(text):
        return None
    content = json.loads(text)
    return content if isinstance(content, dict) else None


def _plain(value: Any) -> Any:
    """Convert an object to types that JSON has."""
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
        return {"array": base64.b64encode(data.tobytes()).decode(), "dtype": data.dtype.str, "shape": value.shape}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Rejection):
        return {"rejection": value.value}
    if type(value).__name__ in _KINDS:
        of_object = {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
        return {"kind": type(value).__name__, "fields": of_object}
    if isinstance(value, dict):
        return {"items": [[_plain(key), _plain(of_key)] for key, of_key in value.items()]}
    if isinstance(value, tuple):
        return {"tuple": [_plain(each) for each in value]}
    return [_plain(each) for each in value] if isinstance(value, list) else value


def _object(plain: Any) -> Any:
    """Reverse `_plain`."""
    if isinstance(plain, list):
        return [_object(each) for each in plain]
    if not isinstance(plain, dict):
        return plain
    if "array" in plain:
        if plain["dtype"] not in _DTYPES:
            raise ValueError(f"an array of {plain['dtype']!r}")
        data = np.frombuffer(base64.b64decode(plain["array"]), dtype=plain["dtype"])
        return data.reshape(plain["shape"]).copy()
    if "rejection" in plain:
        return Rejection(plain["rejection"])
    if "items" in plain:
        return {_object(key): _object(of_key) for key, of_key in plain["items"]}
    if "tuple" in plain:
        return tuple(_object(each) for each in plain["tuple"])
    return _KINDS[plain["kind"]](**{name: _object(of_name) for name, of_name in plain["fields"].items()})
