"""Methods side by side: a line for each that applies, and the reason for each that does not."""

from __future__ import annotations

import math

from rich.console import Console
from rich.text import Text

from gtsam_rwhec.methods.comparison import Compared, Comparison
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.sentences import certificate_sentence, identifiability_sentences
from gtsam_rwhec.report.solution_report import report_console

HEADINGS = ("cost J", "gap", "gap %", "rms mm", "rms°", "ms")
LEGEND = (
    "cost J: of the certified objective, whatever the method itself minimised. gap: by how much it costs more than any "
    "answer must, by the certificate's bound; 0 where that proves it optimal. rms: residuals over all measurements. "
    "ms: the method's own time."
)


def comparison_table(comparison: Comparison) -> FrameTable:
    """A line for each method with an answer, cheapest first."""
    rows = {row.method.name: _cells(comparison, row) for row in comparison.rows if row.estimate is not None}
    return FrameTable("Methods by the cost of their answers", "method", HEADINGS, rows)


def print_comparison(comparison: Comparison, console: Console | None = None) -> None:
    """Print the table, what each answer rests on, and the methods without an answer.

    Parameters
    ----------
    comparison : Comparison
    console : rich.console.Console, optional
        Standard output if left out.
    """
    console = report_console() if console is None else console
    wrap = not console.is_terminal
    table = comparison_table(comparison)
    if table.rows:
        console.print(table)
        console.print(Text(LEGEND, style="dim"), soft_wrap=wrap)
        console.print()
    for sentence in _remarks(comparison):
        console.print(Text(sentence), soft_wrap=wrap)
    without = [row for row in comparison.rows if row.estimate is None]
    if without:
        console.print(Text("No answer:", style="bold"))
        for row in without:
            console.print(Text(f"  - {row.method.name}: {row.error}"), soft_wrap=wrap)
        console.print()
    if comparison.certificate is None:
        console.print(Text(f"No bound on the cost: {comparison.error}", style="bold red"), soft_wrap=wrap)
        return
    style = "bold green" if comparison.certificate.is_certified else "bold red"
    sentence = certificate_sentence(comparison.certificate).replace("this answer", "the certified answer", 1)
    console.print(Text(sentence, style=style), soft_wrap=wrap)
    if comparison.solution is not None:
        for words in identifiability_sentences(comparison.solution):
            console.print(Text(words, style="bold red"), soft_wrap=wrap)


def _remarks(comparison: Comparison) -> list[str]:
    """Where the iterations started, and what methods say of their answers."""
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
