"""``gtsam-rwhec report``: the page of a finished calibration, and what it says of files that are none."""

from __future__ import annotations

from pathlib import Path

import pytest
from given_commands import command
from refinement_problems import rig

import gtsam_rwhec as rw


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("result") / "result.json"
    rw.write_calibration(rw.calibrate(rig().problem), path)
    return path


def test_the_page_is_beside_the_result_of_a_file_or_a_folder(result: Path) -> None:
    for given in (result, result.parent):
        (result.parent / "report.html").unlink(missing_ok=True)
        status, said = command("report", given)
        assert status == 0
        assert "report.html" in said
        assert (result.parent / "report.html").stat().st_size > 1000


def test_sections_without_data_say_why(result: Path, tmp_path: Path) -> None:
    status, _ = command("report", result, "-o", tmp_path / "page.html")
    assert status == 0
    assert "Not shown: files, versions and options" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_file_that_is_no_result_is_refused_in_words(tmp_path: Path) -> None:
    (tmp_path / "notes.json").write_text("{}")
    status, said = command("report", tmp_path / "notes.json")
    assert status == 2
    assert "is not a result of gtsam-rwhec" in said


def test_a_folder_that_cannot_be_written_is_said_before_the_work(result: Path, tmp_path: Path) -> None:
    status, said = command("report", result, "-o", tmp_path / "none" / "page.html")
    assert status == 2
    assert "cannot be written: the folder" in said


def test_a_page_is_not_written_onto_the_result_or_its_evidence(result: Path) -> None:
    content = result.read_bytes()
    status, said = command("report", result.parent, "-o", result)
    assert (status, "the command reads it" in said) == (2, True)
    evidence = rw.results.evidence_path(result)
    rw.results.write_evidence(rw.results.Evidence(), evidence, result)
    assert command("report", result, "-o", evidence)[0] == 2
    assert command("diff", result, result, "-o", result)[0] == 2
    assert command("verify", result, result, "-o", result)[0] == 2
    assert result.read_bytes() == content
    assert rw.results.read_evidence(evidence).derived is None
    evidence.unlink()


def test_a_name_that_is_too_long_is_refused_in_words(result: Path, tmp_path: Path) -> None:
    status, said = command("report", result, "-o", tmp_path / f"{'a' * 300}.html")
    assert (status, "cannot be written: File name too long" in said.replace("\n", " ")) == (2, True)
