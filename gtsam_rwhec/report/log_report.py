"""What became of a log's measurements: counts by target and sensor, reasons of removal, sizes."""

from __future__ import annotations

import re
from collections.abc import Iterable

from rich.console import Console

from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.printing import print_sentence, print_tables, report_console
from gtsam_rwhec.results.log_history import LogFields, TrackCount

LEGEND = (
    "seen: detections in the images. usable: detections that were not rejected. cleaned: measurements after the "
    "cleaning. used: measurements in the answer."
)

#: Unit of the compared value at the end of a reason: counts have no unit.
_UNIT = re.compile(r" \((?:s|rad|m|rad/s|m/s|m moved|share that agrees)\)$")


def print_log(log: LogFields, console: Console | None = None) -> None:
    """Print what was detected, what cleaning removed, and what the answer uses."""
    console = report_console() if console is None else console
    print_tables(console, [measurement_table(log)], LEGEND)
    for sentence in log_sentences(log):
        print_sentence(console, sentence)
    console.print()


def log_sentences(log: LogFields) -> list[str]:
    """How many images there are, the reasons of all removals, and the estimated sizes."""
    images = ", ".join(f"{count} of {sensor}" for sensor, count in log.detection.images.items())
    sentences = [f"Images in {', '.join(log.detection.sources)}: {images}."]
    rejected = {why for track in log.detection.tracks for why in track.removed}  # the cleaning counts these again
    for stage, reasons in (
        ("Rejected in detection", _by_reason(log.detection.tracks, set())),
        ("Removed in cleaning", _by_reason(log.cleaning.tracks, rejected)),
    ):
        if reasons:
            sentences.append(f"{stage}: {'; '.join(reasons)}.")
    for size in log.sizes:
        if size.is_free and size.sigma is not None:
            found_mm, sigma_mm = (1e3 * size.stated_m * x for x in (1.0 / size.scale, size.sigma / size.scale**2))
            sentences.append(
                f"Size of {size.target}: stated {1e3 * size.stated_m:.3f} mm, found {found_mm:.3f} ± {sigma_mm:.3f} mm."
            )
    return sentences


def measurement_table(log: LogFields) -> FrameTable:
    """How many measurements of each pair every stage used."""
    cleaned = {track.pair: track.used for track in log.cleaning.tracks}
    used = {count.pair: count.used for count in log.outliers}
    rows = {
        str(track.pair): tuple(map(str, (track.seen, track.used, cleaned.get(track.pair, 0), used.get(track.pair, 0))))
        for track in log.detection.tracks
    }
    return FrameTable("Measurements", "pair", ("seen", "usable", "cleaned", "used"), rows)


def _by_reason(tracks: Iterable[TrackCount], told_before: set[str]) -> list[str]:
    """Each reason with its counts, except the reasons of an earlier stage."""
    reasons: dict[str, dict[str, int]] = {}
    for track in tracks:
        for why, count in track.removed.items():
            if why not in told_before:
                reasons.setdefault(why, {})[str(track.pair)] = count
    return [
        f"{_UNIT.sub('', why)}: {sum(counts.values())} "
        f"({', '.join(f'{count} of {pair}' for pair, count in counts.items())})"
        for why, counts in sorted(reasons.items())
    ]
