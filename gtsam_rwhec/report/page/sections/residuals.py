"""Section 6: what is left after the fit, by pair, time, place and configuration, and against the noise model."""

from __future__ import annotations

from collections.abc import Iterator

from gtsam_rwhec.report.page.blocks import Block, Chart, Folded, Paragraph, Section, Table, Words, significant
from gtsam_rwhec.report.page.residual_charts import (
    boxes_figure,
    dependence_figure,
    image_figure,
    normal_figure,
    time_figure,
)
from gtsam_rwhec.report.page.shown_result import ShownResult
from gtsam_rwhec.results.image_errors import SeenCamera
from gtsam_rwhec.results.residual_evidence import BEYOND_3_BY_CHANCE, FEWEST, ResidualsEvidence

TITLE = "Residuals"
#: Residuals are called as large as the noise within these.
AS_LARGE = (0.9, 1.1)
#: A table has so many pairs; the others are in the evidence.
MOST_PAIRS = 100
#: So many cameras have their arrows drawn.
MOST_CAMERAS = 8


def residuals_section(shown: ShownResult) -> Section:
    """Residuals, the noise model, correlation, hold-out."""
    found = None if shown.evidence is None else shown.evidence.residuals
    if found is None:
        why = shown.why_missing(found, "the calibration has no covariances, and so no noise to compare with.")
        return Section("residuals", TITLE, missing=why)
    blocks: list[Block] = [
        Paragraph(
            "A residual is how far a measurement B is from what the answer predicts, Y⁻¹ A X. Its size says how noisy "
            "single measurements are; a pattern in it says what the model lacks."
        ),
        *_by_sensor(shown, found),
        Chart(
            "residuals-by-pair",
            "By pair",
            "Angles and lengths of residuals. Box: the middle half; line in it: the median.",
            boxes_figure(found),
        ),
        Chart(
            "residuals-by-time",
            "Over time" if found.has_stamps else "In the order given",
            "Angles and lengths of residuals. A slope or waves mean drift, or a clock that is wrong.",
            time_figure(found),
        ),
    ]
    cameras = _cameras_with_corners(shown)
    if cameras:
        blocks.append(
            Chart(
                "residuals-in-the-image",
                "Over the image",
                "Mean error of the corners in each part of the image, drawn larger. Arrows in order mean that the "
                "lens model, or the board, is not quite right; arrows in disorder are noise.",
                image_figure(cameras[:MOST_CAMERAS]),
            )
        )
    else:
        blocks.append(Paragraph("Not shown: errors over the image, for there are no corners.", "note"))
    blocks += [*_by_configuration(shown, found), *_against_noise(shown, found), *_neighbours(shown, found)]
    return Section("residuals", TITLE, (*blocks, _pairs(shown, found)))


def _cameras_with_corners(shown: ShownResult) -> tuple[SeenCamera, ...]:
    seen = None if shown.evidence is None else shown.evidence.seen
    return () if seen is None else tuple(camera for camera in seen.cameras if camera.x)


def _by_sensor(shown: ShownResult, found: ResidualsEvidence) -> Iterator[Block]:
    """Hold-out errors: how well measurements are predicted that the calibration has not seen."""
    at = ("residuals", "hold_out")
    rows: list[tuple[Words, ...]] = []
    fields = ("held_out_mm", "fitted_mm", "held_out_deg", "fitted_deg")
    for i, one in enumerate(found.hold_out):
        cells = (significant(shown.evident(*at, i, field), 3) for field in fields)
        rows.append((one.sensor, shown.evident(*at, i, "measurements", spec=".0f"), *cells))
    if rows:
        yield Table(
            "Measurements that were left out, and how well the others predict them",
            ("sensor", "predicted", "mm, left out", "mm, fitted", "°, left out", "°, fitted"),
            tuple(rows),
            "Root mean square length and angle, by blocks in time, at the level of poses (one linear step from the "
            "answer). Much larger left out than fitted: too few measurements, or errors that vary slowly.",
        )
    else:
        yield Paragraph("Not shown: hold-out errors, for no block of measurements is predicted by the others.", "note")
    yield from _pixels(shown)


def _pixels(shown: ShownResult) -> Iterator[Block]:
    """The same of corners, in pixels, where the refinement was from corners."""
    reprojection = (shown.tree.get("refined") or {}).get("reprojection")
    rows = []
    for name, sensor in ({} if reprojection is None else reprojection["sensors"]).items():
        keys = [key for key in ("rms_px", "held_out_px", "expected_px", "held_out_mm") if sensor.get(key) is not None]
        if len(keys) == 4:
            rows.append(
                (name, *(significant(shown.number("refined", "reprojection", "sensors", name, k), 3) for k in keys))
            )
    if rows:
        yield Table(
            "Corners of images that were left out",
            ("sensor", "px, fitted", "px, left out", "px, expected", "mm, left out"),
            tuple(rows),
            "Root mean squares, fitted ones along each axis, others lengths. Expected: if the model is right.",
        )


