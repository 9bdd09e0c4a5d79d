"""Grounds lead to verdicts, which say what to do and how carriers turned, and do not hang on the last digit."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from board_by_camera import problem_of
from rwhec_factors import se3
from rwhec_factors.se3 import expmap, inverse

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.stages import turning_of
from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement, Verdict
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.directions import SLID
from gtsam_rwhec.simulate.simulated_noise import random_poses


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


COUNT = 24
NOISE = np.repeat([2e-4, 1e-4], 3)


def calibrated(turns_deg: tuple[float, float, float], ways_m: tuple[float, float, float]) -> rw.Calibration:
    """A camera on a hand that turns and moves by these standard deviations, along axes that are askew in its frame."""
    rng = np.random.default_rng(7)
    xi = rng.normal(size=(COUNT, 6)) * np.r_[np.radians(turns_deg), ways_m]
    askew, X, Y = random_poses(3, 0.4, rng)
    turned = expmap(np.pad(xi[:, :3], ((0, 0), (0, 3))))
    turned[:, :3, 3] = xi[:, 3:]
    A = askew @ turned @ inverse(askew[None])
    B = inverse(Y[None]) @ A @ X @ expmap(NOISE * rng.standard_normal((COUNT, 6)))
    return rw.calibrate(problem_of(A, B))


@pytest.mark.parametrize(
    ("turns_deg", "ways_m", "ground", "words"),
    [
        ((0.0, 0.0, 30.0), (0.1, 0.1, 0.1), rw.Ground.NOT_UNIQUE, "motion about one axis only"),
        ((0.0, 0.0, 30.0), (0.1, 0.1, 0.0), rw.Ground.NOT_UNIQUE, "planar motion"),
        ((0.0, 0.0, 0.0), (0.1, 0.1, 0.1), rw.Ground.NOT_UNIQUE, "too little rotation"),
        ((1.0, 1.0, 1.0), (0.1, 0.1, 0.1), rw.Ground.LITTLE_ROTATION, "too little rotation"),
        ((1.0, 1.0, 30.0), (0.1, 0.1, 0.1), rw.Ground.LITTLE_ROTATION, "about one axis and"),
    ],
)
def test_the_verdict_says_how_the_carriers_turned(
    turns_deg: tuple[float, float, float], ways_m: tuple[float, float, float], ground: rw.Ground, words: str
) -> None:
    judgement = calibrated(turns_deg, ways_m).judgement
    assert judgement.grounds == (ground,)
    assert words in judgement.reason


def test_a_thing_that_slides_does_not_hide_that_the_carriers_hardly_turned() -> None:
    """A cylinder from one direction was of use, with the sensor 46 mm off."""
    rng = np.random.default_rng(3)
    X, Y = random_poses(2, 0.4, rng)
    A = expmap(rng.normal(size=(COUNT, 6)) * np.repeat([np.radians(1.0), 0.1], 3))
    of_ball = np.diag(np.r_[np.full(3, SLID), NOISE[3:] ** 2])
    problem = rw.Problem()
    B = inverse(Y[None]) @ A @ X @ expmap(np.r_[0.0, 0.0, 0.0, NOISE[3:]] * rng.standard_normal((COUNT, 6)))
    problem.add("ball", "camera", A, B, covariances=np.tile(of_ball, (COUNT, 1, 1)), directional=True)
    assert rw.Ground.LITTLE_ROTATION in rw.calibrate(problem).judgement.grounds


def test_a_good_motion_is_not_accused() -> None:
    assert calibrated((15.0, 12.0, 20.0), (0.1, 0.1, 0.1)).verdict is rw.Verdict.USE


def test_the_spread_of_turns_is_that_about_the_mean_and_the_motion_along_the_axis_is_told() -> None:
    angles = np.radians([-40.0, -10.0, 20.0, 50.0])
    xi: Array = np.zeros((4, 6))
    xi[:, 2] = angles
    A = expmap(xi)
    A[:, 2, 3] = [0.0, 0.1, 0.0, 0.1]
    found = turning_of(A)
    assert found.spread_rad == pytest.approx([np.std(angles), 0.0, 0.0], abs=1e-6)
    assert (found.along_m, found.across_m) == pytest.approx((0.05, 0.0), abs=1e-9)


#: Relative size of the disturbance.
LAST_DIGITS = 1e-12


@dataclass(frozen=True)
class Case:
    """One pair's measurements, with the mistake of its kind."""

    A: Array
    B: Array
    stamps_ns: np.ndarray | None = None
    prior: Array | None = None

    @staticmethod
    def of(kind: str, seed: int) -> Case:
        rng = np.random.default_rng(seed)
        number = int(rng.integers(8, 31))
        t = np.sort(rng.uniform(0.0, 3.0, number))

        def hand(at: Array) -> Array:
            turns = [0.7 * np.sin(1.9 * at), 0.6 * np.cos(2.3 * at), 0.5 * np.sin(1.4 * at + 1.0)]
            places = [0.3 * np.sin(at), 0.2 * np.cos(1.3 * at), 0.3 * np.sin(2.1 * at)]
            return np.asarray(se3.expmap(np.stack([*turns, *places], axis=1)))

        X, Y = se3.expmap(rng.normal(scale=0.5, size=(2, 6)))
        late = 0.05 if kind == "late" else 0.0
        A, noise = hand(t), rng.normal(size=(number, 6)) * np.r_[np.full(3, 2e-3), np.full(3, 1e-3)]
        B = se3.inverse(Y) @ hand(t + late) @ X @ se3.expmap(noise)
        wrong = rng.random(number) < {"outliers": 0.15, "many outliers": 0.4}.get(kind, 0.0)
        B[wrong] = B[wrong] @ se3.expmap(rng.normal(scale=0.3, size=(int(wrong.sum()), 6)))
        if kind == "moved":
            B[number // 2 :] = B[number // 2 :] @ se3.expmap(np.array([[0.2, 0.1, 0.0, 0.05, 0.0, 0.02]]))
        if kind == "inverted":
            A = se3.inverse(A)
        if kind == "size":
            B[:, :3, 3] *= 1.03
        stamps = (1e9 * t).astype(np.int64) if kind in ("late", "moved") else None
        prior = X @ se3.expmap(np.full((1, 6), 0.05))[0] if kind == "wrong prior" else None
        return Case(A, B, stamps, prior)

    def problem(self, disturbed: Callable[[Array], Array]) -> rw.Problem:
        problem = rw.Problem("known")
        problem.add("board", "camera", disturbed(self.A), disturbed(self.B), stamps_ns=self.stamps_ns)
        if self.prior is not None:
            problem.add_prior("board", self.prior, 1e-3, 1e5)
        return problem


def facts(problem: rw.Problem) -> tuple[object, ...]:
    found = rw.calibrate(problem)
    return found.verdict, found.judgement.grounds, found.outliers.counts, [one.mistake for one in found.misreadings]


KINDS = ("good", "outliers", "many outliers", "moved", "inverted", "size", "late", "wrong prior")


def check(seeds: range) -> None:
    for kind in KINDS:
        for seed in seeds:
            case = Case.of(kind, seed)
            rng = np.random.default_rng(seed)

            def disturbed(T: Array, rng: np.random.Generator = rng) -> Array:
                changed = T.copy()
                changed[:, :3, 3] *= 1.0 + LAST_DIGITS * rng.uniform(-1.0, 1.0, (len(T), 3))
                changed[:, :3, :3] = T[:, :3, :3] @ se3.expmap(LAST_DIGITS * rng.normal(size=(len(T), 6)))[:, :3, :3]
                return changed

            assert facts(case.problem(disturbed)) == facts(case.problem(np.copy)), f"{kind}, seed {seed}"


def test_a_verdict_does_not_hang_on_the_last_digit() -> None:
    check(range(30, 31))


@pytest.mark.slow
def test_no_verdict_of_200_hangs_on_the_last_digit() -> None:
    check(range(25))
