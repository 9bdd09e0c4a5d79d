"""Section 1: whether to use the poses, how far off a point is, and what to do."""

from __future__ import annotations

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.report.page.blocks import Block, Paragraph, Section, Table, Tone
from gtsam_rwhec.report.page.shown_result import ShownResult

#: A sign beside the words: they can be told apart without colours.
SIGNS = {Verdict.USE: "✓", Verdict.CARE: "!", Verdict.DO_NOT_USE: "✕"}
TONES: dict[Verdict, Tone] = {Verdict.USE: "good", Verdict.CARE: "care", Verdict.DO_NOT_USE: "bad"}


def verdict_section(shown: ShownResult) -> Section:
    """The verdict and what to do; then how far off a point is where each sensor saw its targets."""
    verdict = Verdict(shown.tree["verdict"])
    sentence = f"{SIGNS[verdict]} {verdict.words}: {shown.tree['verdict_reason']}"
    blocks: list[Block] = [Paragraph(sentence, TONES[verdict])]
    points = shown.tree.get("calibration", {}).get("points", [])
    if points:
        rows = tuple(
            (
                point["frame"],
                point["seen_from"],
                shown.number("calibration", "points", i, "radius_mm", spec=".2f"),
            )
            for i, point in enumerate(points)
        )
        blocks.append(
            Table("How far off a point is where the targets were seen", ("sensor", "expressed in", "95 %, mm"), rows)
        )
    return Section("verdict", "Verdict", tuple(blocks))
