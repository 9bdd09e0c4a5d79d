"""The intrinsics of each sensor: from the topic, file or numbers that the rig file names, or from its images of boards.

For ``intrinsics: estimate``, some of a sensor's images, spread over all of them, are searched with a pinhole camera:
the tests of detection in a board's plane hold for any focal length. Distortion bends boards, so many are rejected. A
first camera is estimated from the boards that were read, and, if they are few, from rejected ones too. It searches
these images again, and the others. The same images give the same camera, so an interrupted run can go on.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_files import read_cameras
from gtsam_rwhec.cameras.targets import Target
from gtsam_rwhec.cameras.unknown_intrinsics import CORNERS, ENOUGH, EstimatedIntrinsics, Lens, estimated_intrinsics
from gtsam_rwhec.detect.board_layout import plane_coordinates
from gtsam_rwhec.detect.detections import Detection, Rejection, layouts_over_track
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.detect.images import Size
from gtsam_rwhec.detect.many_images import DetectedImage, detect_in_images
from gtsam_rwhec.errors import CameraError, CameraWarning, FileFormatError, LogError
from gtsam_rwhec.files.progress import Counted, Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import ImageRecord, IntrinsicsRecord, Log
from gtsam_rwhec.logs.records import INTRINSICS_SCHEMAS
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.guessed_boards import usual_lens
from gtsam_rwhec.rig.sections import Intrinsics
from gtsam_rwhec.runs.carrier_motion import CarrierMotion
from gtsam_rwhec.runs.image_pictures import write_contact_sheet
from gtsam_rwhec.runs.sensor_detections import (
    check_usable,
    detections_of_sensor,
    images_of_topic,
    message_count,
    usual_size,
)
from gtsam_rwhec.runs.unread_targets import likely_causes

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
        if source is None or source.estimate is not None or source.shared is not None:
            continue
        if source.topic is not None:
            cameras[name] = _from_topic(log, source.topic, name)
        else:
            cameras[name] = stated_camera(rig, name, source)
        _warn_of_a_fold(cameras[name], name)
    return cameras


def with_shared(cameras: Mapping[str, Camera], rig: Rig) -> dict[str, Camera]:
    """The cameras of all sensors: those of others where the rig file says that they are shared."""
    return {**cameras, **{name: cameras[of.shared] for name, of in rig.sensors.items() if of.shared is not None}}


def check_intrinsics_files(rig: Rig) -> None:
    """Read the intrinsics that are in files, with the errors of `read_intrinsics`, before a log is there."""
    for name, sensor in rig.sensors.items():
        source = sensor.intrinsics
        if source is not None and source.topic is None and source.estimate is None and source.shared is None:
            stated_camera(rig, name, source)


def intrinsics_of(rig: Rig, name: str, announced: Mapping[str, IntrinsicsRecord]) -> Camera | None:
    """The camera of a sensor while messages still come; `announced` has the records so far by topic.

    None where the rig file states none, or its topic has not said any yet. Raises as `read_intrinsics`, and
    `CameraError` where they are to be estimated, which needs the images of a whole log.
    """
    source = rig.sensors[name].intrinsics
    if source is None:
        return None
    if source.shared is not None:
        return intrinsics_of(rig, source.shared, announced)
    if source.estimate is not None:
        raise CameraError(
            f"{rig.source.place(('sensors', name, 'intrinsics'))}: they are to be estimated from a whole log. "
            "Calibrate a log first, and state here what it found (camchain.yaml)"
        )
    if source.topic is None:
        return stated_camera(rig, name, source)
    said = announced.get(source.topic)
    if said is None:
        return None
    return Camera.of(said.width, said.height, said.model, said.K, said.D, f"topic {source.topic}")


def stated_camera(rig: Rig, name: str, source: Intrinsics) -> Camera:
    """The camera from numbers or from a file: the named one, the only one, or that of the sensor's name."""
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
        if camera.numbers != first.numbers:
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


