"""The report of a comparison: a line for each method with an answer, and the reason for each method without one."""

from __future__ import annotations

import math

from rich.console import Console

from gtsam_rwhec.methods.comparison import Compared, Comparison
from gtsam_rwhec.report.advice import print_advice
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.printing import print_heading, print_list, print_sentence, print_tables, report_console
from gtsam_rwhec.report.sentences import certificate_sentence

HEADINGS = ("cost J", "gap", "gap %", "rms mm", "rms°", "ms")
LEGEND = (
    "cost J: cost of the answer by the certified objective, whatever the method itself minimises. gap: this cost minus "
    "the certificate's lower bound; 0: proven optimal. rms: root mean square residual over all measurements. ms: time "
    "of the method."
)


def comparison_table(comparison: Comparison) -> FrameTable:
    """A line for each method with an answer, cheapest first."""
    rows = {row.method.name: _cells(comparison, row) for row in comparison.rows if row.estimate is not None}
    return FrameTable("Methods by the cost of their answers", "method", HEADINGS, rows)


def print_comparison(comparison: Comparison, console: Console | None = None) -> None:
    """Print what is proven, the table, the notes on each answer, and the methods without an answer.

    Parameters
    ----------
    comparison : Comparison
        The result of `gtsam_rwhec.methods.compare`.
    console : rich.console.Console, optional
        Where to print; standard output by default.
    """
    console = report_console() if console is None else console
    if comparison.certificate is None:
        print_sentence(console, f"No lower bound of the cost: {comparison.error}", "bold red")
    else:
        style = "bold green" if comparison.certificate.is_certified else "bold red"
        print_sentence(console, certificate_sentence(comparison.certificate, "the certified answer"), style)
    if comparison.solution is not None:
        print_advice(console, comparison.solution.identifiability.free_directions)
    console.print()
    table = comparison_table(comparison)
    if table.rows:
        print_tables(console, [table], LEGEND)
    for sentence in _remarks(comparison):
        print_sentence(console, sentence)
    reasons: dict[str, list[str]] = {}
    for row in comparison.rows:
        if row.estimate is None:
            reasons.setdefault(str(row.error), []).append(row.method.name)
    if reasons:
        print_heading(console, "Methods without an answer")
        print_list(console, (f"{', '.join(names)}: {reason}" for reason, names in reasons.items()))


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
