"""What became of a log's measurements, for people: counts by target and sensor, reasons, sizes."""

from __future__ import annotations

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from gtsam_rwhec.report.solution_report import print_sentence, report_console
from gtsam_rwhec.results.log_history import LogFields, TrackCount


def print_log(log: LogFields, console: Console | None = None) -> None:
    """Print what was detected, cleaned and left out."""
    console = report_console() if console is None else console
    console.print(_table(log))
    for sentence in log_sentences(log):
        print_sentence(console, sentence)
    console.print()


def log_sentences(log: LogFields) -> list[str]:
    """What was looked at, and everything that was removed, by reason."""
    looked = ", ".join(f"{count} of {sensor}" for sensor, count in log.detection.images.items())
    sentences = [f"Looked at {looked} in {', '.join(log.detection.sources)}."]
    rejected = {why for track in log.detection.tracks for why in track.removed}  # cleaning counts these again
    for stage, tracks, told_before in (
        ("Detections not used", log.detection.tracks, set[str]()),
        ("Removed in cleaning", log.cleaning.tracks, rejected),
    ):
        reasons = _by_reason(tracks, told_before)
        if reasons:
            sentences.append(f"{stage}: {'; '.join(reasons)}.")
    for size in log.sizes:
        if size.is_free and size.sigma is not None:
            found_mm, sigma_mm = (1e3 * size.stated_m * x for x in (1.0 / size.scale, size.sigma / size.scale**2))
            sentences.append(
                f"Size of {size.target}: stated {1e3 * size.stated_m:.3f} mm, found {found_mm:.3f} ± {sigma_mm:.3f} mm "
                f"({100.0 * (size.scale - 1.0):+.2f} %)."
            )
    return sentences


def doubts(log: LogFields) -> list[str]:
    """What a person should look at."""
    said = []
    for sensor, faults in log.detection.undecoded.items():
        if faults:
            said.append(f"{len(faults)} images of {sensor} could not be used, the first: {faults[0]}")
    said += _unused(log)
    contradicted = {counts.frame for counts in log.contradicted}
    given = [clock.sensor for clock in log.time_offsets if clock.sigma_s is None and clock.sensor in contradicted]
    if given:
        said.append(
            f"The clock of {', '.join(given)} was taken as given. If its stamps may be late, set time_offset: estimate "
            "in the rig file."
        )
    free = [size for size in log.sizes if size.is_free]
    for size in free:
        if size.sigma is not None and abs(size.scale - 1.0) > 3.0 * size.sigma:
            said.append(
                f"The stated size of {size.target} does not fit the motion: it is {100.0 * (size.scale - 1.0):+.2f} % "
                "off (printed to fit the page?). It was estimated; measure it again and mend the rig file."
            )
    taken_as_known = [size for size in log.sizes if size.is_doubted and not size.is_free]
    for size in taken_as_known:
        said.append(
            f"The size of {size.target} was taken as stated, but does not fit the motion: it seems to be "
            f"{100.0 * (size.scale - 1.0):+.2f} % off, and poses are off with it. Measure it again, or try sizes: "
            "check in the rig file."
        )
    untold = [size.target for size in log.sizes if size.sigma is None]
    if untold:
        said.append(
            f"The motion does not tell the size of {', '.join(untold)} (it hardly moves from its place?): a wrong one "
            "would go unnoticed."
        )
    doubted = free or taken_as_known
    if len(doubted) > 1 and len(doubted) == len(log.sizes) and np.ptp([size.scale for size in doubted]) < 0.005:
        said.append(
            "All targets are off by about the same: rather the carriers' unit or the focal lengths are wrong than all "
            "sizes."
        )
    if log.detection.strangers:
        names = [f"{name} ({count})" for name, count in list(log.detection.strangers.items())[:10]]
        said.append(f"Tags that are no target were seen: {', '.join(names)}.")
    return said


def _unused(log: LogFields) -> list[str]:
    """Sensors and targets that the rig file has and the answer has not."""
    said = []
    used = {name for track in log.outliers if track.used for name in track.pair}
    for sensor, count in log.detection.images.items():
        if sensor not in used:
            seen = sum(track.used for track in log.detection.tracks if track.sensor == sensor)
            why = f"none of its {seen} detections is left" if seen else f"no target was detected in its {count} images"
            said.append(f"There is no answer for {sensor}: {why}.")
    if log.detection.unseen:
        said.append(f"Targets that were never seen: {', '.join(log.detection.unseen)}.")
    for target in dict.fromkeys(track.target for track in log.detection.tracks):
        if target not in used:
            said.append(f"There is no answer for {target}: none of its detections is left.")
    return said


def _table(log: LogFields) -> Table:
    """Detected, after cleaning, used: for each target and sensor."""
    table = Table(title="Measurements", box=box.SIMPLE_HEAD, title_justify="left")
    for heading in ("target", "sensor"):
        table.add_column(heading)
    for heading in ("seen", "usable", "after cleaning", "used"):
        table.add_column(heading, justify="right")
    cleaned = {track.pair: track for track in log.cleaning.tracks}
    used = {track.pair: track for track in log.outliers}
    for track in log.detection.tracks:
        pair = track.pair
        table.add_row(
            *pair,
            str(track.seen),
            str(track.used),
            str(cleaned[pair].used if pair in cleaned else 0),
            str(used[pair].used if pair in used else 0),
        )
    return table


def _by_reason(tracks: tuple[TrackCount, ...], told_before: set[str]) -> list[str]:
    """Each reason with its count and where it was met; reasons of an earlier stage are left to that one."""
    reasons: dict[str, list[tuple[TrackCount, int]]] = {}
    for track in tracks:
        for why, count in track.removed.items():
            if why not in told_before:
                reasons.setdefault(why, []).append((track, count))
    return [
        f"{sum(count for _, count in found)} {why} ("
        + ", ".join(f"{track.target} in {track.sensor}: {count}" for track, count in found)
        + ")"
        for why, found in sorted(reasons.items())
    ]
