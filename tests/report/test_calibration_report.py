"""The report of one call: the verdict first, then how far off a point is, then the choices with their evidence."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
from refinement_problems import copied, rig
from rich.console import Console

import gtsam_rwhec as rw


def printed(calibration: rw.Calibration) -> str:
    stream = io.StringIO()
    console = Console(file=stream, width=200, color_system=None, highlight=False)
    rw.report.print_calibration(calibration, console, verbose=True)
    return stream.getvalue()


def test_the_first_screen_has_the_verdict_the_points_and_the_choices() -> None:
    calibration = rw.calibrate(rig().problem)
    text = printed(calibration)
    assert text.startswith(str(calibration.judgement))
    places = [text.index(words) for words in ("How far off a point is", "What was chosen, and why", "Poses", "Details")]
    assert places == sorted(places)
    for sentence in (*calibration.points.values(), *calibration.choices):
        assert f"  - {sentence}" in text
    assert len(text[: text.index("Poses\n")].splitlines()) <= 24


def test_a_misreading_is_said_first_and_there_are_no_covariances() -> None:
    calibration = rw.calibrate(copied(rig().problem, A=lambda pair, raw: np.linalg.inv(raw.A)))
    text = printed(calibration)
    assert text.startswith("Do not use these poses: ")
    assert str(calibration.misreadings[0]) in text
    assert "±x mm" not in text
    assert "How far off a point is" not in text
    assert "Not determined" not in text
    assert "turn the carriers" not in text


def test_too_few_measurements_are_said_once_for_all_directions() -> None:
    raw, few = rig(1, 1).problem.measurements("target0", "sensor0"), rw.Problem()
    few.add("target0", "sensor0", raw.A[:2], raw.B[:2])
    text = printed(rw.calibrate(few))
    assert text.count("Not determined") == 1
    assert " directions of sensor0, target0: no pair of these frames has more than two measurements" in text


def test_without_an_answer_the_reasons_stand_alone() -> None:
    calibration = rw.calibrate(rig().problem)
    text = printed(replace(calibration, solution=None, refined=None, X={}, Y={}))
    assert "What was chosen, and why" in text
    assert "Poses\n" not in text