def _by_configuration(shown: ShownResult, found: ResidualsEvidence) -> Iterator[Block]:
    one = found.dependence
    if one is None:
        yield Paragraph(
            f"Not shown: residuals over the carriers' pose, for no sensor has {FEWEST} measurements.", "note"
        )
        return
    at = ("residuals", "dependence")
    verdict = (
        "This is more than chance: an arm's kinematics, a clock, a lens or a board that bends can do it."
        if abs(one.correlation) > one.by_chance
        else "That much is chance."
    )
    yield Paragraph(
        (
            f"The strongest dependence on the carriers' pose: {one.component} of {one.sensor}, with {one.by}: "
            "correlation ",
            shown.evident(*at, "correlation", spec=".2f"),
            ", where chance alone stays below ",
            shown.evident(*at, "by_chance", spec=".2f"),
            f". {verdict}",
        )
    )
    yield Chart(
        "residuals-by-configuration",
        "Over the carriers' pose",
        f"{one.component[0].upper()}{one.component[1:]}, {one.sensor}, in units of its noise, over {one.by}, from the "
        "mean. The line is the mean of a tenth.",
        dependence_figure(one),
    )


def _against_noise(shown: ShownResult, found: ResidualsEvidence) -> Iterator[Block]:
    low, high = AS_LARGE
    size = (
        "as large as the noise that was found"
        if low <= found.spread <= high
        else "smaller than the noise that was found"
        if found.spread < low
        else "larger than the noise that was found"
    )
    yield Paragraph(
        (
            f"Residuals are {size}: their root mean square is ",
            shown.evident("residuals", "spread", spec=".2f"),
            " of it. Beyond three deviations are ",
            shown.evident("residuals", "beyond_3", times=100.0, spec=".2f"),
            f" % ({100.0 * BEYOND_3_BY_CHANCE:.2f} % of normal noise); excess kurtosis ",
            shown.evident("residuals", "excess_kurtosis", spec=".1f"),
            " (0 for normal noise; heavy tails are positive).",
        )
    )
    yield Chart(
        "residuals-against-noise",
        "Against the noise model",
        "All residuals divided by their noise, beside normal noise.",
        normal_figure(found),
    )


def _neighbours(shown: ShownResult, found: ResidualsEvidence) -> Iterator[Block]:
    beyond = sum(
        1
        for pair in found.pairs
        if pair.neighbours is not None and pair.band is not None and abs(pair.neighbours) > pair.band
    )
    judged = sum(1 for pair in found.pairs if pair.neighbours is not None)
    words: list[str] = []
    if judged:
        words.append(
            f"In {beyond} of {judged} pairs residuals follow or oppose those before more than chance allows in 95 %: "
            f"of {judged} pairs about {0.05 * judged:.1f} are so by chance."
        )
    if found.instants is None or found.worth is None:
        yield Paragraph((*words, " No model of all noise was made, so what the data are worth is not known."), "plain")
        return
    yield Paragraph(
        (
            *words,
            " With the correlation that was found, ",
            shown.evident("residuals", "instants", spec=".0f"),
            " poses of the carriers are worth ",
            shown.evident("residuals", "worth", spec=".0f"),
            " independent ones.",
        )
    )


def _pairs(shown: ShownResult, found: ResidualsEvidence) -> Block:
    """The numbers of each pair, folded."""
    rows = []
    for i, pair in enumerate(found.pairs[:MOST_PAIRS]):
        at = ("residuals", "pairs", i)
        neighbours: Words = "-" if pair.neighbours is None else shown.evident(*at, "neighbours", spec=".2f")
        band: Words = "-" if pair.band is None else shown.evident(*at, "band", spec=".2f")
        sizes = (significant(shown.evident(*at, field), 3) for field in ("rms_mm", "rms_deg", "spread"))
        rows.append((f"{pair.target}, {pair.sensor}", shown.evident(*at, "used", spec=".0f"), *sizes, neighbours, band))
    more = len(found.pairs) - len(rows)
    return Folded(
        f"Residuals of {len(found.pairs)} pairs",
        (
            Table(
                "Residuals by pair",
                ("pair", "n", "rms mm", "rms°", "of noise", "neighbours", "by chance"),
                tuple(rows),
                "of noise: root mean square in units of it. neighbours: correlation with the measurement before; "
                "by chance it stays within the last column in 95 %."
                + (f" {more} more pairs are in evidence.json." if more else ""),
            ),
        ),
    )
