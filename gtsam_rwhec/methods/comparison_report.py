"""Reports of methods against each other."""

from __future__ import annotations

import math
from collections.abc import Iterator

from rich.console import Console

from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.methods.comparison import Compared, Comparison
from gtsam_rwhec.report.advice import advice_of, certificate_sentence
from gtsam_rwhec.report.report_blocks import Block, Listing, Paragraph, Table, Words
from gtsam_rwhec.report.terminal_report import print_blocks, report_console

HEADINGS = ("cost J", "gap", "gap %", "rms mm", "rms°", "ms")
LEGEND = (
    "cost J: cost of the answer by the certified objective, whatever the method itself minimises. gap: this cost minus "
    "the certificate's lower bound; 0: proven optimal. rms: root mean square residual over all measurements. ms: time "
    "of the method."
)
#: What the table of chained methods has.
CHAINED_LEGEND = (
    "Each pair of the tree with the most measurements is solved alone, and each frame takes its pose from the pair by "
    "which the tree reaches it, as people do by hand. times joint: cost over that of the joint answer. off: the "
    "largest difference of a frame's pose from the joint answer. pairs: those of the tree."
)
#: Pairs and frames are named up to this number.
MOST_NAMED = 10


def print_comparison(comparison: Comparison, console: Console | None = None) -> None:
    """Print what is proven, the table, the notes on each answer, and the methods without an answer.

    Parameters
    ----------
    comparison : Comparison
        The result of `gtsam_rwhec.methods.compare`.
    """
    print_blocks(report_console() if console is None else console, comparison_blocks(comparison))


def comparison_blocks(comparison: Comparison) -> Iterator[Block]:
    """All that a comparison says."""
    certificate = comparison.certificate
    if certificate is None:
        yield Paragraph(f"No lower bound of the cost: {comparison.error}", "bad")
    else:
        tone = "good" if certificate.is_certified else "bad"
        yield Paragraph(certificate_sentence(certificate, "the certified answer"), tone)  # type: ignore[arg-type]
    if comparison.solution is not None:
        said = advice_of(comparison.solution.identifiability.free_directions)
        if said:
            yield Listing(tuple(words for words, _ in said), "bad")
    rows: dict[str, tuple[Words, ...]] = {
        row.method.name: _cells(comparison, row) for row in comparison.rows if row.estimate is not None
    }
    yield Table.of("Methods by the cost of their answers", "method", HEADINGS, rows, LEGEND)
    yield from map(Paragraph, _remarks(comparison))
    yield from _chained(comparison)
    reasons: dict[str, list[str]] = {}
    for row in comparison.rows:
        if row.estimate is None:
            reasons.setdefault(str(row.error), []).append(row.method.name)
    if reasons:
        chained = any(row.tree for row in comparison.chained)  # these have an answer, in the table above
        heading = "Why methods do not apply to all pairs at once" if chained else "Methods without an answer"
        yield Paragraph(heading, "lead")
        yield Listing(tuple(f"{', '.join(names)}: {reason}" for reason, names in reasons.items()))


def _chained(comparison: Comparison) -> Iterator[Block]:
    """The table of chained methods, which pairs the trees avoid and why, and frames that they do not reach."""
    if not comparison.chained:
        return
    joint = None if comparison.certificate is None else comparison.certificate.cost
    rows: dict[str, tuple[Words, ...]] = {}
    for row in comparison.chained:
        cost = None if row.estimate is None else row.estimate.cost
        times = "-" if cost is None or not joint else f"{cost / joint:.3g}"
        off = (f"{row.off_mm:.2f}", f"{row.off_deg:.3f}") if row.tree else ("-", "-")
        rows[row.method] = ("-" if cost is None else f"{cost:.7g}", times, *off, str(len(row.tree)))
    headings = ("cost J", "times joint", "off mm", "off°", "pairs")
    title = "Methods for few frames, pair by pair, chained along the best tree"
    yield Table.of(title, "method", headings, rows, CHAINED_LEGEND)
    said: dict[str, list[str]] = {}
    if comparison.undetermined:
        few = some(list(map(str, comparison.undetermined)), MOST_NAMED)
        said[f"No tree takes {few}: their own measurements do not determine their frames."] = []
    for row in comparison.chained:
        reasons: dict[str, list[str]] = {}
        for pair, why in row.failed.items():
            reasons.setdefault(why, []).append(str(pair))
        for why, pairs in reasons.items():
            said.setdefault(f"the tree avoids {some(pairs, MOST_NAMED)}: {why}", []).append(row.method)
        if row.unreached:
            said.setdefault(f"no pair that can be used has {some(row.unreached, MOST_NAMED)}.", []).append(row.method)
    yield from (Paragraph(f"{', '.join(names)}: {words}" if names else words) for words, names in said.items())


def _remarks(comparison: Comparison) -> list[str]:
    """Where the iterations started, and what the methods note about their answers."""
    starts: dict[str, list[str]] = {}
    notes = []
    for row in comparison.rows:
        if row.estimate is None:
            continue
        if row.estimate.starts_from is not None:
            starts.setdefault(row.estimate.starts_from, []).append(row.method.name)
        notes += [f"{row.method.name}: {note}." for note in row.estimate.notes]
    return [f"Started from {start}: {', '.join(names)}." for start, names in starts.items()] + notes


def _cells(comparison: Comparison, row: Compared) -> tuple[str, ...]:
    assert row.estimate is not None
    gap = comparison.gap(row)
    if gap is None:
        gap_cells = ("-", "-")
    elif comparison.is_optimal(row):
        gap_cells = ("0", "0")
    else:
        bound = row.estimate.cost - gap
        gap_cells = (f"{gap:.4g}", f"{100.0 * gap / bound:.3g}" if bound > 0.0 else "-")
    return (
        f"{row.estimate.cost:.7g}",
        *gap_cells,
        f"{1e3 * row.translation_rms_m:.2f}",
        f"{math.degrees(row.rotation_rms_rad):.3f}",
        f"{1e3 * row.estimate.seconds:.1f}",
    )
