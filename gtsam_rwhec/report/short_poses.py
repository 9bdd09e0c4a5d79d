"""The tables of poses of the short report: with all standard deviations, or with the largest ones alone."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace

import gtsam

from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.report.covariance_report import DEVIATION_HEADINGS, deviation_cells, label, scale_and_offset_sentences
from gtsam_rwhec.report.pose_table import POSE_HEADINGS, FrameTable, pose_cells
from gtsam_rwhec.report.short_report import PoseTables
from gtsam_rwhec.results.log_history import LogFields

ANGLES = "R = Rz(yaw) Ry(pitch) Rx(roll)"
ALL_DEVIATIONS = f"{ANGLES}. ±: one standard deviation along and about the frame's own axes"
LARGEST = f"{ANGLES}. ±: the largest standard deviation along and about the frame's axes"
FREE = "; free: not determined"


def refined_poses(refined: Refined, wrong: Collection[str], log: LogFields | None) -> tuple[PoseTables, PoseTables]:
    """Refined poses with their standard deviations along and about all axes, and with the largest ones alone."""
    carriers = ("of their carrier", "of their carrier") if log is None else (log.sensor_carrier, log.target_carrier)
    sides = (
        (f"Sensors in the frame {carriers[0]}", "sensor", refined.Y),
        (f"Targets in the frame {carriers[1]}", "target", refined.X),
    )
    whole = tuple(_table(title, kind, poses, refined, wrong) for title, kind, poses in sides)
    free = FREE if any("free" in cells for table in whole for cells in table.rows.values()) else ""
    largest = tuple(_with_largest(table) for table in whole)
    return PoseTables(whole, f"{ALL_DEVIATIONS}{free}."), PoseTables(largest, f"{LARGEST}{free}.")


def scales_and_clocks(refined: Refined) -> list[str]:
    """The scales and time offsets in a sentence each, without the explanation that the whole report has."""
    return [sentence.split(" (a stamp of ")[0].rstrip(".") + "." for sentence in scale_and_offset_sentences(refined)]


def _table(
    title: str, kind: str, poses: Mapping[str, gtsam.Pose3], refined: Refined, wrong: Collection[str]
) -> FrameTable:
    rows = {}
    for name in sorted(poses, key=natural_key):
        known = deviation_cells(refined.covariance(name)) if name in refined.names else ("fixed",) * 6
        rows[label(name, wrong)] = (*pose_cells(poses[name]), *known)
    return FrameTable(title, kind, (*POSE_HEADINGS, *DEVIATION_HEADINGS), rows, tight=True)


def _with_largest(table: FrameTable) -> FrameTable:
    """The table with one column for the standard deviations of the translation, and one for those of the rotation."""
    rows = {name: (*cells[:6], _largest(cells[6:9]), _largest(cells[9:])) for name, cells in table.rows.items()}
    return replace(table, headings=(*POSE_HEADINGS, "± mm", "±°"), rows=rows)


def _largest(cells: tuple[str, ...]) -> str:
    """The largest of some cells, of which one that is not a number stands for all."""
    return max(cells, key=lambda cell: float(cell) if cell[0].isdigit() else math.inf)