#: This many of a sensor's images are searched at first, and this many times as many if they show too few boards.
FIRST, TIMES = 16, 4
#: With fewer views than this, the first camera also uses those that were rejected because distortion bends them.
FEW = 6
#: These rejections depend on poses, and so on intrinsics.
ABOUT_POSES = (Rejection.NO_POSE, Rejection.REPROJECTION, Rejection.GRAZING)


@dataclass(frozen=True, eq=False)
class NotEstimated:
    """A sensor whose images determine no intrinsics: why not, the camera for the search, and the detections."""

    why: str
    camera: Camera
    images: list[DetectedImage]


def estimate_intrinsics(
    log: Log, rig: Rig, *, workers: int | None, progress: Progress
) -> tuple[dict[str, EstimatedIntrinsics], dict[str, NotEstimated]]:
    """The intrinsics of each sensor of the rig file that states none, and those sensors whose images determine none.

    Raises `LogError` if a topic has no image whose size can be read.
    """
    found: dict[str, EstimatedIntrinsics] = {}
    failed: dict[str, NotEstimated] = {}
    for name, sensor in rig.sensors.items():
        if sensor.images is None or sensor.intrinsics is None or sensor.intrinsics.estimate is None:
            continue
        size = usual_size(log, sensor.images)
        if size is None:
            place = rig.source.place(("sensors", name, "intrinsics"))
            raise LogError(
                f"{place}: intrinsics are to be estimated, and {log.files[0].path}, topic {sensor.images} has no image "
                "whose size can be read"
            )
        result = _of_images(log, rig, name, sensor.images, size, sensor.intrinsics.estimate, workers, progress)
        if isinstance(result, NotEstimated):
            failed[name] = result
        else:
            found[name] = result
    return found, failed


def in_words(sensor: str, found: EstimatedIntrinsics) -> str:
    """A sentence for the report about the estimated intrinsics."""
    K, camera = found.camera.K, found.camera
    bent = ", ".join(f"{k:.4g}" for k in camera.D) if camera.D.any() else "none"
    return (
        f"No intrinsics of {sensor} are stated. Detection worked with a first estimate, from {found.views} views of "
        f"boards in its images of {camera.width} x {camera.height} pixels: {camera.model}, "
        f"fx, fy = {K[0, 0]:.1f}, {K[1, 1]:.1f}, cx, cy = {K[0, 2]:.1f}, {K[1, 2]:.1f}, distortion {bent}; "
        f"{found.rms_px:.2f} px rms over {found.corners} corners. "
        "If you have a calibration of this camera, state it in the rig file."
    )


def refuse_not_estimated(
    log: Log, rig: Rig, failed: Mapping[str, NotEstimated], motion: CarrierMotion, sheet: str | Path | None
) -> None:
    """Raise `CameraError` for sensors whose images determine no intrinsics, with what their images show.

    The contact sheet of the images that were searched is written first. Raises `LogError` if none can be used.
    """
    found = {
        name: detections_of_sensor(log, rig, name, [_without_poses(image) for image in of.images], motion)
        for name, of in failed.items()
    }
    cameras = {name: of.camera for name, of in failed.items()}
    check_usable(log, rig, found, cameras)
    has_sheet = sheet is not None and write_contact_sheet(Path(sheet), log, rig, cameras, found)
    said = []
    for name, of in failed.items():
        said.append(
            f"{rig.source.place(('sensors', name, 'intrinsics'))}: the intrinsics of {name} {of.why}. {len(of.images)} "
            f"of its {message_count(log, rig.sensors[name].images)} images were searched. Or state intrinsics: a file, "
            "a topic or numbers"
        )
    said += likely_causes(log, rig, cameras, found)
    shown = f"\n{sheet} shows some of the images." if has_sheet else ""
    raise CameraError("\n- ".join(said) + shown)


