"""Section 3: what was seen: images, detections over time, corners in the image, what was removed, the worst images."""

from __future__ import annotations

from collections.abc import Iterator

from gtsam_rwhec.report.page.blocks import (
    Block,
    Chart,
    Folded,
    Listing,
    Paragraph,
    Picture,
    Piece,
    Section,
    Table,
    Words,
)
from gtsam_rwhec.report.page.empty_regions import empty_in_words
from gtsam_rwhec.report.page.seen_figures import MOST_CAMERAS, coverage_figure, detections_figure
from gtsam_rwhec.report.page.shown_result import ShownResult
from gtsam_rwhec.results.detection_evidence import MOST_LISTED, PIECES, RemovedMeasurement, SeenEvidence

#: A table of removed measurements with more rows is folded.
MOST_ROWS = 20
#: So many sentences of one kind are shown.
MOST_SENTENCES = 20
ONE_BY_ONE = ("image", "time, s", "target", "sensor", "reason")
TITLE = "What was seen"


def seen_section(shown: ShownResult) -> Section:
    """All that was seen, as far as it is known."""
    seen = None if shown.evidence is None else shown.evidence.seen
    if seen is None:
        return Section("seen", TITLE, missing="the result has no record of its measurements beside it.")
    blocks = [
        *_counts(shown, seen),
        *_detections(seen),
        *_coverage(shown, seen),
        *_removed(shown, seen),
        *_worst(shown, seen),
        *_sheet(shown, seen),
    ]
    return Section("seen", TITLE, tuple(blocks))


