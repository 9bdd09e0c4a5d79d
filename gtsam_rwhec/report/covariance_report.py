"""The report of a refined calibration: how well each frame, relative pose, scale and time offset is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping

import numpy as np
from rich.console import Console

from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.fitting.fit_options import About
from gtsam_rwhec.fitting.refined import PairNoise, Refined
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.geometry.pose_covariances import standard_deviations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report.advice import print_advice
from gtsam_rwhec.report.corner_report import print_corners
from gtsam_rwhec.report.log_report import print_log
from gtsam_rwhec.report.pose_table import POSE_HEADINGS, RESIDUAL_LEGEND, FrameTable, pose_cells, residual_table
from gtsam_rwhec.report.printing import print_heading, print_sentence, print_tables, print_verdict, report_console
from gtsam_rwhec.report.solution_report import print_solution_details
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.result_judgement import contradicted, contradicted_names, judge

DEVIATION_HEADINGS = ("±x mm", "±y mm", "±z mm", "±x°", "±y°", "±z°")
#: Beside the name of a frame whose pose is not to be used.
MARK = "(!)"
#: The carrier that has the noise of A.
CARRIERS: dict[About, str] = {"targetcarrier": "target carrier", "sensorcarrier": "sensor carrier"}
#: What the numbers of the noise are, beside the residuals.
NOISE_LEGEND = (
    "This is the noise of the median measurement, before any fit. Residuals are weighted: far and oblique measurements "
    "are noisier and count less, so the residuals' root mean square can be far smaller."
)
#: Of a log whose corners were not used.
NOT_FROM_CORNERS = (
    "The answer is from the poses of targets in the images: the intrinsics by which these were measured count as "
    "exact, and their errors are not in the standard deviations."
)
#: Of an answer from corners, before the noise of B.
FROM_POSES = "The refinement from corners started at one from the poses of targets in the images, whose noise is this."
LEGEND = (
    "x, y, z: metres. roll, pitch, yaw: degrees, with R = Rz(yaw) Ry(pitch) Rx(roll). ±: one standard deviation, along "
    "and about the axes of the frame itself; free: infinite, because the measurements leave a direction free. moved: "
    "how far the refinement moved the pose"
)


def print_refined(refined: Refined, console: Console | None = None, *, log: LogFields | None = None) -> None:
    """Print the verdict, what to do, the refined poses with their standard deviations, and the details.

    Parameters
    ----------
    refined : Refined
        The result of `gtsam_rwhec.refine`.
    console : rich.console.Console, optional
        Where to print; standard output by default.
    log : LogFields, optional
        What became of the measurements, if they come from a log.
    """
    console = report_console() if console is None else console
    solution = refined.solution
    print_verdict(console, judge(solution, refined, log), solution)
    print_advice(console, refined.free_directions or solution.identifiability.free_directions, log)
    print_refined_body(console, refined, log)


def print_refined_body(
    console: Console, refined: Refined, log: LogFields | None = None, *, outliers_are_said: bool = False
) -> None:
    """Print the refined poses with their standard deviations, and the details."""
    solution = refined.solution
    wrong = contradicted_names(refined, log)
    print_heading(console, "Poses")
    sensor_frame, target_frame = (
        ("of their carrier", "of their carrier") if log is None else (log.sensor_carrier, log.target_carrier)
    )
    tables = (
        _frame_table(f"Sensors in the frame {sensor_frame}", "sensor", refined.Y, refined, wrong),
        _frame_table(f"Targets in the frame {target_frame}", "target", refined.X, refined, wrong),
    )
    print_tables(console, tables, legend(refined))
    if wrong:
        print_sentence(console, wrong_sentence(refined, log), "bold")
    for sentence in scale_and_offset_sentences(refined):
        print_sentence(console, sentence)
    if refined.reprojection is None and log is not None:
        print_sentence(console, NOT_FROM_CORNERS)
    print_corners(refined, console)
    print_heading(console, "Details")
    if log is not None:
        print_log(log, console)
    sides = (("sensor", refined.Y), ("target", refined.X))
    relative = [_relative_table(kind, poses, refined, wrong) for kind, poses in sides]
    print_tables(console, [*relative, residual_table(solution)], RESIDUAL_LEGEND)
    console.print()
    noise = noise_table(refined)
    if len(noise.rows) > 1:
        console.print(noise)
    if refined.inlier_counts and not outliers_are_said:
        print_sentence(console, outlier_sentence(refined.inlier_counts))
    for sentence in refined_sentences(refined):
        print_sentence(console, sentence)
    console.print()
    weights_from = "as given" if log is None else _weights_of_log(refined)
    estimated = refined.noise_source == "estimated"
    print_solution_details(console, solution, weights_from, noise_is_estimated=estimated)


def wrong_sentence(refined: Refined, log: LogFields | None) -> str:
    """What the mark beside a frame means, with the counts behind it."""
    counts = "; ".join(map(str, contradicted(refined, log)))
    return f"{MARK}: do not use this pose; {counts}."


def legend(refined: Refined) -> str:
    """What the columns mean, and what the refinement's model has that the certified one lacks."""
    has_offsets = any(unknown.kind is UnknownKind.TIME_OFFSET for unknown in refined.unknowns)
    has_carrier_noise = refined.options.carrier_noise is not None or bool(refined.noise_sentences)
    added = ["clock offsets"] * has_offsets + ["the noise of A"] * has_carrier_noise
    if refined.reprojection is not None:
        return f"{LEGEND}; it adds {', '.join(['corners', *added])} and intrinsics."
    return f"{LEGEND}; it adds {' and '.join(added)}." if added else f"{LEGEND}."


