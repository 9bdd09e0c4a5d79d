"""Each sensor's intrinsics, from where the rig file says they are."""

from __future__ import annotations

from gtsam_rwhec.errors import CameraError, LogError
from gtsam_rwhec.logs import IntrinsicsRecord, Log
from gtsam_rwhec.logs.message_kinds import INTRINSICS_SCHEMAS
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.intrinsics_files import read_calibration_yaml, read_kalibr_camchain

#: Topics that an error lists, at most.
MOST_NAMED = 50


def read_intrinsics(log: Log, rig: Rig) -> dict[str, Camera]:
    """Read the intrinsics of every sensor; a sensor whose driver gives poses may have none.

    Raises
    ------
    CameraError
        A sensor with images has none, they change within the log, or no camera can have them.
    LogError, FileFormatError
        A topic or file that is not there or cannot be read.
    """
    cameras = {}
    for name, sensor in rig.sensors.items():
        source = sensor.intrinsics
        if source is None:
            if sensor.images is not None:
                there = [t.name for t in log.topics() if t.schema in INTRINSICS_SCHEMAS]
                raise CameraError(
                    f"sensor {name} has images and no intrinsics; topics of them in the log: "
                    f"{', '.join(there) or 'none'}. Give intrinsics: {{topic: ...}}, {{kalibr: ...}} or {{file: ...}}"
                )
        elif source.topic is not None:
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
            assert source.K is not None
            fx, fy, cx, cy = source.K
            K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
            cameras[name] = Camera.of(
                source.width or 0, source.height or 0, source.model or "", K, source.D or (), f"rig file, sensor {name}"
            )
    return cameras


def _from_topic(log: Log, topic: str, sensor: str) -> Camera:
    first: Camera | None = None
    there = log.topics()
    if topic not in {t.name for t in there}:
        named = ", ".join(t.name for t in there if t.schema in INTRINSICS_SCHEMAS) or "none"
        others = ", ".join(t.name for t in there[:MOST_NAMED]) or "none"
        raise LogError(
            f"sensor {sensor}: {log.files[0].path} has no topic {topic}; topics of intrinsics in it: {named}; all its "
            f"topics: {others}. Intrinsics can be in a file too: {{kalibr: ..., camera: ...}} or {{file: ...}}"
        )
    for record in log.records([topic]):
        if not isinstance(record, IntrinsicsRecord):
            raise CameraError(f"sensor {sensor}: topic {topic} has no intrinsics but {type(record).__name__}s")
        camera = Camera.of(record.width, record.height, record.model, record.K, record.D, f"topic {topic}")
        if first is None:
            first = camera
        elif not _is_same(first, camera):
            raise CameraError(
                f"sensor {sensor}, topic {topic}: intrinsics change at {record.stamp_ns} ns (K from "
                f"{first.K.tolist()} to {camera.K.tolist()}); a camera whose zoom or resolution changes is several: "
                "cut the log there"
            )
    if first is None:
        raise CameraError(f"sensor {sensor}: topic {topic} has no message that can be read")
    return first


def _is_same(first: Camera, second: Camera) -> bool:
    """Whether two are the same camera, to the last digit."""
    return (
        (first.width, first.height, first.model) == (second.width, second.height, second.model)
        and first.K.tolist() == second.K.tolist()
        and first.D.tolist() == second.D.tolist()
    )
