"""The poses as tables: metres, degrees and standard deviations, as the terminal has them."""

from __future__ import annotations

from collections.abc import Iterator

from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.report.covariance_report import DEVIATION_HEADINGS, MARK
from gtsam_rwhec.report.page.blocks import Block, Paragraph, Table, Words
from gtsam_rwhec.report.page.shown_result import ShownResult

TRANSLATION = ("x m", "y m", "z m")
ANGLES = ("roll°", "pitch°", "yaw°")
QUATERNION = ("qw", "qx", "qy", "qz")
LEGEND = (
    "±: one standard deviation, along and about the axes of the frame itself; free: infinite, because the measurements "
    "leave a direction free."
)
LEGEND_ANGLES = "Roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll). "
SCALARS = {"scale": "scale", "time_offset": "clock offset"}
SCALARS_LEGEND = (
    "Scale: measured length / true length. Clock offset: a stamp of the sensor + this = the carriers' time. ±: one "
    "standard deviation."
)
FIXED = "fixed"


def pose_blocks(shown: ShownResult) -> Iterator[Block]:
    """A table of the sensors' poses, and one of the targets'; a word on those that are not to be used."""
    tree = shown.tree
    sides = (("Sensors", "sensor", "sensors"), ("Targets", "target", "targets"))
    if not any(tree.get(side) for *_, side in sides):
        yield Paragraph("There are no poses: the calibration has no answer.")
        return
    wrong = [row["child"] for *_, side in sides for row in tree[side] if row.get("contradicted")]
    for title, kind, side in sides:
        if tree[side]:
            yield _table(shown, f"{title} in the frame {tree[side][0]['parent']}", kind, side)
    yield from _scalars(shown)
    if wrong:
        names = ", ".join(sorted(wrong, key=natural_key))
        yield Paragraph(f"{MARK}: do not use this pose, because its own measurements contradict it: {names}.", "bad")


def _scalars(shown: ShownResult) -> Iterator[Block]:
    """Scales and clock offsets that were estimated; without evidence, without their deviations."""
    known = (shown.evidence_tree.get("derived") or {}).get("scalars", ())
    rows: list[tuple[Words, ...]] = []
    for i, scalar in enumerate(known):
        times, spec, unit = (1.0, ".6f", "") if scalar["kind"] == "scale" else (1e3, "+.3f", "ms")
        deviation_spec = spec.removeprefix("+")
        rows.append(
            (
                SCALARS[scalar["kind"]] + (f" of {scalar['owner']}" if scalar["owner"] else ""),
                shown.evident("derived", "scalars", i, "value", times=times, spec=spec),
                shown.evident("derived", "scalars", i, "deviation", times=times, spec=deviation_spec),
                unit,
            )
        )
    if not known and shown.tree.get("scale_mode") != "known":
        scale = shown.tree.get("scale")
        names = list(scale) if isinstance(scale, dict) else []
        rows += [(f"scale of {name}", shown.number("scale", name, spec=".6f"), "-", "") for name in names]
        if isinstance(scale, float):
            rows.append(("scale", shown.number("scale", spec=".6f"), "-", ""))
    if rows:
        yield Table("Scales and clocks", ("of", "value", "±", "unit"), tuple(rows), SCALARS_LEGEND)


def _table(shown: ShownResult, title: str, kind: str, side: str) -> Table:
    rows = shown.tree[side]
    order = sorted(range(len(rows)), key=lambda i: natural_key(rows[i]["child"]))
    angles = angles_of(shown)
    has_angles = all(row["child"] in angles for row in rows)
    frames = (shown.tree.get("refined") or {}).get("frames", {})
    deviations = DEVIATION_HEADINGS if frames else ()
    cells = []
    for i in order:
        name = rows[i]["child"]
        row: list[Words] = [f"{name} {MARK}" if rows[i].get("contradicted") else name]
        row += [shown.number(side, i, "translation_m", k, spec="z.4f") for k in range(3)]
        if has_angles:
            row += [shown.evident("derived", "angles", angles[name], "rpy_deg", k, spec="z.2f") for k in range(3)]
        else:
            row += [shown.number(side, i, "quaternion_wxyz", k, spec="z.5f") for k in range(4)]
        if frames:
            row += deviation_cells(shown, name)
        cells.append(tuple(row))
    headings = (kind, *TRANSLATION, *(ANGLES if has_angles else QUATERNION), *deviations)
    legend = (LEGEND_ANGLES if has_angles else "") + (LEGEND if frames else "")
    return Table(title, headings, tuple(cells), legend.strip())


def deviation_cells(shown: ShownResult, name: str) -> list[Words]:
    """Standard deviations of a frame: along x, y, z in millimetres, then about them in degrees."""
    if name not in known_unknowns(shown):
        return [FIXED] * 6
    at = ("refined", "frames", name)
    along: list[Words] = [shown.number(*at, "standard_deviations_mm", k, spec=".2f") for k in range(3)]
    return along + [shown.number(*at, "standard_deviations_deg", k, spec=".3f") for k in range(3)]


def known_unknowns(shown: ShownResult) -> frozenset[str]:
    """The names of all that was estimated; a frame that is not among them was stated."""
    return frozenset(shown.tree["refined"]["joint"]["slots"])


def angles_of(shown: ShownResult) -> dict[str, int]:
    """Where the evidence has roll, pitch and yaw of each frame; empty without evidence."""
    derived = shown.evidence_tree.get("derived") or {}
    return {row["frame"]: i for i, row in enumerate(derived.get("angles", ()))}
