"""What the demo's log hides, how far its calibration is from the truth, and what to do next."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console

from gtsam_rwhec.datasets.demo_log import DemoTruth
from gtsam_rwhec.geometry.pose_covariances import error_of
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.refined import RefinedPoses
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.solution_report import print_heading, print_sentence, print_tables, report_console
from gtsam_rwhec.results.log_history import LogFields

LEGEND = "off: between the found pose and the true one. 95 %: whether the truth is inside the confidence ellipsoid."


def print_demo(
    refined: RefinedPoses, log: LogFields, truth: DemoTruth, folder: Path, console: Console | None = None
) -> None:
    """Print what the log hides and what was found of it, the distance from the truth, and what comes next.

    Parameters
    ----------
    refined, log
        What the demo's result file has.
    truth
        What its log was made with.
    folder
        Where the demo wrote.
    console
        Where to; None for standard output.
    """
    console = report_console() if console is None else console
    print_heading(console, "What this log hides, and what was found")
    for sentence in hidden_sentences(refined, log, truth):
        print_sentence(console, f"  - {sentence}")
    print_heading(console, "How far the answer is from the truth")
    print_tables(console, [truth_table(refined, truth)], LEGEND)
    print_heading(console, "What to do next")
    for sentence in (
        f"Look at {folder / 'plots' / 'frames.png'} and the pictures beside it; {folder / 'result.json'} has all "
        "numbers.",
        "Calibrate your own log. First write a rig file, and fill in what it marks: gtsam-rwhec init LOG.mcap -o "
        "rig.yaml",
        "Then calibrate: gtsam-rwhec calibrate LOG.mcap --rig rig.yaml -o FOLDER",
    ):
        print_sentence(console, f"  - {sentence}")


def hidden_sentences(refined: RefinedPoses, log: LogFields, truth: DemoTruth) -> list[str]:
    """Each difficulty that the log was made with, and what the calibration made of it."""
    sentences = []
    for size in log.sizes:
        true = truth.scale[size.target]
        if true != 1.0:
            stated_mm = 1e3 * size.stated_m
            sentences.append(
                f"The rig file says that the squares of {size.target} are {stated_mm:.2f} mm wide, which is "
                f"{100.0 * (true - 1.0):.1f} % too much: they are {stated_mm / true:.2f} mm. Found: "
                f"{stated_mm / size.scale:.3f} mm ({100.0 * (size.scale - 1.0):.3f} % too much)."
            )
    for sensor, true_s in truth.time_offsets_s.items():
        if true_s != 0.0:
            deviation_s = np.sqrt(refined.covariance(Unknown(UnknownKind.TIME_OFFSET, sensor))[0, 0])
            sentences.append(
                f"The clock of {sensor} is {1e3 * true_s:.1f} ms off the robot's. Found: "
                f"{1e3 * refined.time_offsets_s[sensor]:.2f} ± {1e3 * deviation_s:.2f} ms."
            )
    pair = Pair(truth.twice_seen, truth.twice_seen_by)
    seen = sum(t.seen for t in log.detection.tracks if t.pair == pair)
    used = sum(t.used for t in log.outliers if t.pair == pair)
    sentences.append(
        f"A poster shows the tag of {pair.target} a second time, in {truth.twice_seen_in} images of {pair.sensor}. "
        f"Found: {seen - used} of {seen} detections of this tag by {pair.sensor} were left out."
    )
    return sentences


def truth_table(refined: RefinedPoses, truth: DemoTruth) -> FrameTable:
    """How far each frame is from where it truly is."""
    rows = {}
    for name, true in (truth.Y | truth.X).items():
        xi = error_of((refined.Y | refined.X)[name], true)
        inside = "inside" if refined.contains(name, true) else "outside"
        rows[name] = (f"{1e3 * np.linalg.norm(xi[3:]):.2f}", f"{np.degrees(np.linalg.norm(xi[:3])):.3f}", inside)
    return FrameTable("Found against true poses", "frame", ("off mm", "off°", "95 %"), rows)
