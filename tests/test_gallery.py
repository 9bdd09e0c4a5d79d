"""Faults of the gallery, from rendered images to the words of the verdict; all of them in campaigns."""

from __future__ import annotations

import sys

import pytest
from places import REPOSITORY

sys.path.insert(0, str(REPOSITORY / "benchmarks"))
import gallery
import gallery_scene
from gallery_faults import FAULTS, Fault

BY_NAME = {fault.name: fault for fault in FAULTS}


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize(
    ("name", "images", "verdict", "words"),
    [("millimetres", 4, "refused", "Write length: mm"), ("upside_down", 8, "care", "1 of the 8 images of camera")],
)
def test_a_fault_is_named_with_its_cure(
    name: str, images: int, verdict: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gallery_scene, "IMAGES", images)
    found = gallery.run(BY_NAME[name], 5001, is_good=False)
    assert (found.verdict, found.named) == (verdict, True)
    assert words in found.said


def test_the_issues_fifteen_faults_are_there_each_with_words_and_a_cure() -> None:
    assert len(FAULTS) == len(BY_NAME) == 15
    assert all(fault.words and fault.cure and fault.done for fault in FAULTS)


@pytest.mark.campaign
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_each_fault_is_named_and_its_good_run_is_not_accused(fault: Fault) -> None:
    assert gallery.run(fault, 5101, is_good=False).named
    assert not gallery.run(fault, 5101, is_good=True).accused
