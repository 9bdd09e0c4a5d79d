"""What the detections in images depend on: an unfinished run is gone on with only where all of it is the same."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

import cv2

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.logs import Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.log_contract import IMAGES_METADATA

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
        if sensor.images is not None:
            camera, place = cameras[name], f"sensors.{name}"
            inputs[f"{place}.images"] = sensor.images
            inputs[f"{place}.intrinsics"] = f"{camera.model} {camera.K.tolist()} {camera.D.tolist()}"
            inputs[f"{place}.size"] = f"{camera.width} x {camera.height}"
    for name, section in rig.targets.items():
        inputs |= {f"targets.{name}.{key}": repr(value) for key, value in section.model_dump().items()}
    return inputs | _values("detection", rig.detection_options)


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """In words: what was other before, and what it is now; empty if nothing is."""
    other = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    said = [_difference(name, before.get(name), now.get(name)) for name in other[:MOST_SAID]]
    if len(other) > MOST_SAID:
        said.append(f"{len(other) - MOST_SAID} others")
    return "; ".join(said)


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
