"""Intrinsics of sensors that state none (``intrinsics: estimate``), from their images of boards, before detection.

Some of a sensor's images, spread over all of them, are searched with a pinhole in place of the camera that nobody
knows: what detection tests in a board's plane holds for any focal length, and nearly so for most lenses. The corners
give the intrinsics, and detection in all images then has a camera as it always has. The same images give the same
camera, so an interrupted run goes on from the images that were detected with it.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from gtsam_rwhec.errors import CameraError, LogError, LogWarning
from gtsam_rwhec.files.progress import Counted, Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import ImageRecord, Log
from gtsam_rwhec.pipeline.carrier_motion import CarrierMotion
from gtsam_rwhec.pipeline.image_detections import check_usable, detections_of_sensor, message_count
from gtsam_rwhec.pipeline.likely_causes import likely_causes
from gtsam_rwhec.pipeline.seen_sheet import write_contact_sheet
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.detected import Detection, layouts_over_track
from gtsam_rwhec.vision.detection import Detector
from gtsam_rwhec.vision.image_sizes import Size, stated_size
from gtsam_rwhec.vision.many_images import DetectedImage, detect_in_images
from gtsam_rwhec.vision.rejection import Rejection
from gtsam_rwhec.vision.tag_agreement import plane_coordinates
from gtsam_rwhec.vision.targets import Target
from gtsam_rwhec.vision.unknown_intrinsics import CORNERS, ENOUGH, EstimatedIntrinsics, Lens, estimated_intrinsics

#: This many of a sensor's images are searched at first, and this many times as many if they show too few boards.
FIRST, TIMES = 60, 4
#: Images have the size that most of the first so many have.
FOR_SIZE = 20
#: Focal lengths over the width: of a usual lens, and of a fisheye, with which bent boards are searched for again.
USUAL, FISHEYE = 0.87, 0.5
#: These rejections are about poses, which need intrinsics.
ABOUT_POSES = (Rejection.NO_POSE, Rejection.REPROJECTION, Rejection.GRAZING)


@dataclass(frozen=True, eq=False)
class NotEstimated:
    """A sensor whose images determine no intrinsics: why not, what was searched with, and what was found."""

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
        size = _image_size(log, rig, name, sensor.images)
        result = _of_images(log, rig, name, sensor.images, size, sensor.intrinsics.estimate, workers, progress)
        if isinstance(result, NotEstimated):
            failed[name] = result
        else:
            found[name] = result
    return found, failed


def in_words(sensor: str, found: EstimatedIntrinsics) -> str:
    """What was estimated, for a report."""
    K, camera = found.camera.K, found.camera
    bent = ", ".join(f"{k:.4g}" for k in camera.D) if camera.D.any() else "none"
    return (
        f"The intrinsics of {sensor} are estimated from {found.views} views of boards in its images of "
        f"{camera.width} x {camera.height} pixels: "
        f"{camera.model}, fx, fy = {K[0, 0]:.1f}, {K[1, 1]:.1f}, cx, cy = {K[0, 2]:.1f}, {K[1, 2]:.1f}, "
        f"distortion {bent}; {found.rms_px:.2f} px rms over {found.corners} corners."
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
    check_usable(log, rig, found)
    cameras = {name: of.camera for name, of in failed.items()}
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
    """Search images, more of them while there are too few boards, then again if the lens bends the boards."""
    total = message_count(log, topic)
    camera = _camera(size, "pinhole", USUAL)
    images: list[DetectedImage] = []
    looked_at: set[int] = set()
    wanted = FIRST

    def search(which: set[int], camera: Camera) -> list[DetectedImage]:
        records = (record for i, record in enumerate(_records(log, topic)) if i in which)
        makers = {topic: partial(Detector, camera, rig.target_list, rig.detection_options)}
        words = f"estimating the intrinsics of {sensor}: image"
        done = len(images)
        return list(
            detect_in_images(
                records, makers, workers=workers, progress=lambda n: progress(Counted(words, done + n, total))
            )
        )

    while len(looked_at) < total and len(_views(rig, images)) < ENOUGH:
        which = set(np.linspace(0, total - 1, min(wanted, total)).round().astype(int).tolist()) - looked_at
        looked_at |= which
        images += search(which, camera)
        wanted *= TIMES
    result = _estimated(rig, images, size, lens, camera)
    boards = _boards(images)
    if len(_views(rig, images)) < min(boards, ENOUGH):  # boards that a pinhole rejects
        bent = _camera(size, "equidistant", FISHEYE) if isinstance(result, NotEstimated) else result.camera
        images, before = [], images
        again = search(looked_at, bent)
        if len(_views(rig, again)) > len(_views(rig, before)):
            better = _estimated(rig, again, size, lens, bent)
            return result if isinstance(better, NotEstimated) else better
    return result


def _estimated(
    rig: Rig, images: Sequence[DetectedImage], size: Size, lens: Lens, camera: Camera
) -> EstimatedIntrinsics | NotEstimated:
    views = _views(rig, images)
    try:
        return estimated_intrinsics([p for p, _ in views], [u for _, u in views], size, lens)
    except CameraError as error:
        why = str(error)
    if not views and all(len(target.corners()) < CORNERS for target in rig.target_list):
        why += ". The rig file has only single tags, whose four corners do not determine a camera: add a board"
    return NotEstimated(why, camera, list(images))


def _views(rig: Rig, images: Sequence[DetectedImage]) -> list[tuple[Array, Array]]:
    """Corners in their plane (n, 3) and pixels (n, 2) of every flat target that was read, in the images' order."""
    views = []
    for target in rig.target_list:
        flat = _flat(target)
        if flat is None:
            continue
        track = [d for image in images if image.found for d in image.found.detections if d.target == target.name]
        views += [
            (flat[seen.indices], seen.corners_px)
            for seen in layouts_over_track(track)
            if (seen.rejection is None or seen.rejection in ABOUT_POSES) and len(seen.indices) >= CORNERS
        ]
    return views


