"""Reports of predictions of measurements that a calibration has not seen."""

from __future__ import annotations

import math
from collections.abc import Mapping

from rich.console import Console

from gtsam_rwhec.calibration.cross_validation import CrossValidation, HoldOutError
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.report.report_blocks import Block, Listing, Paragraph, Table, Words
from gtsam_rwhec.report.terminal_report import print_blocks, report_console

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


def print_cross_validation(result: CrossValidation, console: Console | None = None, *, pairs: bool = False) -> None:
    """Print what was held out, and the hold-out errors of all measurements, of each sensor and of each target.

    Parameters
    ----------
    result : CrossValidation
        The result of `gtsam_rwhec.cross_validate`.
    pairs : bool
        Print a line for each pair as well.
    """
    time = "time, by their stamps" if result.ordered_by == "stamps" else "the order in which they were added"
    split = SPLITS[result.by].format(folds=result.number_of_folds, time=time)
    of_pairs = {pair.label: error for pair, error in result.pairs.items()} if pairs else {}
    tables = [
        Table.of(f"Hold-out error by {kind}", kind, HEADINGS, rows)
        for kind, rows in (
            ("sensor", {"all": _hold_out_cells(result.overall), **_hold_out_rows(result.sensors)}),
            ("target", _hold_out_rows(result.targets)),
            ("pair", _hold_out_rows(of_pairs)),
        )
    ]
    blocks: tuple[Block, ...] = (
        Paragraph(f"Hold-out error: {split}", "lead"), *tables, Paragraph(LEGEND, "note"),
        Listing(tuple(result.notes), "care"),
    )  # fmt: skip
    print_blocks(report_console() if console is None else console, blocks)


def _hold_out_rows(errors: Mapping[str, HoldOutError]) -> dict[str, tuple[Words, ...]]:
    return {name: _hold_out_cells(errors[name]) for name in sorted(errors, key=natural_key)}


def _hold_out_cells(error: HoldOutError) -> tuple[Words, ...]:
    held, seen = error.held_out, error.training
    total = held.count + error.not_predicted
    return (
        *(_number(value, 1) for value in (held.translation_rms_mm, held.translation_median_mm, held.translation_95_mm)),
        *(_number(value, 2) for value in (held.rotation_rms_deg, held.rotation_median_deg, held.rotation_95_deg)),
        _number(seen.translation_rms_mm, 1),
        _number(seen.rotation_rms_deg, 2),
        str(held.count) if error.not_predicted == 0 else f"{held.count} of {total}",
    )


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
