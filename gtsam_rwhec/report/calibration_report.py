"""The report of ``calibrate``: the verdict, what to do, how far off a point is, the choices; then poses and details."""

from __future__ import annotations

from rich.console import Console

from gtsam_rwhec.calibration.calibrated import Calibration
from gtsam_rwhec.report.advice import print_advice
from gtsam_rwhec.report.covariance_report import print_refined_body
from gtsam_rwhec.report.printing import STYLES, print_heading, print_list, print_sentence, report_console
from gtsam_rwhec.report.solution_report import print_solution_body
from gtsam_rwhec.results.log_history import LogFields

POINTS = (
    "This is the error of the calibration alone, where the sensor typically saw its targets; in Python, "
    "calibration.uncertainty_at(point, frame) tells of any other point."
)


def print_calibration(
    calibration: Calibration, console: Console | None = None, *, log: LogFields | None = None
) -> None:
    """Print the verdict, what to do, how far off a point is, the choices with their evidence, poses, and details.

    Parameters
    ----------
    calibration : Calibration
        The result of `gtsam_rwhec.calibrate`.
    console : rich.console.Console, optional
        Where to print; standard output by default.
    log : LogFields, optional
        What became of the measurements, if they come from a log.
    """
    console = report_console() if console is None else console
    judgement, refined, solution = calibration.judgement, calibration.refined, calibration.solution
    print_sentence(console, str(judgement), STYLES[judgement.verdict])
    free = () if refined is None else refined.free_directions
    if not free and solution is not None:
        free = solution.identifiability.free_directions
    print_advice(console, free, log, judgement)
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
