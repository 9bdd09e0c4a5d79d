"""The report of ``calibrate``: a screen of it, or all: verdict, what to do, points, choices, poses and details."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.report.advice import Advice, print_advice
from gtsam_rwhec.report.covariance_report import label, print_refined_body, wrong_sentence
from gtsam_rwhec.report.printing import STYLES, print_heading, print_list, print_sentence, report_console
from gtsam_rwhec.report.short_poses import refined_poses, scales_and_clocks
from gtsam_rwhec.report.short_report import LINES, ShortReport
from gtsam_rwhec.report.solution_report import print_solution_body, solved_poses
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.result_judgement import contradicted_names
from gtsam_rwhec.solver.free_directions import FreeDirection

POINTS = (
    "This is the error of the calibration alone, where the sensor typically saw its targets; in Python, "
    "calibration.uncertainty_at(point, frame) tells of any other point."
)
#: How to see everything, in Python.
WHOLE = "print_calibration(calibration, verbose=True)"


def print_calibration(
    calibration: Calibration,
    console: Console | None = None,
    *,
    log: LogFields | None = None,
    verbose: bool = False,
    lines: int = LINES,
    page: Path | None = None,
    whole: str = WHOLE,
) -> None:
    """Print a screen with the verdict, what to do, how far off a point is, and the poses; or everything.

    Parameters
    ----------
    calibration : Calibration
        The result of `gtsam_rwhec.calibrate`.
    console : rich.console.Console, optional
        Where to print; standard output by default.
    log : LogFields, optional
        What became of the measurements, if they come from a log.
    verbose : bool
        Print everything: the choices with their evidence, all columns and rows, corners, residuals, the proof.
    lines : int
        The lines of the screen. Sentences in a file are not wrapped, and count as on a terminal of 80 columns.
    page : Path, optional
        The page with everything, if one was written: the last line names it.
    whole : str
        How to see everything here: the last line says it.
    """
    console = report_console() if console is None else console
    if verbose:
        _print_everything(calibration, console, log)
    else:
        _short(calibration, log).print(console, lines=lines, page=page, whole=whole)


def _short(calibration: Calibration, log: LogFields | None) -> ShortReport:
    refined, solution = calibration.refined, calibration.solution
    said = Advice.of(_free(calibration), log, calibration.judgement).items
    points = tuple(calibration.points.values())
    notes = tuple((note, "yellow") for note in calibration.notes)
    if refined is None:
        poses = () if solution is None else (solved_poses(solution),)
        return ShortReport(calibration.judgement, said, points, poses, notes)
    wrong = contradicted_names(refined, log)
    marked = frozenset(label(name, wrong) for name in wrong)
    sentences: tuple[tuple[str, str], ...] = ((wrong_sentence(refined, log), "bold"),) if wrong else ()
    sentences += (*notes, *((words, "") for words in scales_and_clocks(refined)))
    return ShortReport(calibration.judgement, said, points, refined_poses(refined, wrong, log), sentences, marked)


def _free(calibration: Calibration) -> Sequence[FreeDirection]:
    refined, solution = calibration.refined, calibration.solution
    free = () if refined is None else refined.free_directions
    if not free and solution is not None:
        free = solution.identifiability.free_directions
    return free


def _print_everything(calibration: Calibration, console: Console, log: LogFields | None) -> None:
    judgement, refined, solution = calibration.judgement, calibration.refined, calibration.solution
    print_sentence(console, str(judgement), STYLES[judgement.verdict])
    print_advice(console, _free(calibration), log, judgement)
    points = calibration.points
    if points:
        print_heading(console, "How far off a point is")
        print_list(console, map(str, points.values()))
        print_sentence(console, POINTS, "dim")
    print_heading(console, "What was chosen, and why")
    print_list(console, map(str, calibration.choices))
    print_list(console, calibration.notes, "yellow")
    if calibration.cannot_tell:
        print_list(console, [f"Not checked, as no residual shows it: {_facts(calibration)}."], "dim")
    if refined is not None:
        print_refined_body(console, refined, log, outliers_are_said=True)
    elif solution is not None:
        print_solution_body(console, solution)


def _facts(calibration: Calibration) -> str:
    return "; ".join(words.removeprefix("data cannot tell: ") for words in calibration.cannot_tell)
