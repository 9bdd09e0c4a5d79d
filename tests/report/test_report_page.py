"""The report as one HTML page: every number is the JSON's, every name is text, and it needs no network."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from refinement_problems import rig
from shown_numbers import wrong_numbers

import gtsam_rwhec as rw
from gtsam_rwhec.report.figures import svg_figure
from gtsam_rwhec.report.html_page import page_html
from gtsam_rwhec.report.report_blocks import (
    Chart,
    CopyText,
    Drawing,
    Folded,
    Listing,
    Number,
    Page,
    Paragraph,
    Picture,
    Section,
    Table,
)


def test_a_number_that_is_not_that_of_the_json_is_found() -> None:
    number = Number("result.json#/cost", 2.0, 1e3, ".1f")
    page = page_html(Page("A page", "good", (Section("a", "A", (Paragraph(("costs ", number)),)),), "by hand"))
    assert list(wrong_numbers(page, {"result.json": {"cost": 2.0}})) == []
    assert list(wrong_numbers(page, {"result.json": {"cost": 2.5}})) != []
    assert list(wrong_numbers(page.replace("2000.0", "2001.0"), {"result.json": {"cost": 2.0}})) != []


def test_the_evidence_is_read_back(folder: Path) -> None:
    evidence = rw.results.read_evidence(folder / "evidence.json")
    rw.results.write_evidence(evidence, folder / "again.json")
    assert (folder / "again.json").read_bytes() == (folder / "evidence.json").read_bytes()


def test_evidence_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "evidence.json").write_text('{"format": "something else", "format_version": 1}')
    with pytest.raises(rw.errors.FileFormatError, match="is not the evidence of a calibration"):
        rw.results.read_evidence(tmp_path / "evidence.json")


def test_a_page_without_evidence_says_once_how_to_get_it(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "result.json").write_bytes((folder / "result.json").read_bytes())
    rw.report.write_html(tmp_path, tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text(encoding="utf-8").count("There is no evidence beside this result") == 1
    assert "There is no evidence beside" not in (folder / "report.html").read_text(encoding="utf-8")


def test_nothing_is_fetched(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    without_script = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', without_script) == []
    assert re.findall(r"url\((?!#)", without_script) == []  # figures have names inside of themselves


def test_every_block_is_shown_and_names_are_text() -> None:
    name = '<script>alert("x")</script>'
    svg = svg_figure(lambda figure: figure.subplots().set_title(name) and None)
    blocks = (
        Paragraph(name, "lead"),
        Listing((name, (name, Number("result.json#/a", 1.0)))),
        Table(name, (name, "number"), ((name, Number("result.json#/a", None)),), name),
        Chart("chart", name, name, svg),
        Picture("picture", name, name, b"\xff\xd8"),
        Drawing("drawing", name, name, ({"type": "scatter3d", "name": name},), {"title": name}, svg),
        CopyText("copy", name, name),
        Folded(name, (Paragraph(name),)),
    )
    page = page_html(Page(name, "bad", (Section("all", name, blocks), Section("none", "B", missing=name)), name))
    assert name not in page
    assert page.count("&lt;script&gt;alert") >= 14
    assert "currentColor" in page
    assert '"name": "\\u003cscript\\u003ealert' in page


@pytest.mark.usefixtures("without_figures")
def test_evidence_of_another_result_is_left_out_and_said(folder: Path, tmp_path: Path) -> None:
    result, beside = tmp_path / "result.json", tmp_path / "evidence.json"
    result.write_bytes((folder / "result.json").read_bytes())
    rw.results.write_evidence(rw.results.read_evidence(folder / "evidence.json"), beside, result)
    rw.report.write_html(tmp_path, tmp_path / "same.html")
    result.write_bytes(result.read_bytes() + b"\n")
    with pytest.warns(rw.errors.EvidenceWarning, match="is the evidence of another result"):
        rw.report.write_html(tmp_path, tmp_path / "other.html")
    beside.write_bytes(beside.read_bytes()[:100])
    with pytest.warns(rw.errors.EvidenceWarning, match="is not the evidence of a calibration"):
        rw.report.write_html(tmp_path, tmp_path / "damaged.html")
    same, other, damaged = (
        (tmp_path / f"{name}.html").read_text(encoding="utf-8") for name in ("same", "other", "damaged")
    )
    assert "Python" in same
    assert 'class="told care warning"' not in same
    assert "of another result" in other
    assert "is not the evidence of a calibration" in damaged
    assert "evidence.json#" not in other + damaged


def test_a_page_is_of_a_result_its_own_evidence_and_a_file_of_its_own(folder: Path, tmp_path: Path) -> None:
    problem = rig(1, 1).problem
    other = rw.calibrate(problem)
    page, own = tmp_path / "page.html", rw.results.evidence_of(problem, other)
    with pytest.raises(rw.errors.OptionError, match="evidence is of another calibration"):
        rw.report.write_html(folder / "result.json", page, own)
    for wrong in (5, "evidence.json"):
        with pytest.raises(rw.errors.OptionError, match=r"give what rw\.results\.evidence_of"):
            rw.report.write_html(other, page, wrong)  # type: ignore[arg-type]
    for wrong in (None, problem, b"result.json"):
        with pytest.raises(rw.errors.OptionError, match=r"give what rw\.calibrate returned"):
            rw.report.write_html(wrong, page)  # type: ignore[arg-type]
    with pytest.raises(rw.errors.FileFormatError, match="is not a path"):
        rw.report.write_html(other, page, own, figures=5)  # type: ignore[arg-type]
    with pytest.raises(rw.errors.FileFormatError, match="is read for the page"):
        rw.report.write_html(folder, folder / "evidence.json")
    assert not page.exists()


def test_a_result_that_is_larger_than_evidence_may_be_has_evidence(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gtsam_rwhec.results.evidence.MOST_BYTES", 10)  # a result of 300 frames has 112 MB
    rw.results.write_evidence(rw.results.Evidence(), tmp_path / "evidence.json", folder / "result.json")
    assert (tmp_path / "evidence.json").exists()