def _weights_of_log(refined: Refined) -> str:
    """Where the weights of a log's solution come from; `gtsam_rwhec.runs.measured_pairs.problem_of` sets them."""
    if refined.noise_source == "estimated":
        return "from the covariances of the detections in the log"
    return "from the noise that the rig file states"


def scale_and_offset_sentences(refined: Refined) -> list[str]:
    """The scales and time offsets, with their standard deviations."""
    sentences = []
    for unknown in refined.unknowns:
        if unknown.kind not in (UnknownKind.SCALE, UnknownKind.TIME_OFFSET):
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
                f"Time offset of {owner}: {offset:+.3f} ± {_cell(1e3 * deviation, 3)} ms (a stamp of {owner} + this = "
                "the carriers' time)."
            )
    return sentences


def refined_sentences(refined: Refined) -> list[str]:
    """The noise and the cost, which decide the standard deviations."""
    from_corners = refined.reprojection is not None
    sentences = [FROM_POSES] if from_corners else []
    sentences += [_noise_sentence(refined), NOISE_LEGEND]
    sentences += refined.noise_sentences or (() if from_corners else (_carrier_noise_sentence(refined),))
    if from_corners:
        steps = f"{refined.iterations} iteration{'' if refined.iterations == 1 else 's'}"
        return [*sentences, f"Cost of the refinement from corners: {refined.cost:.6g} after {steps}."]
    loss = "" if refined.options.robust in ("none", "gnc") else f", {refined.options.robust} loss"
    steps = f"{refined.iterations} iteration{'' if refined.iterations == 1 else 's'}"
    sentences.append(
        f"Cost of the refinement: {refined.initial_cost:.6g} before, {refined.cost:.6g} after {steps} "
        f"({refined.options.residual} residual{loss}). Do not compare it with the certified cost, which has other "
        "weights."
    )
    return sentences


def _noise_sentence(refined: Refined) -> str:
    """The source of the noise, and its size if all pairs have the same noise."""
    source = "estimated from the residuals" if refined.noise_source == "estimated" else "as given"
    rows = noise_table(refined).rows
    if len(rows) != 1:
        return f"Noise of B: {source}; see the table."
    rotation, translation, *behind = next(iter(rows.values()))
    backing = f", with {behind[0]} and {behind[1]} degrees of freedom" if behind else ""
    return f"Noise of B: {rotation}° and {translation} mm for each axis of a typical measurement, {source}{backing}."