def _counts(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    """How much there is, and what of it cannot be used."""
    used, removed = (shown.evident("seen", name, spec=",.0f") for name in ("used", "removed"))
    if seen.removed:
        yield Paragraph((used, " measurements are in the answer; ", removed, " were removed."), "lead")
    else:
        yield Paragraph((used, " measurements are in the answer; none was removed."), "lead")
    detection = shown.tree.get("log", {}).get("detection", {})
    images = detection.get("images", {})
    if images:
        words: list[Piece] = ["Looked at (images, or messages of a detector): "]
        for sensor in list(images)[:MOST_SENTENCES]:
            words += [shown.number("log", "detection", "images", sensor, spec=",.0f"), f" of {sensor}, "]
        words[-1] = str(words[-1]).removesuffix(", ") + (" and others." if len(images) > MOST_SENTENCES else ".")
        yield Paragraph(tuple(words))
    if detection.get("unseen"):
        yield Paragraph(f"No sensor saw {', '.join(detection['unseen'])}.", "care")
    said = [*detection.get("likely", ()), *detection.get("remarks", ())]
    if said:
        yield Listing(tuple(said[:MOST_SENTENCES]))
    faults = [fault for of_sensor in detection.get("undecoded", {}).values() for fault in of_sensor]
    if faults:
        yield Paragraph(f"{len(faults):,} images could not be used.", "care")
        some = (*faults[:MOST_SENTENCES], *_and_more(len(faults) - MOST_SENTENCES, "result.json has them"))
        yield Folded("Images that could not be used", (Listing(some),))


def _detections(seen: SeenEvidence) -> Iterator[Block]:
    if not seen.tracks:
        return
    rows = "a row for each target and sensor" if seen.tracks[0].target is not None else "a row for each sensor"
    left = "" if seen.used + seen.removed == _drawn(seen) else " Only the sensors with the most removed ones are shown."
    piece = (
        f"one tick stands for all within {seen.span_s / PIECES:.2g} s"
        if seen.span_s
        else "there are no stamps, so each pair stands in the order in which it was given, from its first to its last"
    )
    yield Chart(
        "detections",
        "Detections over time",
        f"A tick for each measurement in the answer, a sign above where it was removed: {rows}, {piece}.{left}",
        detections_figure(seen),
    )


def _drawn(seen: SeenEvidence) -> int:
    return sum(track.used + track.removed for track in seen.tracks)


def _removed(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    """What was removed: counts with their reasons, and the single measurements."""
    if not seen.removed_counts:
        return
    order = sorted(range(len(seen.removed_counts)), key=lambda i: -seen.removed_counts[i].count)
    rows: list[tuple[Words, ...]] = []
    for i in order:
        one = seen.removed_counts[i]
        count = shown.evident("seen", "removed_counts", i, "count", spec=",.0f")
        rows.append((one.reason, count, one.stage, one.target, one.sensor))
    headings = ("reason", "removed", "by", "target", "sensor")
    table = Table("Removed measurements", headings, tuple(rows[:MOST_ROWS]))
    yield table
    if len(rows) > MOST_ROWS:
        rest = Table("Removed measurements: the others", headings, tuple(rows[MOST_ROWS:]))
        yield Folded(f"{len(rows) - MOST_ROWS} more rows", (rest,))
    if seen.removed_list:
        where = "the topics /calibration/SENSOR/pairs of clean.mcap have them" if "log" in shown.tree else ""
        more = seen.removed - len(seen.removed_list) if len(seen.removed_list) == MOST_LISTED else 0
        blocks: list[Block] = [
            Table(
                "Removed, one by one",
                ("image", "time, s", "target", "sensor", "reason"),
                tuple(map(_row, seen.removed_list)),
            )
        ]
        blocks += [Paragraph(words, "note") for words in _and_more(more, where)]
        title = f"The first {MOST_LISTED} of them, one by one" if more else "All of them, one by one"
        yield Folded(title, tuple(blocks))


def _row(one: RemovedMeasurement) -> tuple[Words, ...]:
    return one.image, "" if one.time_s is None else f"{one.time_s:.3f}", one.target, one.sensor, one.reason


def _and_more(count: int, where: str) -> tuple[str, ...]:
    if count <= 0:
        return ()
    return (f"And {count:,} more{f': {where}' if where else ''}.",)


def _coverage(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    """Where in their images cameras saw corners."""
    if not seen.cameras:
        yield Paragraph(
            "Not shown: where in the image targets were seen, and the worst images. The measurements have no corners.",
            "note",
        )
        return
    cells = seen.cameras[0].cells
    number = f"{max(len(cells), len(cells[0]))} x {min(len(cells), len(cells[0]))}"
    yield Chart(
        "coverage",
        "Coverage of the images",
        f"Each camera's image in {number} cells, with corners of images in the answer; the share of the cells that "
        "have any, and shaded the cells that have none: what the lens does there, no corner says."
        + (f" The first {MOST_CAMERAS} cameras." if len(seen.cameras) > MOST_CAMERAS else ""),
        coverage_figure(seen.cameras),
    )
    yield Listing(tuple(f"{camera.sensor}: {empty_in_words(camera.cells)}" for camera in seen.cameras))
    rows: list[tuple[Words, ...]] = []
    for i, camera in enumerate(seen.cameras):
        noise = "" if camera.noise_px is None else shown.evident("seen", "cameras", i, "noise_px", spec=".3f")
        rows.append(
            (
                camera.sensor,
                shown.evident("seen", "cameras", i, "images", spec=",.0f"),
                shown.evident("seen", "cameras", i, "corners", spec=",.0f"),
                shown.evident("seen", "cameras", i, "share", times=100.0, spec=".0f"),
                shown.evident("seen", "cameras", i, "rms_px", spec=".3f"),
                noise,
            )
        )
    yield Table(
        "Corners of the images in the answer",
        ("camera", "targets in images", "corners", "cells with corners, %", "rms error, px", "a corner's noise, px"),
        tuple(rows),
        "Errors along each axis, seen minus predicted, "
        + (
            "with the carriers' pose of each image as its noise and the corners together say."
            if seen.cameras[0].at_optimum
            else "with the carriers' poses as they were measured."
        ),
    )


def _worst(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    """The images whose corners are farthest off under the answer."""
    if not seen.worst:
        return
    rows: list[tuple[Words, ...]] = []
    for i, one in enumerate(seen.worst):
        times = "" if one.times_noise is None else shown.evident("seen", "worst", i, "times_noise", spec=".1f")
        rows.append(
            (
                f"{i + 1}. {one.image}",
                one.sensor,
                one.target,
                shown.evident("seen", "worst", i, "rms_px", spec=".3f"),
                times,
                shown.evident("seen", "worst", i, "largest_px", spec=".3f"),
                "in the answer" if one.is_used else "left out",
            )
        )
    yield Table(
        "The images whose corners are farthest off",
        ("image", "camera", "target", "rms, px", "times the noise", "largest, px", ""),
        tuple(rows),
    )
    if not shown.images:
        yield Paragraph("Not shown: these images. The page was made without images.", "note")
        return
    if all(one.picture is None for one in seen.worst):
        yield Paragraph(f"Not shown: these images. Why: {seen.no_pictures or 'they cannot be read.'}", "note")
        return
    yield Paragraph(
        "In each image: circles where corners were seen, crosses where the answer has them, and lines from the one "
        "towards the other, magnified as it is said. The largest errors have numbers, 1 for the largest."
    )
    for i, one in enumerate(seen.worst):
        if one.picture is None:
            continue
        noise = "" if one.times_noise is None else f", {one.times_noise:.1f} times the noise"
        left_out = "" if one.is_used else " It was left out of the answer."
        yield Picture(
            f"worst-{i + 1}",
            f"{i + 1}. {one.target} in {one.sensor}",
            f"Image {one.image}: rms {one.rms_px:.3f} px{noise}; lines {one.magnified:g} times as long.{left_out}",
            one.picture,
            is_wide=False,
        )


def _sheet(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    if not shown.images:
        yield Paragraph("Not shown: the contact sheet. The page was made without images.", "note")
    elif seen.sheet is None:
        why = seen.no_pictures or "there is no contact sheet beside the result."
        yield Paragraph(f"Not shown: the contact sheet. Why: {why}", "note")
    else:
        yield Picture(
            "contact-sheet",
            "Some of the images",
            "Images of each camera, with what was found (solid outlines), and what was rejected or not read (dashes, "
            "and in words).",
            seen.sheet,
        )
