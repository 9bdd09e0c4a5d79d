"""A contact sheet of some images of a run, and a picture of each image, with what was found and rejected."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.contact_sheet import WIDTH, Band, Detail, Outcome, Outline, Tile, contact_sheet, detail_of
from gtsam_rwhec.detect.images import Gray, decode_gray, decode_small
from gtsam_rwhec.detect.pictures import draw
from gtsam_rwhec.errors import ImageError, OptionError
from gtsam_rwhec.files.progress import Counted, Progress
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.output_folder import made_folder
from gtsam_rwhec.runs.run_log import image_name, image_names, picture_file
from gtsam_rwhec.runs.sensor_detections import SensorDetections

#: A sheet has about this many images, of all sensors together, and of each sensor at least `LEAST`.
MOST, LEAST = 60, 4
#: Images are decoded at this many times the width of a small picture, for targets that are small in them.
LARGE = 4
#: Small pictures are decoded by this many threads.
THREADS = 2
#: With these the file is a third smaller than with OpenCV's defaults, which look for runs of equal bytes only.
COMPRESSED = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT)
#: Reasons are counted in a sensor's header up to this number.
MOST_REASONS = 4


def write_contact_sheet(
    path: Path, log: Log, rig: Rig, cameras: Mapping[str, Camera], found: Mapping[str, SensorDetections]
) -> bool:
    """Write the sheet of all sensors with images as a PNG file; return whether there is one.

    The sheet has images of all kinds: rejected, failed, without a detection, and with a target. Rejected and failed
    images are chosen first; those of each kind are spread over time. Only the images shown are read and decoded.
    """
    sensors = [sensor for sensor, of_sensor in found.items() if of_sensor.images]
    if not sensors:
        return False
    names = image_names(log)
    bands = []
    for sensor in sensors:
        of_sensor, topic = found[sensor], rig.sensors[sensor].images
        assert topic is not None
        records = _by_stamp(of_sensor.records)
        outcomes = {stamp: outcome_of(records[stamp], looked.fault) for stamp, looked in of_sensor.images.items()}
        shown = sample(outcomes, max(LEAST, MOST // len(sensors)))
        outlines = {stamp: _outlines(records[stamp], cameras[sensor]) for stamp in shown}
        small = _small_pictures(log, topic, {stamp: of_sensor.images[stamp].logged_ns for stamp in shown}, outlines)
        tiles = tuple(
            Tile(
                outcomes[stamp][0],
                Path(image_name(names, topic, stamp)).name,
                outcomes[stamp][1],
                small[stamp][0] if stamp in small else None,
                outlines[stamp],
                small[stamp][1] if stamp in small else None,
            )
            for stamp in shown
        )
        bands.append(Band(sensor, _counts(outcomes, len(shown)), tiles))
    is_written, data = cv2.imencode(".png", contact_sheet(bands), COMPRESSED)
    assert is_written
    write_atomically(path, data.tobytes())
    return True


def outcome_of(records: Sequence[DetectionRecord], fault: str) -> tuple[Outcome, str]:
    """What became of an image, and the words for it."""
    if fault:
        return Outcome.FAILED, fault.partition(" ns: ")[2] or fault
    rejected = [f"{record.id}: {record.reason}" for record in records if record.reason]
    used = [record.id for record in records if not record.reason]
    if used:
        return Outcome.FOUND, ", ".join(used) + (f"; rejected {', '.join(rejected)}" if rejected else "")
    return (Outcome.REJECTED, ", ".join(rejected)) if rejected else (Outcome.NOTHING, "")


def sample(outcomes: Mapping[int, tuple[Outcome, str]], most: int) -> list[int]:
    """Choose at most `most` images; return their stamps in order of time.

    Up to half are rejected or failed images, the reasons in turn. Of the rest, up to half are images without a
    detection. If a kind has fewer, other kinds fill its places.
    """
    of_kind: dict[tuple[Outcome, str], list[int]] = defaultdict(list)
    for stamp, (outcome, words) in sorted(outcomes.items()):
        reason = words if outcome in (Outcome.REJECTED, Outcome.FAILED) else ""
        of_kind[outcome, reason].append(stamp)
    bad = [of_kind[kind] for kind in of_kind if kind[0] in (Outcome.REJECTED, Outcome.FAILED)]
    nothing, good = of_kind[Outcome.NOTHING, ""], of_kind[Outcome.FOUND, ""]
    many_bad = sum(map(len, bad))
    many = len(nothing) + len(good)
    for_bad = min(many_bad, max(most // 2, most - many))
    for_nothing = min(len(nothing), max((most - for_bad) // 2, most - for_bad - len(good)))
    for_good = min(len(good), most - for_bad - for_nothing)
    chosen = [stamp for members, k in zip(bad, _in_turn(list(map(len, bad)), for_bad), strict=True)
              for stamp in _spread(members, k)]  # fmt: skip
    return sorted(chosen + _spread(nothing, for_nothing) + _spread(good, for_good))


def _in_turn(counts: list[int], most: int) -> list[int]:
    """How many to take of each kind: one of each in turn, until there are `most`."""
    given = [0] * len(counts)
    while sum(given) < min(most, sum(counts)):
        for i, count in enumerate(counts):
            if given[i] < count and sum(given) < most:
                given[i] += 1
    return given


def _spread(members: Sequence[int], count: int) -> list[int]:
    """Choose `count` members, spread evenly, with the first and the last."""
    if count == 1:
        return [members[len(members) // 2]]
    return [members[i] for i in np.linspace(0, len(members) - 1, count).round().astype(int).tolist()] if count else []


def _by_stamp(records: Sequence[DetectionRecord]) -> dict[int, list[DetectionRecord]]:
    of_stamp: dict[int, list[DetectionRecord]] = defaultdict(list)
    for record in records:
        of_stamp[record.stamp_ns].append(record)
    return of_stamp


def _small_pictures(
    log: Log, topic: str, logged_ns: Mapping[int, int], outlines: Mapping[int, tuple[Outline, ...]]
) -> dict[int, tuple[Gray, Detail | None]]:
    """Small pictures by stamp, with a larger detail of a small first target. Undecodable images are missing."""
    images = [
        record
        for record in log.records_logged_at([topic], logged_ns.values())
        if isinstance(record, ImageRecord) and record.stamp_ns in logged_ns
    ]
    with ThreadPoolExecutor(THREADS) as threads:
        small = list(threads.map(_small_picture, images, [outlines[image.stamp_ns] for image in images]))
    return {image.stamp_ns: pictures for image, pictures in zip(images, small, strict=True) if pictures is not None}


def _small_picture(image: ImageRecord, outlines: tuple[Outline, ...]) -> tuple[Gray, Detail | None] | None:
    try:
        large = decode_small(image, LARGE * WIDTH)
    except ImageError:
        return None  # the report names it, and the sheet says so
    height = max(1, round(large.shape[0] / LARGE))
    small = np.asarray(cv2.resize(large, (WIDTH, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return small, detail_of(large, outlines[0]) if outlines else None


def _outlines(records: Sequence[DetectionRecord], camera: Camera) -> tuple[Outline, ...]:
    return tuple(
        Outline((record.corners_px + 0.5) / camera.width, not record.reason)
        for record in records
        if record.corners_px is not None and len(record.corners_px)
    )


def _counts(outcomes: Mapping[int, tuple[Outcome, str]], shown: int) -> str:
    """A sensor's header: how many images there are of each kind, and why."""
    counts = Counter(outcome for outcome, _ in outcomes.values())
    parts = []
    for outcome in Outcome:
        if not counts[outcome]:
            continue
        words = f"{outcome.mark} {counts[outcome]} {outcome.word}"
        if outcome is Outcome.REJECTED:
            reasons = Counter(words for kind, words in outcomes.values() if kind is outcome)
            named = [f"{count} {reason}" for reason, count in reasons.most_common(MOST_REASONS)]
            rest = len(reasons) - len(named)
            words += f" ({', '.join(named)}{f' and {rest} more reasons' if rest else ''})"
        parts.append(words)
    some = "all shown" if shown == len(outcomes) else f"{shown} shown"
    return f"{len(outcomes)} images ({some}): {' | '.join(parts)}"