def _carrier_noise_sentence(refined: Refined) -> str:
    noise = refined.options.carrier_noise
    if noise is None:
        return (
            "Noise of A: none, the carriers' poses count as exact. If they are not, the standard deviations above are "
            "too small. A rig file states this noise under carriers: noise."
        )
    if noise.covariances is not None:
        return "Noise of A: the covariances given for each measurement."
    return (
        f"Noise of A: {math.degrees(noise.rotation_rad):.3g}° and {1e3 * noise.translation_m:.3g} mm for each axis "
        f"of the {CARRIERS[noise.about]}, as given."
    )


def outlier_sentence(counts: Mapping[Pair, tuple[int, int]]) -> str:
    """How many measurements of which pairs were left out."""
    total = sum(number for _, number in counts.values())
    out = {pair: number - kept for pair, (kept, number) in counts.items() if kept < number}
    if not out:
        return f"Outliers: none of {total} measurements."
    pairs = ", ".join(f"{pair} {count} of {counts[pair][1]}" for pair, count in out.items())
    return f"Outliers: {sum(out.values())} of {total} measurements left out: {pairs}."


def noise_table(refined: Refined) -> FrameTable:
    """The noise of B: one line for all pairs, or one for each sensor or each pair where they differ."""
    noises = {pair: _noise_cells(noise) for pair, noise in refined.noise.items()}
    kinds: tuple[tuple[str, Callable[[Pair], str]], ...] = (
        ("", lambda pair: "all"),
        ("sensor", lambda pair: pair.sensor),
        ("pair", str),
    )
    choices = ((kind, label, {label(pair): cells for pair, cells in noises.items()}) for kind, label in kinds)
    kind, rows = next(
        (kind, rows)
        for kind, label, rows in choices
        if all(rows[label(pair)] == cells for pair, cells in noises.items())
    )
    headings = ("±°", "±mm") if refined.noise_source == "given" else ("±°", "±mm", "d.o.f. (°)", "d.o.f. (mm)")
    title = "Noise of B for each axis of a typical measurement"
    if refined.noise_source == "estimated":
        title += ", and degrees of freedom"
        if refined.options.noise_groups == "all":  # one estimate for all rows
            title += " of all pairs together"
    return FrameTable(title, kind, headings, {name: rows[name] for name in sorted(rows, key=natural_key)})


def _noise_cells(noise: PairNoise) -> tuple[str, ...]:
    size = (f"{math.degrees(noise.rotation_rad):.3g}", f"{1e3 * noise.translation_m:.3g}")
    return size + tuple(f"{number:.0f}" for number in noise.degrees_of_freedom if np.isfinite(number))


def _frame_table(
    title: str, kind: str, poses: Mapping[str, object], refined: Refined, wrong: Collection[str]
) -> FrameTable:
    rows = {}
    for name in sorted(poses, key=natural_key):
        moved = refined.moved[name]
        rows[label(name, wrong)] = (
            *pose_cells(refined.X[name] if name in refined.X else refined.Y[name]),
            *(deviation_cells(refined.covariance(name)) if name in refined.names else ("fixed",) * 6),
            f"{moved.translation_mm:.2f}",
            f"{moved.rotation_deg:.3f}",
        )
    return FrameTable(title, kind, (*POSE_HEADINGS, *DEVIATION_HEADINGS, "moved mm", "moved°"), rows)


def label(name: str, wrong: Collection[str]) -> str:
    """A frame's name in tables, marked where its pose is not to be used."""
    return f"{name} {MARK}" if name in wrong else name


def _relative_table(kind: str, poses: Mapping[str, object], refined: Refined, wrong: Collection[str]) -> FrameTable:
    """The pose of each frame in the first frame of the same carrier."""
    names = sorted(poses, key=natural_key)
    rows = {}
    for name in names[1:]:
        pose, covariance = refined.relative(names[0], name)
        rows[label(name, wrong)] = (*pose_cells(pose), *deviation_cells(covariance))
    title = f"Other {kind}s in the frame of {names[0]}" if names else ""
    return FrameTable(title, kind, (*POSE_HEADINGS, *DEVIATION_HEADINGS), rows)


def deviation_cells(covariance: Array) -> tuple[str, ...]:
    """Standard deviations of a pose: translations in millimetres, then rotations in degrees."""
    degrees, millimetres = standard_deviations(covariance)
    return *(_cell(value, 2) for value in millimetres), *(_cell(value, 3) for value in degrees)


def _cell(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else "free"
