"""What was chosen and why, the noise that the answer counts with, and what became of a log's measurements."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

import numpy as np

from gtsam_rwhec.report.report_blocks import Block, Listing, Paragraph, Section, Table, Words, worded
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.log_history import LogFields, TrackCount

TITLE = "What was chosen, and why"
NOISE_LEGEND = (
    "Noise of B along and about each axis, of the median measurement, before any fit. Residuals are weighted: far and "
    "oblique measurements are noisier and count less, so the residuals' root mean square can be far smaller."
)
LOG_LEGEND = (
    "seen: detections in the images. usable: detections that were not rejected. cleaned: measurements after the "
    "cleaning. used: measurements in the answer."
)
#: Unit of the compared value at the end of a reason: counts have no unit.
_UNIT = re.compile(r" \((?:s|rad|m|rad/s|m/s|m moved|share that agrees)\)$")


def choices_section(shown: ShownResult) -> Section:
    """Choices with their evidence, noise, and the cost of the refinement."""
    result = shown.result
    made = None if result is None else result.calibration
    if made is None and (result is None or result.refined is None):
        return Section("choices", TITLE, missing="nothing was chosen: this is a solution as the problem states it.")
    blocks: list[Block] = []
    if made is not None:
        blocks.append(Listing(tuple(map(str, made.choices))))
        if made.notes:
            blocks.append(Listing(made.notes, "care"))
        if made.cannot_tell:
            facts = "; ".join(words.removeprefix("data cannot tell: ") for words in made.cannot_tell)
            blocks.append(Paragraph(f"Not checked, as no residual shows it: {facts}.", "note"))
        blocks += [Paragraph(words) for words in (made.outliers, made.noise) if words]
    return Section("choices", TITLE, (*blocks, *_refinement(shown)))


def _refinement(shown: ShownResult) -> Iterator[Block]:
    """The noise of each pair, outliers where no choice says them, and what the refinement cost."""
    refined = None if shown.result is None else shown.result.refined
    if refined is None:
        return
    at = ("refined", "noise")
    rows: tuple[tuple[Words, ...], ...] = tuple(
        (
            f"{row['target']}, {row['sensor']}",
            shown.number(*at, i, "rotation_rad", times=float(np.degrees(1.0)), spec=".3g"),
            shown.number(*at, i, "translation_m", times=1e3, spec=".3g"),
            *(shown.number(*at, i, "degrees_of_freedom", k, spec=".0f") for k in range(2)),
        )
        for i, row in enumerate(shown.tree["refined"]["noise"])
    )
    source = "estimated from the residuals" if refined.noise_source == "estimated" else "as given"
    headings = ("pair", "±°", "±mm", "d.o.f. (°)", "d.o.f. (mm)")
    yield Table(f"Noise of B, {source}", headings, rows, f"{NOISE_LEGEND} d.o.f.: degrees of freedom; free: exact.")
    if shown.result is not None and shown.result.calibration is None and refined.inlier_counts:
        counts = {pair: (number - kept, number) for pair, (kept, number) in refined.inlier_counts.items()}
        total = sum(number for _, number in counts.values())
        out = [f"{pair} {left} of {number}" for pair, (left, number) in counts.items() if left]
        left_out = sum(left for left, _ in counts.values())
        said = f"{left_out} of {total} measurements left out: {', '.join(out)}" if out else f"none of {total}"
        yield Paragraph(f"Outliers: {said}.")
    moved = max(refined.moved.items(), key=lambda item: item[1].translation_mm)
    start = "" if refined.reprojection is not None else "from {initial_cost} "
    words = (
        f"Cost of the refinement: {start}to {{cost}} after {{iterations}} steps "
        f"({shown.tree['refined']['residual']} residual, robust loss: {shown.tree['refined']['robust']}). Do not "
        "compare it with the certified cost, which has other weights. It moved the poses by up to "
        f"{moved[1].translation_mm:.2f} mm ({{frame}})."
    )
    specs = {"initial_cost": ".6g", "cost": ".6g", "iterations": ".0f"}
    numbers = {field: shown.number("refined", field, spec=spec) for field, spec in specs.items()}
    yield Paragraph(worded(words, frame=moved[0], **numbers))


def log_blocks(log: LogFields) -> Iterator[Block]:
    """Numbers of images, what every stage used of each pair, why others were removed, and sizes that were found."""
    images = ", ".join(f"{count} of {sensor}" for sensor, count in log.detection.images.items())
    yield Paragraph(f"Images or clouds in {', '.join(log.detection.sources)}: {images}.")
    cleaned = {track.pair: track.used for track in log.cleaning.tracks}
    used = {count.pair: count.used for count in log.outliers}
    rows: dict[str, tuple[Words, ...]] = {
        str(track.pair): tuple(map(str, (track.seen, track.used, cleaned.get(track.pair, 0), used.get(track.pair, 0))))
        for track in log.detection.tracks
    }
    yield Table.of("Measurements by stage", "pair", ("seen", "usable", "cleaned", "used"), rows, LOG_LEGEND)
    rejected = {why for track in log.detection.tracks for why in track.removed}  # the cleaning counts these again
    for stage, reasons in (
        ("Rejected in detection", _by_reason(log.detection.tracks, set())),
        ("Removed in cleaning", _by_reason(log.cleaning.tracks, rejected)),
    ):
        if reasons:
            yield Paragraph(f"{stage}: {'; '.join(reasons)}.")
    for size in log.sizes:
        if size.is_free and size.sigma is not None:
            found_mm, sigma_mm = (1e3 * size.stated_m * x for x in (1.0 / size.scale, size.sigma / size.scale**2))
            yield Paragraph(
                f"Size of {size.target}: stated {1e3 * size.stated_m:.3f} mm, found {found_mm:.3f} ± {sigma_mm:.3f} mm."
            )


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
