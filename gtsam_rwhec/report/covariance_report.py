"""The covariance report: how well every frame, relative pose, scale and time offset is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from rich.console import Console

from gtsam_rwhec.files.natural_order import natural_key
from gtsam_rwhec.geometry.pose_covariances import standard_deviations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.refined import PairNoise, Refined
from gtsam_rwhec.refinement.unknowns import UnknownKind
from gtsam_rwhec.report.log_report import doubts, print_log
from gtsam_rwhec.report.pose_table import POSE_HEADINGS, RESIDUAL_LEGEND, FrameTable, pose_cells, residual_table
from gtsam_rwhec.report.solution_report import (
    print_heading,
    print_sentence,
    print_solution_details,
    print_tables,
    print_verdict,
    report_console,
)
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.verdict import judge

DEVIATION_HEADINGS = ("±x mm", "±y mm", "±z mm", "±x°", "±y°", "±z°")
LEGEND = (
    "Poses: metres; roll, pitch, yaw in degrees, R = Rz(yaw) Ry(pitch) Rx(roll). ±: one standard deviation along, and "
    "about, the x, y, z of the frame itself; free: infinite, as a direction that the measurements leave free reaches "
    "this axis. Moved: from the certified solution."
)


def print_refined(refined: Refined, console: Console | None = None, *, log: LogFields | None = None) -> None:
    """Print the verdict, the refined poses with their standard deviations, what to do, and the details.

    Parameters
    ----------
    refined
        What `gtsam_rwhec.refine` returned.
    console
        Where to; None for standard output.
    log
        What became of the measurements, where they come from a log.
    """
    console = report_console() if console is None else console
    solution = refined.solution
    print_verdict(console, judge(solution, refined, log))
    tables = (
        _frame_table("Sensors in the frame that carries them", "sensor", refined.Y, refined),
        _frame_table("Targets in the frame that carries them", "target", refined.X, refined),
    )
    print_tables(console, tables, LEGEND)
    for sentence in scale_and_offset_sentences(refined):
        print_sentence(console, sentence)
    free = refined.free_directions or solution.identifiability.free_directions
    advice = doubts(log) if log is not None else []
    if free or advice:
        print_heading(console, "What to do")
    for direction in free:
        print_sentence(console, f"Not determined: {direction}", "bold red")
    if free:
        print_sentence(console, "Turn further while measuring, about two different axes or more; or fix known frames.")
    for sentence in advice:
        print_sentence(console, sentence, "bold yellow")
    print_heading(console, "Details")
    if log is not None:
        print_log(log, console)
    print_tables(
        console,
        [_relative_table(kind, poses, refined) for kind, poses in (("sensor", refined.Y), ("target", refined.X))]
        + [residual_table(solution)],
        RESIDUAL_LEGEND,
    )
    console.print()
    noise = noise_table(refined)
    if len(noise.rows) > 1:
        console.print(noise)
    for sentence in refined_sentences(refined):
        print_sentence(console, sentence)
    console.print()
    print_solution_details(console, solution)


def scale_and_offset_sentences(refined: Refined) -> list[str]:
    """What is used beside the poses: scales and time offsets."""
    sentences = []
    for unknown in refined.unknowns:
        if unknown.kind is UnknownKind.FRAME:
            continue
        deviation = math.sqrt(refined.covariance(unknown)[0, 0])
        owner = unknown.owner
        if unknown.kind is UnknownKind.SCALE:
            value = refined.scale[owner] if isinstance(refined.scale, Mapping) else refined.scale
            of = f" of {owner}" if owner else ""
            sentences.append(f"Scale{of} (measured / true length): {value:.6f} ± {_cell(deviation, 6)}.")
        else:
            offset = 1e3 * refined.time_offsets_s[owner]
            sentences.append(
                f"Time offset of {owner}: {offset:+.3f} ± {_cell(1e3 * deviation, 3)} ms (the carriers' time is its "
                "stamps' plus this)."
            )
    return sentences


def refined_sentences(refined: Refined) -> list[str]:
    """What the standard deviations rest on: noise, cost, outliers."""
    sentences = [_noise_sentence(refined), _carrier_noise_sentence(refined)]
    loss = "" if refined.options.robust in ("none", "gnc") else f", {refined.options.robust} loss"
    steps = f"{refined.iterations} iteration{'' if refined.iterations == 1 else 's'}"
    sentences.append(
        f"Cost in the weights of the refinement (not the certified one's): {refined.cost:.6g} after {steps}, "
        f"{refined.initial_cost:.6g} at the certified solution ({refined.options.residual} residual{loss})."
    )
    if refined.inlier_counts:
        sentences.append(_outlier_sentence(refined.inlier_counts))
    return sentences


def _noise_sentence(refined: Refined) -> str:
    """Where the noise comes from; its size too where it is the same for all pairs, which else the table has."""
    source = "estimated from the residuals" if refined.noise_source == "estimated" else "as given"
    rows = noise_table(refined).rows
    if len(rows) != 1:
        return f"Noise of B: {source}; in the table."
    rotation, translation, *behind = next(iter(rows.values()))
    backing = f", with {behind[0]} and {behind[1]} degrees of freedom" if behind else ""
    return f"Noise of B: {rotation}° and {translation} mm an axis, {source}{backing}."


def _carrier_noise_sentence(refined: Refined) -> str:
    noise = refined.options.carrier_noise
    if noise is None:
        return (
            "Noise of A: left out; where the carriers' poses are not exact, these standard deviations are too small "
            "(a rig file gives it as carriers: noise:)."
        )
    if noise.covariances is not None:
        return "Noise of A: the covariances given for each measurement."
    return (
        f"Noise of A: {math.degrees(noise.rotation_rad):.3g}° and {1e3 * noise.translation_m:.3g} mm an axis of the "
        f"{noise.about.removesuffix('carrier')} carrier, as given."
    )


def _outlier_sentence(counts: Mapping[Pair, tuple[int, int]]) -> str:
    """How many measurements were left out, and of which pairs."""
    total = sum(number for _, number in counts.values())
    out = {pair: number - kept for pair, (kept, number) in counts.items() if kept < number}
    if not out:
        return f"Outliers: none of {total} measurements."
    pairs = ", ".join(f"{pair} {count} of {counts[pair][1]}" for pair, count in out.items())
    return f"Outliers: {sum(out.values())} of {total} measurements left out: {pairs}."


def noise_table(refined: Refined) -> FrameTable:
    """The noise of B: a line for all pairs, for each sensor, or for each pair, as few as tell all."""
    noises = {pair: _noise_cells(noise) for pair, noise in refined.noise.items()}
    kinds: tuple[tuple[str, Callable[[Pair], str]], ...] = (
        ("", lambda pair: "all"),
        ("sensor", lambda pair: pair.sensor),
        ("pair", str),
    )
    kind, label = next(
        (kind, label)
        for kind, label in kinds
        if label is str
        or len({(label(pair), cells) for pair, cells in noises.items()}) == len({label(pair) for pair in noises})
    )
    rows = {label(pair): cells for pair, cells in noises.items()}
    headings = ("±°", "±mm") if refined.noise_source == "given" else ("±°", "±mm", "d.o.f. (°)", "d.o.f. (mm)")
    title = "Noise of B an axis" + ("" if refined.noise_source == "given" else ", and degrees of freedom")
    return FrameTable(title, kind, headings, {name: rows[name] for name in sorted(rows, key=natural_key)})


def _noise_cells(noise: PairNoise) -> tuple[str, ...]:
    size = (f"{math.degrees(noise.rotation_rad):.3g}", f"{1e3 * noise.translation_m:.3g}")
    return size + tuple(f"{number:.0f}" for number in noise.degrees_of_freedom if np.isfinite(number))


def _frame_table(title: str, kind: str, poses: Mapping[str, object], refined: Refined) -> FrameTable:
    rows = {}
    for name in sorted(poses, key=natural_key):
        moved = refined.moved[name]
        rows[name] = (
            *pose_cells(refined.X[name] if name in refined.X else refined.Y[name]),
            *(deviation_cells(refined.covariance(name)) if name in refined.names else ("fixed",) * 6),
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
