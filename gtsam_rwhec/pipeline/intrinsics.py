"""The intrinsics of each sensor, from the topic, file or numbers that the rig file names."""

from __future__ import annotations

from gtsam_rwhec.errors import CameraError, LogError
from gtsam_rwhec.logs import IntrinsicsRecord, Log
from gtsam_rwhec.logs.message_kinds import INTRINSICS_SCHEMAS
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.intrinsics_files import read_calibration_yaml, read_kalibr_camchain


def read_intrinsics(log: Log, rig: Rig) -> dict[str, Camera]:
    """Read the intrinsics of every sensor that has them. A sensor with images always has them.

    Raises `CameraError` if the intrinsics change within the log, or if no camera can have them; `LogError` or
    `FileFormatError` if a topic or file is missing or cannot be read.
    """
    cameras = {}
    for name, sensor in rig.sensors.items():
        source = sensor.intrinsics
        if source is None:
            continue
        if source.topic is not None:
            cameras[name] = _from_topic(log, source.topic, name)
        elif source.kalibr is not None:
            path = rig.folder / source.kalibr
            chain = read_kalibr_camchain(path)
            if source.camera not in chain:
                raise CameraError(f"{path} has no camera {source.camera!r}; it has {', '.join(chain)}")
            cameras[name] = chain[source.camera]
        elif source.file is not None:
            cameras[name] = read_calibration_yaml(rig.folder / source.file)
        else:
            cameras[name] = source.camera_of_numbers(f"rig file, sensor {name}")
    return cameras


def _from_topic(log: Log, topic: str, sensor: str) -> Camera:
    there = log.topics()
    if topic not in {t.name for t in there}:
        named = ", ".join(t.name for t in there if t.schema in INTRINSICS_SCHEMAS) or "none"
        raise LogError(
            f"sensor {sensor}: {log.files[0].path} has no topic {topic}. Topics of intrinsics in it: {named}. All its "
            f"topics: {log.topics_in_words()}. Intrinsics can also be in a file: {{kalibr: ..., camera: ...}} or "
            "{file: ...}"
        )
    first: Camera | None = None
    for record in log.records([topic]):
        if not isinstance(record, IntrinsicsRecord):
            raise CameraError(f"sensor {sensor}: topic {topic} has no intrinsics but {type(record).__name__}s")
        camera = Camera.of(record.width, record.height, record.model, record.K, record.D, f"topic {topic}")
        first = first or camera
        if _numbers(camera) != _numbers(first):
            raise CameraError(
                f"sensor {sensor}, topic {topic}: intrinsics change at {record.stamp_ns} ns (K from "
                f"{first.K.tolist()} to {camera.K.tolist()}). After a change of zoom or resolution a camera counts as "
                "another one: cut the log there"
            )
    if first is None:
        raise CameraError(f"sensor {sensor}: topic {topic} has no message that can be read")
    return first


def _numbers(camera: Camera) -> tuple[object, ...]:
    """All that two cameras share if they are the same to the last digit."""
    return camera.width, camera.height, camera.model, camera.K.tolist(), camera.D.tolist()
