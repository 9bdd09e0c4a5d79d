"""Tables of calibrated frames: their poses, and the residuals of their measurements."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from gtsam_rwhec.files.terminal_text import natural_key, printable, shown
from gtsam_rwhec.solver.answers import Residual
from gtsam_rwhec.solver.solution import Solution

RESIDUAL_LEGEND = (
    "rms: root mean square length of the residuals of a frame's n measurements, weighted as in the cost, in mm "
    "and degrees."
)
POSE_LEGEND = "x, y, z: metres. roll, pitch, yaw: degrees, with R = Rz(yaw) Ry(pitch) Rx(roll). " + RESIDUAL_LEGEND

POSE_HEADINGS = ("x m", "y m", "z m", "roll°", "pitch°", "yaw°")
RESIDUAL_HEADINGS = ("rms mm", "rms°", "n")
#: A narrower table has this many columns.
SPLIT = len(POSE_HEADINGS)


@dataclass(frozen=True)
class FrameTable:
    """Frames with numbers under headings. The table prints itself to any width and never cuts a number or a name.

    It prints one table if that fits; otherwise several tables of six columns each, or a paragraph for each frame. A
    ``tight`` one has no empty lines.
    """

    title: str
    kind: str
    headings: tuple[str, ...]
    rows: Mapping[str, tuple[str, ...]]
    tight: bool = False

    def first(self, number: int, marked: Collection[str] = ()) -> FrameTable:
        """The table with this many rows, in their order: those that are ``marked``, then the first of the others."""
        names = sorted(self.rows, key=lambda name: name not in marked)[:number]
        return replace(self, rows={name: cells for name, cells in self.rows.items() if name in names})

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Print the widest layout that fits."""
        yield Text(printable(self.title), style="italic")
        layouts = (
            [slice(0, None)],
            [slice(0, SPLIT), slice(SPLIT, None)],
            [slice(0, SPLIT), slice(SPLIT, 2 * SPLIT), slice(2 * SPLIT, None)],
        )
        for cuts in layouts:
            tables = [self._table(cut) for cut in cuts if self.headings[cut]]
            unlimited = options.update(max_width=10_000)
            if all(console.measure(table, options=unlimited).maximum <= options.max_width for table in tables):
                yield from tables
                return
        for name, cells in self.rows.items():
            numbers = [f"{heading} {cell}" for heading, cell in zip(self.headings, cells, strict=True)]
            yield Text("\n".join(_filled(f"{shown(name)}:", numbers, options.max_width)))
        if not self.tight:
            yield Text()

    def _table(self, columns: slice) -> Table:
        # One space between columns: with short names the table fits 80 columns.
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=not self.tight)
        table.add_column(self.kind, no_wrap=True)
        for heading in self.headings[columns]:
            table.add_column(heading, justify="right", no_wrap=True)
        for name, cells in self.rows.items():
            table.add_row(Text(shown(name)), *map(Text, cells[columns]))
        return table


def _filled(start: str, numbers: Iterable[str], width: int) -> list[str]:
    """Fill lines up to a width; a number stays with its heading."""
    lines = [start]
    for piece in numbers:
        if len(lines[-1]) + 1 + len(piece) + 1 <= width:
            lines[-1] += f" {piece},"
        else:
            lines.append(f"  {piece},")
    lines[-1] = lines[-1].removesuffix(",")
    return lines


def sensor_table(solution: Solution) -> FrameTable:
    """The poses Y = T_sensorcarrier_sensor, a line for each sensor."""
    return _frame_table("Sensors in the frame of their carrier", "sensor", solution.Y, solution)


def target_table(solution: Solution) -> FrameTable:
    """The poses X = T_targetcarrier_target, a line for each target."""
    return _frame_table("Targets in the frame of their carrier", "target", solution.X, solution)


def residual_table(solution: Solution) -> FrameTable:
    """How well each frame's measurements fit the certified answer."""
    rows = {
        name: _residual_cells(solution, name)
        for poses in (solution.Y, solution.X)
        for name in sorted(poses, key=natural_key)
    }
    return FrameTable("Residuals of the certified answer", "frame", RESIDUAL_HEADINGS, rows)


def _frame_table(title: str, kind: str, poses: Mapping[str, gtsam.Pose3], solution: Solution) -> FrameTable:
    scales = solution.scale if isinstance(solution.scale, Mapping) else {}
    own_scales = any(name in scales for name in poses)
    rows = {}
    for name in sorted(poses, key=natural_key):
        scale = (f"{scales[name]:.5f}" if name in scales else "-",) if own_scales else ()
        rows[name] = (*pose_cells(poses[name]), *_residual_cells(solution, name), *scale)
    return FrameTable(title, kind, (*POSE_HEADINGS, *RESIDUAL_HEADINGS, *(("scale",) if own_scales else ())), rows)


def pooled_residual(residuals: Iterable[Residual]) -> Residual:
    """The root mean square over all measurements of several pairs."""
    residuals = tuple(residuals)
    number = sum(residual.number_of_measurements for residual in residuals)
    if number == 0:
        return Residual(0, math.nan, math.nan)

    def pool(rms: Iterable[float]) -> float:
        squares = (r.number_of_measurements * value**2 for r, value in zip(residuals, rms, strict=True))
        return math.sqrt(sum(squares) / number)

    return Residual(number, pool(r.translation_rms_m for r in residuals), pool(r.rotation_rms_rad for r in residuals))


def pose_cells(pose: gtsam.Pose3) -> tuple[str, ...]:
    """x, y, z in metres; roll, pitch, yaw in degrees."""
    translation = (f"{value:z.4f}" for value in pose.translation())
    return *translation, *(f"{value:z.2f}" for value in np.degrees(pose.rotation().rpy()))


def _residual_cells(solution: Solution, name: str) -> tuple[str, ...]:
    residual = pooled_residual(residual for pair, residual in solution.residuals.items() if name in pair)
    if residual.number_of_measurements == 0:
        return "-", "-", "0"
    return (
        f"{1e3 * residual.translation_rms_m:.1f}",
        f"{math.degrees(residual.rotation_rms_rad):.2f}",
        str(residual.number_of_measurements),
    )