def _flat(target: Target) -> Array | None:
    """A target's corners (n, 3) in its plane, with z = 0; None where they lie in several planes."""
    corners = target.corners()
    if not corners[:, 2].any():
        return corners
    in_plane = plane_coordinates(corners.reshape(-1, 4, 3))
    return None if in_plane is None else np.pad(in_plane.reshape(-1, 2), ((0, 0), (0, 1)))


def _boards(images: Sequence[DetectedImage]) -> int:
    """How many boards were seen, read or rejected."""
    return sum(len(d.indices) >= CORNERS for image in images if image.found for d in image.found.detections)


def _without_poses(image: DetectedImage) -> DetectedImage:
    """The image without the rejections that intrinsics would have to be right for."""

    def plain(seen: Detection) -> Detection:
        return replace(seen, rejection=None) if seen.rejection in ABOUT_POSES else seen

    if image.found is None:
        return image
    return replace(image, found=replace(image.found, detections=tuple(map(plain, image.found.detections))))


def _camera(size: Size, model: str, focal: float) -> Camera:
    """A camera of a usual focal length, a share of the width, whose axis is in the middle of the image."""
    width, height = size
    K = [[focal * width, 0.0, 0.5 * (width - 1)], [0.0, focal * width, 0.5 * (height - 1)], [0.0, 0.0, 1.0]]
    return Camera.of(width, height, model, K, (), "in place of the camera")


def _image_size(log: Log, rig: Rig, sensor: str, topic: str) -> Size:
    """The size (width, height) of most of a topic's first images."""
    sizes: Counter[Size] = Counter()
    for record in _records(log, topic):
        size = stated_size(record.data) if record.is_compressed else (record.width or 0, record.height or 0)
        if size is not None and min(size) > 0:
            sizes[size] += 1
        if sizes.total() == FOR_SIZE:
            break
    if not sizes:
        place = rig.source.place(("sensors", sensor, "intrinsics"))
        raise LogError(
            f"{place}: intrinsics are to be estimated, and {log.files[0].path}, topic {topic} has no image whose size "
            "can be read"
        )
    return sizes.most_common(1)[0][0]


def _records(log: Log, topic: str) -> Iterator[ImageRecord]:
    """The images of a topic. Detection says later which messages cannot be read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LogWarning)
        for record in log.records([topic]):
            if not isinstance(record, ImageRecord):
                raise LogError(f"topic {record.topic} has no images but {type(record).__name__}s")
            yield record
