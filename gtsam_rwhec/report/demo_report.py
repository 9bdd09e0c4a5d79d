"""The report of the demo: the errors in its log, how far the calibration is from the truth, and what to do next."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console

from gtsam_rwhec.datasets import DemoTruth
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.pose_covariances import error_of
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report.report_blocks import Table, Words
from gtsam_rwhec.report.terminal_report import print_heading, print_list, print_tables, report_console
from gtsam_rwhec.results.log_history import LogFields

LEGEND = (
    "off: difference between the found pose and the true pose. 95 %: whether the true pose is inside the 95 % "
    "confidence ellipsoid of the found pose."
)


def print_demo(
    refined: RefinedPoses, log: LogFields, truth: DemoTruth, folder: Path, console: Console | None = None
) -> None:
    """Print the errors that we put into the log and what was found, the distance from the truth, and what to do next.

    Parameters
    ----------
    refined : RefinedPoses
        The refined poses in the demo's result file.
    log : LogFields
        What became of the measurements, from the same file.
    truth : DemoTruth
        The truth with which the log was made.
    folder : Path
        The folder of the demo's files.
    """
    console = report_console() if console is None else console
    print_heading(console, "Errors that we put into this log, and what was found", tight=True)
    print_list(console, hidden_sentences(refined, log, truth))
    print_heading(console, "How far the answer is from the truth", tight=True)
    print_tables(console, [truth_table(refined, truth)], tight=True)
    print_heading(console, "What to do next", tight=True)
    steps = (
        f"Open {folder / 'report.html'} in a browser: the rig in 3D, the proof, the images. {folder / 'result.json'} "
        "has all numbers.",
        "Write a rig file for your own log, then complete the lines marked TODO: gtsam-rwhec init LOG.mcap -o rig.yaml",
        "Calibrate your log: gtsam-rwhec calibrate LOG.mcap --rig rig.yaml -o FOLDER",
    )
    print_list(console, steps)


def hidden_sentences(refined: RefinedPoses, log: LogFields, truth: DemoTruth) -> list[str]:
    """Each error that we put into the log, and what the calibration found."""
    sentences = []
    for size in log.sizes:
        true = truth.scale[size.target]
        if true != 1.0:
            stated_mm = 1e3 * size.stated_m
            sentences.append(
                f"The rig file says that the squares of {size.target} are {stated_mm:.2f} mm wide. This is "
                f"{100.0 * (true - 1.0):.1f} % too large: they are {stated_mm / true:.2f} mm wide. Found: "
                f"{stated_mm / size.scale:.3f} mm ({size.percent_too_large:.3f} % too large)."
            )
    for sensor, true_s in truth.time_offsets_s.items():
        if true_s != 0.0:
            deviation_s = np.sqrt(refined.covariance(Unknown(UnknownKind.TIME_OFFSET, sensor))[0, 0])
            sentences.append(
                f"The clock of {sensor} is {1e3 * true_s:.1f} ms behind the robot's clock. Found: "
                f"{1e3 * refined.time_offsets_s[sensor]:.2f} ± {1e3 * deviation_s:.2f} ms."
            )
    pair = Pair(truth.twice_seen, truth.twice_seen_by)
    seen = sum(t.seen for t in log.detection.tracks if t.pair == pair)
    used = sum(t.used for t in log.outliers if t.pair == pair)
    sentences.append(
        f"{truth.twice_seen_in} images of {pair.sensor} show the tag of {pair.target} twice: it is on a poster too. "
        f"Found: {seen - used} of {seen} detections of this tag by {pair.sensor} were left out."
    )
    return sentences


def truth_table(refined: RefinedPoses, truth: DemoTruth) -> Table:
    """How far the found pose of each frame is from the true pose."""
    rows: dict[str, tuple[Words, ...]] = {}
    for name, true in (truth.Y | truth.X).items():
        xi = error_of((refined.Y | refined.X)[name], true)
        inside = "inside" if refined.contains(name, true) else "outside"
        rows[name] = (f"{1e3 * np.linalg.norm(xi[3:]):.2f}", f"{np.degrees(np.linalg.norm(xi[:3])):.3f}", inside)
    return Table.of("Found poses and true poses", "frame", ("off mm", "off°", "95 %"), rows, LEGEND)