def _of_images(
    log: Log, rig: Rig, sensor: str, topic: str, size: Size, lens: Lens, workers: int | None, progress: Progress
) -> EstimatedIntrinsics | NotEstimated:
    """Search some images with a pinhole; while boards are few, search more with a camera from the boards so far."""
    total = message_count(log, topic)
    camera = pinhole = usual_lens(size).camera
    found: dict[int, DetectedImage] = {}
    searched: set[int] = set()

    def search(which: set[int]) -> None:
        looked_at: list[int] = []

        def images() -> Iterator[ImageRecord]:
            for i, record in enumerate(images_of_topic(log, topic)):
                if i in which:
                    looked_at.append(i)
                    yield record

        done = len(searched - which)
        words = f"estimating the intrinsics of {sensor}: image"
        makers = {topic: partial(Detector, camera, rig.target_list, rig.detection_options)}
        seen = detect_in_images(
            images(), makers, workers=workers, progress=lambda n: progress(Counted(words, done + n, total))
        )
        found.update(zip(looked_at, list(seen), strict=False))  # in their order: they are of one topic

    wanted = FIRST
    while True:
        which = set(np.linspace(0, total - 1, min(wanted, total)).round().astype(int).tolist()) - searched
        searched |= which
        search(which)
        if camera is pinhole:
            camera = _roughly(rig, found, size, lens) or pinhole
            if camera is not pinhole:
                search({i for i, image in found.items() if _rejected(image)})
        if len(searched) == total or len(_views(rig, found)) >= ENOUGH:
            break
        wanted *= TIMES
    views = _views(rig, found)
    try:
        return estimated_intrinsics([p for p, _ in views], [u for _, u in views], size, lens)
    except CameraError as error:
        why = str(error)
    if not views and all(len(target.corners()) < CORNERS for target in rig.target_list):
        why += ". The rig file has only single tags, whose four corners do not determine a camera: add a board"
    return NotEstimated(why, camera, [found[i] for i in sorted(found)])


def _roughly(rig: Rig, found: Mapping[int, DetectedImage], size: Size, lens: Lens) -> Camera | None:
    """A camera from the boards that were read; if they are few, also from those rejected for their distortion."""
    views = _views(rig, found)
    if len(views) < FEW:
        views = _views(rig, found, (*ABOUT_POSES, Rejection.NOT_A_GRID))
    try:
        return estimated_intrinsics([p for p, _ in views], [u for _, u in views], size, lens).camera
    except CameraError:
        return None


def _views(
    rig: Rig, found: Mapping[int, DetectedImage], also: Sequence[Rejection] = ABOUT_POSES
) -> list[tuple[Array, Array]]:
    """Corners in their plane (n, 3) and pixels (n, 2) of every flat target that was read, in the images' order.

    Rejected detections are skipped, except for the rejections `also`.
    """
    views = []
    images = [found[i].found for i in sorted(found)]
    for target in rig.target_list:
        flat = _flat(target)
        if flat is None:
            continue
        track = [d for image in images if image for d in image.detections if d.target == target.name]
        views += [
            (flat[seen.indices], seen.corners_px)
            for seen in layouts_over_track(track)
            if (seen.rejection is None or seen.rejection in also) and len(seen.indices) >= CORNERS
        ]
    return views


def _rejected(image: DetectedImage) -> bool:
    """Whether a board in an image was rejected, but for its pose."""
    seen = image.found.detections if image.found else ()
    return any(d.rejection is not None and d.rejection not in ABOUT_POSES and len(d.indices) >= CORNERS for d in seen)


def _flat(target: Target) -> Array | None:
    """A target's corners (n, 3) in its plane, with z = 0; None where they lie in several planes."""
    corners = target.corners()
    if not corners[:, 2].any():
        return corners
    in_plane = plane_coordinates(corners.reshape(-1, 4, 3))
    return None if in_plane is None else np.pad(in_plane.reshape(-1, 2), ((0, 0), (0, 1)))


def _without_poses(image: DetectedImage) -> DetectedImage:
    """The image without the rejections that depend on the intrinsics."""

    def plain(seen: Detection) -> Detection:
        return replace(seen, rejection=None) if seen.rejection in ABOUT_POSES else seen

    if image.found is None:
        return image
    return replace(image, found=replace(image.found, detections=tuple(map(plain, image.found.detections))))
