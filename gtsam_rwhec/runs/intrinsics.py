"""The intrinsics of each sensor, from the topic, file or numbers that the rig file names."""

from __future__ import annotations

import warnings

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_files import read_cameras
from gtsam_rwhec.errors import CameraError, CameraWarning, FileFormatError, LogError
from gtsam_rwhec.logs import IntrinsicsRecord, Log
from gtsam_rwhec.logs.records import INTRINSICS_SCHEMAS
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.sections import Intrinsics

#: Lens models without rays for more than this share of the image are warned of.
FOLDED = 0.01


def read_intrinsics(log: Log, rig: Rig) -> dict[str, Camera]:
    """Read the intrinsics of every sensor that has them; `estimated_intrinsics` has those that are to be estimated.

    Warns with `CameraWarning` of a lens model that folds back within the image.

    Raises `CameraError` if the intrinsics change within the log, or if no camera can have them; `LogError` or
    `FileFormatError` if a topic or file is missing or cannot be read.
    """
    cameras = {}
    for name, sensor in rig.sensors.items():
        source = sensor.intrinsics
        if source is None or source.estimate is not None:
            continue
        if source.topic is not None:
            cameras[name] = _from_topic(log, source.topic, name)
        else:
            cameras[name] = _stated(rig, name, source)
        _warn_of_a_fold(cameras[name], name)
    return cameras


def check_intrinsics_files(rig: Rig) -> None:
    """Read the intrinsics that are in files, with the errors of `read_intrinsics`, before a log is there."""
    for name, sensor in rig.sensors.items():
        source = sensor.intrinsics
        if source is not None and source.topic is None and source.estimate is None:
            _stated(rig, name, source)


def _stated(rig: Rig, name: str, source: Intrinsics) -> Camera:
    """A camera of numbers, or of a file: the one that is named, or the only one, or the one of the sensor's name."""
    file = source.kalibr or source.file
    if file is None:
        return source.camera_of_numbers(f"rig file, sensor {name}")
    place = rig.source.place(("sensors", name, "intrinsics"))
    try:
        cameras = read_cameras(rig.folder / file, source.size)
    except FileFormatError as error:
        raise FileFormatError(f"{error} ({place}; the path starts from {rig.folder})") from error
    if source.camera is not None:
        wanted = source.camera
    else:
        wanted = name if name in cameras or len(cameras) > 1 else next(iter(cameras))
    if wanted not in cameras:
        named = ", ".join(cameras) if "" not in cameras else "one alone, without a name"
        what = "camera" if source.camera is not None else "camera of the sensor's name,"
        cure = "leave camera out" if "" in cameras else f"write {{file: {file}, camera: '{next(iter(cameras))}'}}, say"
        raise CameraError(f"{place}: {rig.folder / file} has no {what} {wanted!r}; it has {named}: {cure}")
    return cameras[wanted]


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


def _warn_of_a_fold(camera: Camera, sensor: str) -> None:
    share = camera.share_beyond_fold
    if share > FOLDED:
        warnings.warn(
            f"sensor {sensor}: the distortion ({camera.model}, D = {camera.D.tolist()}) folds back "
            f"{camera.reach_px:.0f} pixels from the centre: {100.0 * share:.0f} % of the image has no ray, and targets "
            "that reach into it are rejected. Check D, its order and its model, or calibrate with a board at the "
            "image's borders",
            CameraWarning,
            stacklevel=3,
        )


def _numbers(camera: Camera) -> tuple[object, ...]:
    """All that two cameras share if they are the same to the last digit."""
    return camera.width, camera.height, camera.model, camera.K.tolist(), camera.D.tolist()
