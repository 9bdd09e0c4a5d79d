"""Causes and paths: facts, and their words."""

from __future__ import annotations

import pytest

from gtsam_rwhec.solver import Cause, Multipliers, SearchPath, Start, Status

FIGURES = {
    "cost": 2.0,
    "free_directions": 3.0,
    "mirror_cost": 1.0,
    "frames": 130.0,
    "max_dense_frames": 120.0,
    "relaxed": 12.0,
    "relaxation_cost": 1.5,
    "better_cost": 1.0,
}


@pytest.mark.parametrize("cause", list(Cause))
def test_every_cause_has_a_sentence_and_a_status(cause: Cause) -> None:
    said = cause.sentence(FIGURES)
    assert said
    assert not set(said) & set("{}")
    assert cause.status in Status
    assert Cause(str(cause)) is cause


def test_the_three_reasons_of_design_fact_4_are_three_causes() -> None:
    redundant, local, not_tight = (
        Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS,
        Cause.PROVEN_AFTER_LOCAL_MINIMUM,
        Cause.NOT_TIGHT,
    )
    assert [cause.status for cause in (redundant, local, not_tight)] == [Status.CERTIFIED, Status.CERTIFIED, Status.GAP]


def test_a_path_says_how_the_answer_was_found_and_its_bound_proven() -> None:
    path = SearchPath(Start.SPECTRAL, Multipliers.KKT)
    assert path.words == "found from a spectral start, bound proven by dual multipliers"
    assert str(SearchPath(Start.SPECTRAL, Multipliers.KKT, is_mirrored=True)) == "spectral start, dual, mirrored"
