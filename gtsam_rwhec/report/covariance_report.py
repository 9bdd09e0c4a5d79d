"""The covariance report: how well every frame, relative pose, scale and time offset is known."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from rich.console import Console
from rich.text import Text

from gtsam_rwhec.csv_files import natural_key
from gtsam_rwhec.pose_covariances import standard_deviations
from gtsam_rwhec.poses import Array
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.report.pose_table import POSE_HEADINGS, FrameTable, pose_cells
from gtsam_rwhec.report.solution_report import report_console

DEVIATION_HEADINGS = ("±x mm", "±y mm", "±z mm", "±x°", "±y°", "±z°")
LEGEND = (
    "Poses: metres; roll, pitch, yaw in degrees, R = Rz(yaw) Ry(pitch) Rx(roll). ±: one standard deviation along, and "
    "about, the x, y, z of the frame itself; 'free': the measurements say nothing of it. Moved: from the certified "
    "solution."
)


def print_refined(refined: Refined, console: Console | None = None) -> None:
    """Print the tables and sentences of the covariance report.

    Parameters
    ----------
    refined
        What `gtsam_rwhec.refine` returned.
    console
        Where to; None for standard output.
    """
    console = report_console() if console is None else console
    console.print(Text("Refined calibration and its standard deviations", style="bold"))
    console.print()
    for table in (
        _frame_table("Sensors in the frame that carries them", "sensor", refined.Y, refined),
        _frame_table("Targets in the frame that carries them", "target", refined.X, refined),
        *(_relative_table(kind, poses, refined) for kind, poses in (("sensor", refined.Y), ("target", refined.X))),
    ):
        if table.rows:
            console.print(table)
    console.print(Text(LEGEND, style="dim"), soft_wrap=not console.is_terminal)
    console.print()
    for sentence in refined_sentences(refined):
        console.print(Text(sentence), soft_wrap=not console.is_terminal)
    for sentence in refined.free_directions:
        console.print(Text(f"Not determined: {sentence}", style="bold red"), soft_wrap=not console.is_terminal)


def refined_sentences(refined: Refined) -> list[str]:
    """What the tables do not hold: scale, time offsets, noise, cost, outliers."""
    sentences = []
    for name in refined.names:
        if name in refined.X or name in refined.Y:
            continue
        deviation = math.sqrt(refined.covariance(name)[0, 0])
        kind, _, owner = name.partition(":")
        if kind == "scale":
            value = refined.scale[owner] if isinstance(refined.scale, Mapping) else refined.scale
            of = f" of {owner}" if owner else ""
            sentences.append(f"Scale{of} (measured / true length): {value:.6f} ± {_cell(deviation, 6)}.")
        else:
            offset = 1e3 * refined.time_offsets_s[owner]
            sentences.append(
                f"Time offset of {owner}: {offset:+.3f} ± {_cell(1e3 * deviation, 3)} ms (the carriers' time is its "
                "stamps' plus this)."
            )
    sentences += _noise_sentences(refined)
    sentences.append(
        f"Cost: {refined.cost:.6g} after {refined.iterations} iterations, {refined.initial_cost:.6g} at the certified "
        f"solution ({refined.options.residual} residual)."
    )
    for pair, kept in refined.inliers.items():
        if not kept.all():
            sentences.append(
                f"Outliers of {'-'.join(dict.fromkeys(pair))}: {int((~kept).sum())} of {len(kept)} left out."
            )
    return sentences


def _noise_sentences(refined: Refined) -> list[str]:
    """One sentence where all pairs have the same noise, else one for each."""
    groups: dict[str, list[str]] = {}
    for pair, noise in refined.noise.items():
        how = f"{math.degrees(noise.rotation_rad):.3g}° and {1e3 * noise.translation_m:.3g} mm an axis"
        if refined.noise_source == "estimated":
            how += f", estimated with {noise.redundancy[0]:.0f} and {noise.redundancy[1]:.0f} equations to spare"
        else:
            how += ", as given"
        groups.setdefault(how, []).append("-".join(dict.fromkeys(pair)))
    if len(groups) == 1:
        return [f"Noise of B: {next(iter(groups))}."]
    return [f"Noise of B, {', '.join(pairs)}: {how}." for how, pairs in groups.items()]


def _frame_table(title: str, kind: str, poses: Mapping[str, object], refined: Refined) -> FrameTable:
    rows = {}
    for name in sorted(poses, key=natural_key):
        moved = refined.moved[name]
        rows[name] = (
            *pose_cells(refined.X[name] if name in refined.X else refined.Y[name]),
            *deviation_cells(refined.covariance(name)),
            f"{moved.translation_mm:.2f}",
            f"{moved.rotation_deg:.3f}",
        )
    return FrameTable(title, kind, (*POSE_HEADINGS, *DEVIATION_HEADINGS, "moved mm", "moved°"), rows)


def _relative_table(kind: str, poses: Mapping[str, object], refined: Refined) -> FrameTable:
    """Every frame as seen from the first one on its carrier."""
    names = sorted(poses, key=natural_key)
    rows = {}
    for name in names[1:]:
        pose, covariance = refined.relative(names[0], name)
        rows[name] = (*pose_cells(pose), *deviation_cells(covariance))
    title = f"The {kind}s as seen from {names[0]}" if names else ""
    return FrameTable(title, kind, (*POSE_HEADINGS, *DEVIATION_HEADINGS), rows)


def deviation_cells(covariance: Array) -> tuple[str, ...]:
    """Standard deviations of a pose, translations (mm) before rotations (degrees), as poses are printed."""
    degrees, millimetres = standard_deviations(covariance)
    return *(_cell(value, 2) for value in millimetres), *(_cell(value, 3) for value in degrees)


def _cell(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else "free"
