"""The command ``fleet run``, and what it prints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from test_fleet_rows import row
from typer.testing import CliRunner

import gtsam_rwhec as rw
from gtsam_rwhec import fleet
from gtsam_rwhec.cli.app import app
from gtsam_rwhec.fleet.fleet_report import failures_of, summary, worst_first


def rows() -> list[fleet.RobotRow]:
    fine = replace(row(), unit="b", robot="b", site=None, verdict=rw.Verdict.USE, failed_logs=(), covariance=np.eye(6))
    bad = replace(fine, unit="c", robot="c", verdict=rw.Verdict.DO_NOT_USE)
    return [
        fine,
        replace(fine, unit="d", covariance=2.0 * np.eye(6)),
        row(),
        bad,
        fleet.RobotRow("e", "e", failure="no"),
    ]


def test_verdicts_first_then_the_worst_then_failures() -> None:
    assert summary(rows()) == (
        "5 calibrations: 2 may be used, 1 to be used with care, 1 not to be used, 1 failed. 1 log could not be used."
    )
    assert [one.unit for one in worst_first(rows())] == ["c", "a@2026-11-22", "d", "b"]
    assert failures_of(rows()) == ["e: no", "a@2026-11-22, a, s3://logs/ä.mcap: it is empty"]
    assert summary([]) == "0 calibrations: none."


def test_the_command_and_its_exit_status(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text("rig: rig.yaml\nrobots: {a: none.mcap}\n")
    run = CliRunner().invoke
    lacking = run(app, ["fleet", "run", str(tmp_path / "fleet.yaml"), "-o", str(tmp_path / "out")])
    assert lacking.exit_code == 2
    assert "rig.yaml" in lacking.stderr
    (tmp_path / "rig.yaml").write_text(
        "carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}\nsensors: {cam: {detections: /tags}}\n"
        "targets: {tag: {type: tag, family: tag36h11, id: 0, size_m: 0.1}}\n"
    )
    failed = run(app, ["fleet", "run", str(tmp_path / "fleet.yaml"), "-o", str(tmp_path / "out")])
    assert failed.exit_code == 1
    assert failed.stdout.startswith("1 calibration: 1 failed. 1 log could not be used.")
    assert "What failed\n  - a: no calibration from " in failed.stdout
    assert "Nothing new was computed; 0 files were there already." in failed.stdout
    assert (tmp_path / "out" / "fleet.json").is_file()
    for arguments, words in (
        ([f"{tmp_path}/*.mcap"], "needs --rig"),
        ([str(tmp_path / "fleet.yaml"), "--rig", "x"], "goes with a pattern"),
        ([f"{tmp_path}/*.mcap", "--rig", "x"], "no log matches"),
        ([str(tmp_path / "fleet.yaml"), "--memory-per-worker", "lots"], "is no size of memory"),
    ):
        refused = run(app, ["fleet", "run", *arguments, "-o", str(tmp_path / "out")])
        assert refused.exit_code == 2
        assert words in " ".join(refused.stderr.replace("│", " ").split())
