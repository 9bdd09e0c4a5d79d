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
from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.files.progress import Counted, Progress
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.output_folder import made_folder
from gtsam_rwhec.runs.run_log import image_name, image_names, picture_file
from gtsam_rwhec.runs.sensor_detections import SensorDetections, image_count, images_at, spread

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
        images = images_at(log, topic, of_sensor, shown)
        with ThreadPoolExecutor(THREADS) as threads:
            pictures = list(threads.map(_small_picture, images, [outlines[image.stamp_ns] for image in images]))
        small = {image.stamp_ns: picture for image, picture in zip(images, pictures, strict=True)}
        tiles = []
        for stamp in shown:
            (outcome, words), (gray, detail) = outcomes[stamp], small.get(stamp, (None, None))
            name = Path(image_name(names, topic, stamp)).name
            tiles.append(Tile(outcome, name, words, gray, outlines[stamp], detail))
        bands.append(Band(sensor, _counts(outcomes, len(shown)), tuple(tiles)))
    _write_png(path, contact_sheet(bands), COMPRESSED)
    return True


def _write_png(path: Path, picture: np.ndarray, how: Sequence[int] = ()) -> None:
    is_written, data = cv2.imencode(".png", picture, how)
    assert is_written
    write_atomically(path, data.tobytes())


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
    of_bad = zip(bad, _in_turn(list(map(len, bad)), for_bad), strict=True)
    chosen = [stamp for members, count in of_bad for stamp in spread(members, count)]
    return sorted(chosen + spread(nothing, for_nothing) + spread(good, for_good))


def _in_turn(counts: list[int], most: int) -> list[int]:
    """How many to take of each kind: one of each in turn, until there are `most`."""
    given = [0] * len(counts)
    while sum(given) < min(most, sum(counts)):
        for i, count in enumerate(counts):
            if given[i] < count and sum(given) < most:
                given[i] += 1
    return given


def _by_stamp(records: Iterable[DetectionRecord]) -> dict[int, list[DetectionRecord]]:
    of_stamp: dict[int, list[DetectionRecord]] = defaultdict(list)
    for record in records:
        of_stamp[record.stamp_ns].append(record)
    return of_stamp


def _small_picture(image: ImageRecord, outlines: tuple[Outline, ...]) -> tuple[Gray | None, Detail | None]:
    """An image's small picture, with a larger detail of a small first target; neither if it cannot be decoded."""
    try:
        large = decode_small(image, LARGE * WIDTH)
    except ImageError:
        return None, None  # the report names it, and the sheet says so
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
    folder = made_folder(folder)
    names = image_names(log)
    drawn = {sensor: source.images for sensor, source in rig.sensors.items() if source.images is not None}
    total = image_count(log, rig)
    count, taken = 0, set[str]()
    for sensor, topic in drawn.items():
        of_stamp = _by_stamp(records[sensor])
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
            _write_png(folder / file, picture)
            count += 1
            tell(Counted("drawing: image", count, total))
    return count


def _in_words(records: Iterable[DetectionRecord]) -> str:
    said = [f"{record.id} {f'rejected, {record.reason}' if record.reason else 'found'}" for record in records]
    return "; ".join(said) or "nothing seen"
