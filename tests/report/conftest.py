"""A calibration of a small rig from a program: its result, its evidence, and its page."""

from __future__ import annotations

from pathlib import Path

import pytest
from refinement_problems import rig

import gtsam_rwhec as rw
from gtsam_rwhec.report.report_page import read_shown
from gtsam_rwhec.report.shown_result import ShownResult


@pytest.fixture(scope="session")
def calibration() -> rw.Calibration:
    """Nothing speaks against it."""
    return rw.calibrate(rig().problem, rw.CalibrateOptions(sizes="known"))


@pytest.fixture(scope="session")
def folder(calibration: rw.Calibration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its files."""
    folder = tmp_path_factory.mktemp("report")
    rw.write_calibration(calibration, folder / "result.json")
    rw.results.write_evidence(rw.results.evidence_of(rig().problem, calibration), folder / "evidence.json")
    rw.report.write_html(folder, folder / "report.html")
    return folder


@pytest.fixture
def shown(folder: Path) -> ShownResult:
    """As its page shows it."""
    return read_shown(folder)
