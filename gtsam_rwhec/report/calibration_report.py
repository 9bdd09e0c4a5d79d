"""Calibrations, refinements, solutions and cross-validations on the terminal: one screen, or all of their page."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
from rich.console import Console

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.cross_validation import CrossValidation, HoldOutError
from gtsam_rwhec.calibration.verdict import Finding, Verdict
from gtsam_rwhec.files.terminal_text import natural_key, rounded
from gtsam_rwhec.fitting.fit_options import About
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.geometry.pose_covariances import standard_deviations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.advice import advice_of, certificate_sentence, scale_sentence
from gtsam_rwhec.report.report_blocks import Block, Listing, Paragraph, Section, Table, Words, is_absent
from gtsam_rwhec.report.report_page import sections_of
from gtsam_rwhec.report.residual_section import RESIDUAL_HEADINGS, residual_cells
from gtsam_rwhec.report.short_report import LINES, PoseTables, ShortReport
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.report.terminal_report import STYLES, print_blocks, print_sections, report_console
from gtsam_rwhec.report.verdict_section import DEVIATION_HEADINGS, MARK, NO_NOISE_STATED, POSE_HEADINGS
from gtsam_rwhec.results.derived import scalars_of
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.result_judgement import contradicted, contradicted_names, judge
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.free_directions import FreeDirection
from gtsam_rwhec.solver.solution import Solution

ANGLES = "R = Rz(yaw) Ry(pitch) Rx(roll)"
SOLVED_LEGEND = (
    f"x, y, z: metres. roll, pitch, yaw: degrees, with {ANGLES}. rms: root mean square length of the residuals of a "
    "frame's n measurements, weighted as in the cost, in mm and degrees."
)
#: The carrier that has the noise of A.
CARRIERS: dict[About, str] = {"targetcarrier": "target carrier", "sensorcarrier": "sensor carrier"}
#: Sections that are for browsers: the scene, and texts to copy.
ON_THE_PAGE_ONLY = ("scene", "inputs")


def print_calibration(
    calibration: Calibration,
    console: Console | None = None,
    *,
    log: LogFields | None = None,
    verbose: bool = False,
    lines: int = LINES,
    page: Path | None = None,
    whole: str = "print_calibration(calibration, verbose=True)",
) -> None:
    """Print a screen with the verdict, what to do, how far off a point is, and the poses; or everything.

    Parameters
    ----------
    calibration : Calibration
        The result of `gtsam_rwhec.calibrate`.
    log : LogFields, optional
        What became of the measurements, if they come from a log.
    verbose : bool
        Print everything: what the page says, but for figures and what only the measurements tell.
    lines : int
        The lines of the screen. Sentences in a file are not wrapped, and count as on a terminal of 80 columns.
    page : Path, optional
        The page with everything, if one was written: the last line names it.
    whole : str
        How to see everything here: the last line says it.
    """
    console = report_console() if console is None else console
    if verbose:
        _print_everything(console, ShownResult.of_answer(calibration, log), _carrier_noise(calibration.refined))
        return
    refined, solution = calibration.refined, calibration.solution
    free: Sequence[FreeDirection] = () if refined is None else refined.free_directions
    if not free and solution is not None:
        free = solution.identifiability.free_directions
    report = ShortReport(
        calibration.judgement,
        "" if solution is None or calibration.judgement.is_of_the_reading else proof_line(solution.certificate),
        advice_of(free, log, calibration.judgement),
        tuple(calibration.points.values()),
        sentences=tuple((note, "yellow") for note in calibration.notes),
    )
    if refined is not None:
        report = _with_refined_poses(report, refined, log)
    elif solution is not None:
        report = replace(report, poses=(_solved_poses(solution),))
    report.print(console, lines=lines, page=page, whole=whole)


def print_refined(refined: Refined, console: Console | None = None, *, log: LogFields | None = None) -> None:
    """Print the verdict, what to do, the refined poses with their standard deviations, and the details.

    Parameters
    ----------
    refined : Refined
        The result of `gtsam_rwhec.refine`.
    log : LogFields, optional
        What became of the measurements, if they come from a log.
    """
    console = report_console() if console is None else console
    _print_everything(console, ShownResult.of_answer(refined, log), _carrier_noise(refined))


def print_solution(
    solution: Solution,
    console: Console | None = None,
    *,
    findings: Sequence[Finding] = (),
    verbose: bool = True,
    lines: int = LINES,
    page: Path | None = None,
    whole: str = "print_solution(solution)",
) -> None:
    """Print the verdict, what to do, the poses, and the details; or a screen of it.

    Parameters
    ----------
    solution : Solution
        The result of `gtsam_rwhec.solve`.
    findings : sequence of Finding, optional
        What else is known against the poses: how A and B were read.
    verbose : bool
        Print everything; otherwise a screen: the verdict, what to do, poses with residuals, and what is proven.
    lines, page, whole
        The screen's lines, the page with everything, if one was written, and how to see everything here.
    """
    console = report_console() if console is None else console
    judgement = judge(solution, findings=findings)
    if verbose:
        _print_everything(console, ShownResult.of_answer(solution, findings=findings))
        return
    advice = [(NO_NOISE_STATED, STYLES[Verdict.CARE])] if solution.is_relative else []
    advice += advice_of(solution.identifiability.free_directions, judgement=judgement)
    scale = () if solution.scale_mode == "known" else (scale_sentence(solution),)
    sentences = tuple((words, "") for words in (*scale, certificate_sentence(solution.certificate)))
    report = ShortReport(judgement, "", tuple(advice), (), (_solved_poses(solution),), sentences)
    report.print(console, lines=lines, page=page, whole=whole)


def proof_line(certificate: Certificate) -> str:
    """What is proven of the certified answer, on one line; empty where nothing is, of which the verdict speaks.

    It says nothing of how well the poses are known: an answer may be the best of bad measurements.
    """
    if not certificate.is_optimal:
        return ""
    alike = "" if certificate.is_certified else "; others fit as well"
    return f"Proven: no other answer fits these measurements better (gap {certificate.relative_gap:.0e}){alike}."


def _print_everything(console: Console, shown: ShownResult, more: Sequence[Section] = ()) -> None:
    """The verdict first, then the sections that have something to say without figures and measurements."""
    sections = [
        replace(section, blocks=blocks, missing="")
        for section in sections_of(shown)
        if section.name not in ON_THE_PAGE_ONLY
        if (blocks := tuple(block for block in section.blocks if not is_absent(block)))
    ]
    print_blocks(console, sections[0].blocks)
    print_sections(console, [*sections[1:], *more])


def _with_refined_poses(report: ShortReport, refined: Refined, log: LogFields | None) -> ShortReport:
    """With the poses, marked where they are not to be used, and scales and clocks."""
    wrong = contradicted_names(refined, log)
    sentences = list(report.sentences)
    if wrong:
        counts = "; ".join(map(str, contradicted(refined, log)))
        sentences.insert(0, (f"{MARK}: do not use this pose; {counts}.", "bold"))
    sentences += [(words, "") for words in scales_and_clocks(refined)]
    marked = frozenset(_label(name, wrong) for name in wrong)
    return replace(report, poses=_refined_poses(refined, wrong, log), sentences=tuple(sentences), marked=marked)


def _refined_poses(refined: Refined, wrong: Collection[str], log: LogFields | None) -> tuple[PoseTables, PoseTables]:
    """Refined poses with their standard deviations along and about all axes, and with the largest ones alone."""
    carriers = ("of their carrier", "of their carrier") if log is None else (log.sensor_carrier, log.target_carrier)
    tables = []
    sides = ((f"Sensors in the frame {carriers[0]}", refined.Y), (f"Targets in the frame {carriers[1]}", refined.X))
    for (title, poses), kind in zip(sides, ("sensor", "target"), strict=True):
        rows: dict[str, tuple[Words, ...]] = {}
        for name in sorted(poses, key=natural_key):
            known = deviation_cells(refined.covariance(name)) if name in refined.names else ("fixed",) * 6
            rows[_label(name, wrong)] = (*pose_cells(poses[name]), *known)
        tables.append(Table.of(title, kind, (*POSE_HEADINGS, *DEVIATION_HEADINGS), rows))
    free = "; free: not determined" if any("free" in row for table in tables for row in table.rows) else ""
    largest = tuple(map(with_largest, tables))
    return (
        PoseTables(tuple(tables), f"{ANGLES}. ±: one standard deviation along and about the frame's own axes{free}."),
        PoseTables(largest, f"{ANGLES}. ±: the largest standard deviation along and about the frame's axes{free}."),
    )


def with_largest(table: Table) -> Table:
    """The table with one column for the standard deviations of the translation, and one for those of the rotation."""
    rows = tuple((*row[:7], _largest(row[7:10]), _largest(row[10:])) for row in table.rows)
    return replace(table, headings=(*table.headings[:7], "± mm", "±°"), rows=rows)


def _largest(cells: tuple[Words, ...]) -> Words:
    """The largest of some cells, of which one that is not a number stands for all."""
    return max(cells, key=lambda cell: float(str(cell)) if str(cell)[0].isdigit() else math.inf)


def _solved_poses(solution: Solution) -> PoseTables:
    """Certified poses with their residuals, and scales of targets."""
    scales = solution.scale if isinstance(solution.scale, Mapping) else {}
    tables = []
    for kind, poses in (("sensor", solution.Y), ("target", solution.X)):
        own = any(name in scales for name in poses)
        rows: dict[str, tuple[Words, ...]] = {}
        for name in sorted(poses, key=natural_key):
            scale = (f"{scales[name]:.5f}" if name in scales else "-",) if own else ()
            rows[name] = (*pose_cells(poses[name]), *residual_cells(solution, name), *scale)
        headings = (*POSE_HEADINGS, *RESIDUAL_HEADINGS, *(("scale",) if own else ()))
        tables.append(Table.of(f"{kind.capitalize()}s in the frame of their carrier", kind, headings, rows))
    return PoseTables(tuple(tables), SOLVED_LEGEND)


def pose_cells(pose: gtsam.Pose3) -> tuple[str, ...]:
    """x, y, z in metres; roll, pitch, yaw in degrees."""
    translation = (f"{value:z.4f}" for value in pose.translation())
    return *translation, *(f"{value:z.2f}" for value in np.degrees(pose.rotation().rpy()))


def deviation_cells(covariance: Array) -> tuple[str, ...]:
    """Standard deviations of a pose: translations in millimetres, then rotations in degrees."""
    degrees, millimetres = standard_deviations(covariance)
    return *(_cell(value, 2) for value in millimetres), *(_cell(value, 3) for value in degrees)


def _cell(value: float | None, decimals: int) -> str:
    if value is None or not np.isfinite(value):
        return "free"
    # A standard deviation is never printed as 0: it has one digit that counts at least.
    return rounded(value, 1) if 0.0 < value < 10.0**-decimals else f"{value:.{decimals}f}"


def _label(name: str, wrong: Collection[str]) -> str:
    """A frame's name in tables, marked where its pose is not to be used."""
    return f"{name} {MARK}" if name in wrong else name


def scales_and_clocks(refined: Refined) -> list[str]:
    """The scales and time offsets, with their standard deviations, in a sentence each."""
    sentences = []
    for one in scalars_of(refined):
        if one.kind == "scale":
            of = f" of {one.owner}" if one.owner else ""
            words = f"Scale{of} (measured / true length): {one.value:.6f} ± {_cell(one.deviation, 6)}."
        else:
            deviation_ms = None if one.deviation is None else 1e3 * one.deviation
            words = f"Time offset of {one.owner}: {1e3 * one.value:+.3f} ± {_cell(deviation_ms, 3)} ms."
        sentences.append(words)
    return sentences


def _carrier_noise(refined: Refined | None) -> list[Section]:
    """The noise of A that a fit to poses took as true."""
    if refined is None or refined.reprojection is not None:
        return []
    return [Section("noise-of-A", "Noise of the carriers' poses", (Paragraph(_carrier_noise_sentence(refined)),))]


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
