"""The section of what was seen: every number is the JSON's, names are text, and images are there only if they may."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shown_numbers import numbers_of, wrong_numbers

import gtsam_rwhec as rw
from gtsam_rwhec.report.detections_section import empty_in_words, seen_section
from gtsam_rwhec.report.html_page import page_html
from gtsam_rwhec.report.report_blocks import Page, Section
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.detection_evidence import PIECES, RemovedCount, RemovedMeasurement, SeenEvidence, SeenTrack
from gtsam_rwhec.results.evidence import evidence_json
from gtsam_rwhec.results.image_errors import SeenCamera, WorstImage

NAME = "<b>cam</b>"
PICTURE = b"\xff\xd8 a picture"


def camera(cells: np.ndarray) -> SeenCamera:
    return SeenCamera(
        sensor=NAME, width=640, height=480, images=3, corners=int(cells.sum()), cells=tuple(map(tuple, cells.tolist())),
        share=float((cells > 0).mean()), rms_px=0.25, noise_px=0.1, at_optimum=True,
        x=(10.0, 20.0), y=(30.0, 40.0), dx=(0.1, -0.1), dy=(0.0, 0.3),
    )  # fmt: skip


def made_up() -> SeenEvidence:
    """A camera that saw nothing on its left, with removed measurements and a picture."""
    cells = np.ones((6, 8), dtype=int)
    cells[:, :4] = 0
    return SeenEvidence(
        span_s=12.5,
        pieces=PIECES,
        tracks=(
            SeenTrack(sensor=NAME, target="tag", used=7, removed=2, used_at=((0, 4), (9, 3)),
                      removed_at={"cleaning": ((3, 1),), "detection": ((PIECES - 1, 1),)}),
            SeenTrack(sensor=NAME, target="none", used=0, removed=150, used_at=(),
                      removed_at={"detection": tuple((i, 1) for i in range(150))}),
        ),
        used=7,
        removed=152,
        removed_counts=(
            RemovedCount(target="tag", sensor=NAME, stage="cleaning", reason="gap (s)", count=1),
            RemovedCount(target="tag", sensor=NAME, stage="detection", reason="blurred", count=1),
        ),
        removed_list=(
            RemovedMeasurement(target="tag", sensor=NAME, reason="gap (s)", image="<i>7</i>.png", time_s=0.094),
        ),
        cameras=(camera(cells),),
        worst=(
            WorstImage(target="tag", sensor=NAME, image="<i>9</i>.png", is_used=False, corners=4, rms_px=1.5,
                       largest_px=2.5, times_noise=15.0, magnified=20.0, picture=PICTURE),
        ),
        sheet=PICTURE,
    )  # fmt: skip


def page_of(shown: ShownResult, seen: SeenEvidence | None, *, images: bool = True) -> tuple[str, Section]:
    evidence = None if seen is None else rw.results.Evidence(seen=seen)
    section = seen_section(replace(shown, evidence=evidence, images=images))
    return page_html(Page("A page", "good", (section,), "a test")), section


def test_numbers_are_those_of_the_evidence_and_names_are_text(shown: ShownResult) -> None:
    page, _ = page_of(shown, made_up())
    files = {"evidence.json": json.loads(evidence_json(rw.results.Evidence(seen=made_up())))}
    assert len(numbers_of(page)) >= 10
    assert list(wrong_numbers(page, files)) == []
    assert NAME not in page
    assert "<i>" not in page
    assert "&lt;i&gt;9&lt;/i&gt;.png" in page
    assert "nothing was seen in the left half" in page
    assert "20 times as long. It was left out of the answer." in page
    assert page.count(base64.b64encode(PICTURE).decode()) == 2


def test_without_images_there_is_none_and_it_is_said(shown: ShownResult) -> None:
    page, _ = page_of(shown, made_up(), images=False)
    assert base64.b64encode(PICTURE).decode() not in page
    assert page.count("The page was made without images.") == 2
    assert "farthest off" in page


def test_pictures_come_through_the_file(tmp_path: Path) -> None:
    rw.results.write_evidence(rw.results.Evidence(seen=made_up()), tmp_path / "evidence.json")
    read = rw.results.read_evidence(tmp_path / "evidence.json").seen
    assert read == made_up()


def test_without_evidence_or_corners_it_is_said(shown: ShownResult) -> None:
    _, section = page_of(shown, None)
    assert section.missing
    few = made_up().model_copy(
        update={"span_s": None, "cameras": (), "worst": (), "sheet": None, "no_pictures": "there were none."}
    )
    page, section = page_of(shown, few)
    assert not section.missing
    assert "have no corners" in page
    assert "Not shown: the contact sheet. Why: there were none." in page
    assert "in which it was given" in page


def test_a_problem_without_images_has_its_measurements_in_the_figure(shown: ShownResult) -> None:
    assert shown.evidence is not None
    page, _ = page_of(shown, shown.evidence.seen)
    assert "80" in page
    assert "none was removed" in page
    assert 'id="figure-detections"' in page


@pytest.mark.parametrize(
    ("empty", "words"),
    [
        ((), "every part of its image has corners."),
        ((np.s_[:, :],), "no part of its image has corners."),
        ((np.s_[:3, :4],), "nothing was seen in the upper left quarter."),
        ((np.s_[3:, :],), "nothing was seen in the lower half."),
        ((np.s_[:, :1], np.s_[5:, :]), "nothing was seen along the left edge and along the lower edge."),
        ((np.s_[:3, 4:7],), "9 of 48 cells have no corner, none of them a whole side or quarter."),
        ((np.s_[:2, 4:], np.s_[2, 5:]), "hardly anything was seen in the upper right quarter."),
    ],
)
def test_parts_without_corners_in_words(empty: tuple[tuple[slice, slice], ...], words: str) -> None:
    cells = np.ones((6, 8), dtype=int)
    for part in empty:
        cells[part] = 0
    assert empty_in_words(cells.tolist()) == words