def check_drawable(rig: Rig, folder: str | Path) -> None:
    """Raise `OptionError` if no sensor has images in which detections can be drawn."""
    if not has_images(rig):
        raise OptionError(
            f"{folder} (--draw): no sensor of the rig file has images in which detections can be drawn. Leave the "
            "option out"
        )


def has_images(rig: Rig) -> bool:
    """Whether a sensor of the rig file has images."""
    return any(source.images is not None for source in rig.sensors.values())


def draw_images(
    log: Log,
    rig: Rig,
    cameras: Mapping[str, Camera],
    records: Mapping[str, Iterable[DetectionRecord]],
    folder: str | Path,
    tell: Progress,
) -> int:
    """Draw every image that can be decoded, with its detections if it has any; return the number of pictures.

    Files are ``<sensor>_<name>.png``, where the name is that of the image's file, or its stamp.
    """
    check_drawable(rig, folder)
    folder = made_folder(folder)
    names = image_names(log)
    drawn = {sensor: source.images for sensor, source in rig.sensors.items() if source.images is not None}
    total = sum(topic.count for topic in log.topics() if topic.name in drawn.values())
    count, taken = 0, set[str]()
    for sensor, topic in drawn.items():
        of_stamp: dict[int, list[DetectionRecord]] = defaultdict(list)
        for record in records[sensor]:
            of_stamp[record.stamp_ns].append(record)
        for image in log.records([topic]):
            if not isinstance(image, ImageRecord):
                continue
            try:
                gray = decode_gray(image, (cameras[sensor].width, cameras[sensor].height))
            except ImageError:
                continue  # the report of detection names it
            seen, name = of_stamp[image.stamp_ns], image_name(names, topic, image.stamp_ns)
            file = picture_file(sensor, name)
            if file in taken:  # two names that differ in their endings, or in characters that files should not have
                file = picture_file(sensor, f"{name} {image.stamp_ns}.")
            taken.add(file)
            picture = draw(gray, seen, cameras[sensor], f"{sensor}, {name}: {_in_words(seen)}")
            is_written, data = cv2.imencode(".png", picture)
            assert is_written
            write_atomically(folder / file, data.tobytes())
            count += 1
            tell(Counted("drawing: image", count, total))
    return count


def _in_words(records: Iterable[DetectionRecord]) -> str:
    said = [f"{record.id} {f'rejected, {record.reason}' if record.reason else 'found'}" for record in records]
    return "; ".join(said) or "nothing seen"
