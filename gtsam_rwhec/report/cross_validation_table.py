"""Hold-out errors as tables: of all measurements, of each sensor and target, and of each pair on request."""

from __future__ import annotations

import math
from collections.abc import Mapping

from rich.console import Console

from gtsam_rwhec.calibration.cross_validation import CrossValidation, HoldOutError
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.printing import print_list, print_sentence, print_tables, report_console

HEADINGS = ("rms mm", "median", "95%", "rms°", "median", "95%", "seen mm", "seen°", "n")
LEGEND = (
    "Difference between the measured pose of a target and the pose that a calibration without this measurement "
    "predicts, in true millimetres and degrees. rms: root mean square. 95%: 95th percentile. seen: rms of the same "
    "measurements when the calibration uses all of them. n: predicted measurements."
)
SPLITS = {
    "time": "{folds} blocks, contiguous in {time}, each predicted from the others",
    "pair": "each pair predicted from all other pairs",
    "sensor": "each half in {time} of a sensor's measurements predicted from all others",
}


def cross_validation_tables(result: CrossValidation, *, pairs: bool = False) -> list[FrameTable]:
    """A table of all measurements and the sensors, one of the targets, and with ``pairs`` one of the pairs."""
    tables = [
        FrameTable(
            "Hold-out error by sensor", "sensor", HEADINGS, {"all": _cells(result.overall), **_rows(result.sensors)}
        )
    ]
    if result.targets:
        tables.append(FrameTable("Hold-out error by target", "target", HEADINGS, _rows(result.targets)))
    if pairs:
        by_name = {pair.label: comparison for pair, comparison in result.pairs.items()}
        tables.append(FrameTable("Hold-out error by pair", "pair", HEADINGS, _rows(by_name)))
    return tables


def print_cross_validation(result: CrossValidation, console: Console | None = None, *, pairs: bool = False) -> None:
    """Print what was held out, and the tables.

    Parameters
    ----------
    result : CrossValidation
        The result of `gtsam_rwhec.cross_validate`.
    console : rich.console.Console, optional
        Where to print; standard output by default.
    pairs : bool
        Print a line for each pair as well.
    """
    console = report_console() if console is None else console
    print_sentence(console, f"Hold-out error: {split_sentence(result)}", "bold")
    console.print()
    print_tables(console, cross_validation_tables(result, pairs=pairs), LEGEND)
    print_list(console, result.notes, "yellow")


def split_sentence(result: CrossValidation) -> str:
    """What was held out."""
    time = "time, by their stamps" if result.ordered_by == "stamps" else "the order in which they were added"
    return SPLITS[result.by].format(folds=result.number_of_folds, time=time)


def _rows(comparisons: Mapping[str, HoldOutError]) -> dict[str, tuple[str, ...]]:
    return {name: _cells(comparisons[name]) for name in sorted(comparisons, key=natural_key)}


def _cells(comparison: HoldOutError) -> tuple[str, ...]:
    held, seen = comparison.held_out, comparison.training
    total = held.count + comparison.not_predicted
    return (
        *(_number(value, 1) for value in (held.translation_rms_mm, held.translation_median_mm, held.translation_95_mm)),
        *(_number(value, 2) for value in (held.rotation_rms_deg, held.rotation_median_deg, held.rotation_95_deg)),
        _number(seen.translation_rms_mm, 1),
        _number(seen.rotation_rms_deg, 2),
        str(held.count) if comparison.not_predicted == 0 else f"{held.count} of {total}",
    )


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
