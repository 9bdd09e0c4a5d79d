"""Grounds lead to verdicts, and a judgement says what to do."""

from __future__ import annotations

import json

import pytest

from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement, Verdict


@pytest.mark.parametrize("verdict", Verdict)
def test_a_verdict_is_a_sentence_and_a_word_in_files(verdict: Verdict) -> None:
    assert str(verdict) == f"{verdict}"
    assert str(verdict).startswith(verdict.words)
    assert str(verdict).endswith(".")
    assert Verdict(verdict.value) is verdict
    assert json.loads(json.dumps(verdict)) == verdict.value


@pytest.mark.parametrize("ground", Ground)
def test_every_ground_says_what_to_do(ground: Ground) -> None:
    judgement = Judgement.of([Finding(ground, "a fact")], "praise")
    assert judgement.verdict is ground.verdict
    assert str(judgement) == f"{ground.verdict.words}: a fact. What to do: {ground.advice}."
    assert not ground.advice.endswith(".")


def test_the_most_serious_ground_comes_first_and_decides() -> None:
    findings = [
        Finding(Ground.CORRELATED, "neighbours are alike"),
        Finding(Ground.CONTRADICTED, "cam_1 disagrees"),
        Finding(Ground.CONTRADICTED, "cam_2 disagrees"),
        Finding(Ground.CONTRADICTED, "cam_2 disagrees"),
        Finding(Ground.MISREAD, "the quaternions of B are x, y, z, w"),
    ]
    judgement = Judgement.of(findings, "praise")
    assert judgement.verdict is Verdict.DO_NOT_USE
    assert judgement.grounds == (Ground.MISREAD, Ground.CONTRADICTED)
    facts = "the quaternions of B are x, y, z, w; cam_1 disagrees; cam_2 disagrees"
    assert judgement.reason == f"{facts}. What to do: {Ground.MISREAD.advice}"


def test_where_all_grounds_ask_for_care_each_says_what_to_do() -> None:
    findings = [
        Finding(Ground.SYSTEMATIC, "errors vary"),
        Finding(Ground.CORRELATED, "neighbours are alike"),
        Finding(Ground.COVARIANCE_DOUBTED, "few measurements"),
    ]
    judgement = Judgement.of(findings, "praise")
    assert Ground.CORRELATED.advice == Ground.COVARIANCE_DOUBTED.advice  # is said once
    to_do = f"(1) {Ground.CORRELATED.advice}; (2) {Ground.SYSTEMATIC.advice}"
    assert judgement.reason == f"neighbours are alike; errors vary; few measurements. What to do: {to_do}"


def test_what_a_misreading_leaves_free_is_not_blamed_on_the_motion() -> None:
    free = Finding(Ground.NOT_UNIQUE, "the measurements do not determine all poses")
    misread = Finding(Ground.MISREAD, "A is inverted")
    assert Judgement.of([free, misread], "praise") == Judgement.of([misread], "praise")
    assert Judgement.of([free], "praise").grounds == (Ground.NOT_UNIQUE,)


@pytest.mark.parametrize("mistake", [Ground.MISREAD, Ground.IMPLAUSIBLE])
def test_what_a_misreading_makes_is_no_fact_of_its_own(mistake: Ground) -> None:
    made = [Ground.NOT_UNIQUE, Ground.NOT_CERTIFIED, Ground.NO_COVARIANCE, Ground.SYSTEMATIC]
    judgement = Judgement.of([*(Finding(ground, "made") for ground in made), Finding(mistake, "a fact")], "praise")
    assert judgement == Judgement.of([Finding(mistake, "a fact")], "praise")
    assert judgement.is_of_the_reading


@pytest.mark.parametrize("mistake", [Ground.SIZE_DOUBTED, Ground.CONTRADICTED, Ground.POSE_DOUBTED, Ground.LATE_CLOCK])
def test_errors_that_a_mistake_makes_are_not_blamed_on_the_arm(mistake: Ground) -> None:
    made = [Finding(Ground.SYSTEMATIC, "errors vary"), Finding(Ground.CORRELATED, "neighbours are alike")]
    judgement = Judgement.of([*made, Finding(mistake, "a fact")], "praise")
    assert judgement == Judgement.of([Finding(mistake, "a fact")], "praise")
    assert not judgement.is_of_the_reading


def test_poses_that_are_not_determined_are_too_few_once() -> None:
    few = [Finding(Ground.NOT_UNIQUE, "2 are too few"), Finding(Ground.NO_COVARIANCE, "2 are too few to tell")]
    assert Judgement.of(few, "praise") == Judgement.of(few[:1], "praise")


def test_one_wrong_size_is_not_cured_by_one_factor_of_all() -> None:
    assert "shared" not in Ground.SIZE_DOUBTED.advice


def test_without_findings_the_poses_are_to_be_used() -> None:
    judgement = Judgement.of([], "all is well")
    assert (judgement.verdict, judgement.grounds, str(judgement)) == (Verdict.USE, (), "Use these poses: all is well.")
