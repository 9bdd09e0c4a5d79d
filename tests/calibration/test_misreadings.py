"""Misreadings are named with their cures, and good problems are not accused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from misread_problems import KINDS, KINDS_OF_GRAPHS, Kind, misread
from rwhec_factors.se3 import expmap

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import misreadings
from gtsam_rwhec.calibration.other_readings import Mistake, shifted
from gtsam_rwhec.calibration.trial_fits import Sampled, fitted
from gtsam_rwhec.errors import OptionError, RwhecError
from gtsam_rwhec.simulate import Noise, general, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver.solution import Solution

NOISE = Noise(0.003, 0.5 / np.radians(0.3) ** 2)
#: One of each mistake; benchmarks/misreadings.py has all, on real and simulated rigs.
TRIED = [
    kind
    for kind in (*KINDS, *KINDS_OF_GRAPHS)
    if kind.name
    in (
        "xyzw of B",
        "A inverted",
        "B transposed",
        "A left-handed",
        "B in millimetres",
        "size wrong",
        "rows of B late",
        "roles exchanged",
    )
]


def solved(problem: rw.Problem) -> Solution | None:
    """The solution, or None where there is none."""
    try:
        return rw.solve(problem)
    except RwhecError:
        return None


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
@pytest.mark.parametrize("kind", TRIED, ids=lambda kind: kind.name)
def test_each_misreading_is_named_with_both_residuals_and_its_cure(kind: Kind) -> None:
    problem = misread(general(1, 2, seed=1, noise=NOISE, number_of_measurements=12).problem, kind)
    found = misreadings(problem, solved(problem))
    assert [one.mistake for one in found] == [kind.mistake]
    assert kind.words in str(found[0])
    assert found[0].cure in str(found[0])
    before, after = zip(found[0].rotation_deg, found[0].translation_mm, strict=True)
    assert after[0] == pytest.approx(0.3 * 1.54, rel=0.35)
    if "thousands" not in kind.name:
        assert after[1] == pytest.approx(3.0 * 1.54, rel=0.6)
    assert math.prod(before) > 10.0 * math.prod(after)


def test_a_good_problem_is_not_accused() -> None:
    problem = general(2, 2, seed=1, noise=NOISE, number_of_measurements=15).problem
    assert misreadings(problem, rw.solve(problem)) == ()


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_four_measurements_accuse_nothing() -> None:
    problem = misread(general(1, 1, seed=2, noise=NOISE, number_of_measurements=4).problem, KINDS[0])
    assert misreadings(problem, solved(problem)) == ()


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_rows_of_a_slow_path_with_stamps_are_a_matter_of_the_clock() -> None:
    """A path of twenty poses a second, with B one row late: a clock's offset with stamps, shifted rows without."""
    t = 0.05 * np.arange(121)
    path = expmap(np.stack([np.sin(f * t + f) for f in (1.0, 1.3, 0.7, 0.9, 1.2, 0.8)], axis=1))
    X, Y = random_poses(2, 1.0, np.random.default_rng(0))
    A, B = path[:-1], perturb(np.linalg.inv(Y) @ path[1:] @ X, Noise(1e-3, 1e5), 0)
    stamps = 50_000_000 * np.arange(120)
    found = []
    for stamps_ns in (stamps, None):
        problem = rw.Problem()
        problem.add("tag", "cam", A, B, 1e-3, 1e5, stamps_ns=stamps_ns)
        found.append([one.mistake for one in misreadings(problem, solved(problem))])
    assert found == [[], [Mistake.ROWS_SHIFTED]]


def test_a_shift_of_rows_leaves_nothing_of_pairs_that_are_seen_once() -> None:
    problem = general(3, 3, seed=1, noise=NOISE, number_of_measurements=1).problem
    sampled = Sampled.of(problem)
    assert sampled is not None
    assert sampled.by(shifted(1)) == {}
    assert fitted(problem, sampled.by(shifted(1))) is None


def test_a_wrong_progress_is_refused() -> None:
    problem = general(1, 1, seed=2, noise=NOISE).problem
    with pytest.raises(OptionError, match="progress"):
        misreadings(problem, None, progress=3)
