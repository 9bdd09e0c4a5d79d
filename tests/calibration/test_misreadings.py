"""Misreadings are named with their cures: units of angles, exchanged carriers, steps; good problems are not accused."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from board_by_camera import problem_of
from misread_problems import KINDS, KINDS_OF_GRAPHS, Kind, in_degrees, misread
from rwhec_factors import se3
from rwhec_factors.se3 import expmap, inverse, pose
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import Exchange, exchange_of, misreadings
from gtsam_rwhec.calibration.other_readings import (
    Mistake,
    readings_of_angles,
    shifted,
    stretched,
    stretched_euler,
    unwound,
)
from gtsam_rwhec.calibration.trial_fits import Sampled, fitted
from gtsam_rwhec.errors import OptionError, RwhecError
from gtsam_rwhec.geometry.poses import Array
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


GENERATOR = np.random.default_rng(0)
AXES = GENERATOR.normal(size=(30, 3))
VECTORS = AXES / np.linalg.norm(AXES, axis=1)[:, None] * GENERATOR.uniform(0.0, 3.0, (30, 1))
A = pose(Rotation.from_rotvec(VECTORS).as_matrix(), GENERATOR.normal(size=(30, 3)))
X, Y = pose(Rotation.random(2, random_state=1).as_matrix(), GENERATOR.normal(size=(2, 3)))
B = inverse(Y) @ A @ X


def test_rotation_vectors_that_were_divided_are_stretched() -> None:
    small = pose(Rotation.from_rotvec(np.radians(VECTORS)).as_matrix(), A[:, :3, 3])
    np.testing.assert_allclose(stretched(small), A, atol=1e-12)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))), ids=str)
def test_euler_angles_that_were_divided_are_stretched(order: tuple[int, int, int]) -> None:
    letters = "".join("XYZ"[axis] for axis in order)
    angles = Rotation.from_matrix(A[:, :3, :3]).as_euler(letters)
    small = pose(Rotation.from_euler(letters, np.radians(angles)).as_matrix(), A[:, :3, 3])
    np.testing.assert_allclose(stretched_euler(order)(small), A, atol=1e-12)


def test_rotation_vectors_in_degrees_are_unwound_by_the_other_side() -> None:
    noise = Noise(1e-3, 0.5 / np.radians(0.5) ** 2)
    np.testing.assert_allclose(unwound(in_degrees(A), perturb(B, noise, 0)), A, atol=1e-12)
    np.testing.assert_allclose(unwound(in_degrees(B), perturb(A, noise, 0)), B, atol=1e-12)


def test_few_measurements_are_left_as_they_are() -> None:
    wrong = in_degrees(A[:5])
    assert unwound(wrong, B[:5]) is wrong


def test_large_rotations_are_not_taken_for_divided_ones() -> None:
    assert [reading.likely for reading in readings_of_angles(A, B)] == [
        "the rotation vectors of A are in degrees, and were read as radians",
        "the rotation vectors of B are in degrees, and were read as radians",
    ]


def at_stations(number: int, *, exchanged: bool, seed: int = 0, turn: float = 1.0) -> rw.Problem:
    """A camera on a hand over a board: 0.1 degree and 1 mm, turned by up to a radian or so."""
    rng = np.random.default_rng(seed)
    X, Y = random_poses(2, 1.0, rng)
    A = se3.expmap(turn * rng.normal(size=(number, 6)) * np.repeat([1.0, 0.3], 3))
    B = np.linalg.inv(Y) @ A @ X @ se3.expmap(rng.normal(size=(number, 6)) * np.repeat([2e-3, 1e-3], 3))
    return problem_of(np.linalg.inv(A) if exchanged else A, B)


@pytest.mark.parametrize("number", [6, 12])
def test_an_exchange_is_named_and_what_is_right_is_not(number: int) -> None:
    for seed in range(5):
        found = exchange_of(at_stations(number, exchanged=True, seed=seed)).misreading
        assert found is not None
        assert found.likely.startswith("A is inverted")
        assert found.rotation_deg[1] < 0.3 < found.rotation_deg[0]
        assert exchange_of(at_stations(number, exchanged=False, seed=seed)) == Exchange()


def test_three_stations_do_not_tell() -> None:
    for exchanged in (False, True):
        assert exchange_of(at_stations(3, exchanged=exchanged)) == Exchange(is_open=True)


def test_without_a_motion_that_tells_nothing_is_said() -> None:
    """Of many stations that hardly move either reading fits: that the poses are not determined is said elsewhere."""
    assert exchange_of(at_stations(30, exchanged=True, turn=1e-4)) == Exchange()


STATIONS = 30
#: Of 0 to 11, the seeds of which "A and B are both inverted" fits far better than what was read.
LOOSE_AND_MISTAKEN = (2, 10)


def over_a_board(seed: int, *, slips: bool, inverted: bool = False) -> rw.Problem:
    """A camera on a hand at stations over a board (0.03 degrees, 0.3 mm); its mount slips by 4 degrees and 7 mm."""
    chance = np.random.default_rng(seed)
    n = STATIONS
    turn = chance.uniform(-0.5, 0.5, (n, 3))
    T_board_camera = np.tile(np.eye(4), (n, 1, 1))
    T_board_camera[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    T_board_camera[:, :3, 3] = -T_board_camera[:, :3, 2] * chance.uniform(0.45, 0.7, (n, 1))
    T_board_camera[:, :3, 3] += 0.03 * chance.normal(size=(n, 3))
    X, Y = np.eye(4), se3.expmap(np.array([[0.1, -0.05, 0.3, 0.03, 0.02, 0.06]]))[0]
    X[0, 3] = 0.5
    A = np.linalg.inv(X @ T_board_camera @ np.linalg.inv(Y))  # T_hand_base
    hangs = np.tile(Y, (n, 1, 1))
    if slips:
        hangs[n * 3 // 5 :] = Y @ se3.expmap(_step(chance)[None])[0]
    noise = se3.expmap(chance.normal(size=(n, 6)) * np.repeat([5e-4, 3e-4], 3))
    return problem_of(np.linalg.inv(A) if inverted else A, np.linalg.inv(hangs) @ A @ X @ noise)


def _step(chance: np.random.Generator) -> Array:
    step = chance.normal(size=6).reshape(2, 3)
    step *= np.array([[np.radians(4.0)], [0.007]]) / np.linalg.norm(step, axis=1, keepdims=True)
    return np.asarray(step.reshape(6))


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
@pytest.mark.parametrize("seed", LOOSE_AND_MISTAKEN)
def test_a_loose_mount_is_no_misreading(seed: int) -> None:
    """The inverse of A and B left a seventh of the residuals, and was named; a step leaves less than a hundredth."""
    calibration = rw.calibrate(over_a_board(seed, slips=True))
    assert calibration.misreadings == ()
    assert calibration.judgement.grounds[0] is rw.Ground.MOVED
    assert "camera was at two poses from measurement 19 on" in calibration.verdict_reason


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
@pytest.mark.parametrize("seed", range(3))
def test_inverted_poses_are_no_loose_mount(seed: int) -> None:
    problem = over_a_board(seed, slips=False, inverted=True)
    assert {one.mistake for one in misreadings(problem, rw.solve(problem))} == {Mistake.INVERTED}  # of A, or of B
    exchanged = exchange_of(problem).misreading
    assert exchanged is not None
    assert exchanged.likely.startswith("A is inverted")


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_of_inverted_poses_with_a_loose_mount_the_inversion_is_named() -> None:
    """Both are wrong: a step alone explains little, and is found once the poses are read right."""
    problem = over_a_board(2, slips=True, inverted=True)
    assert misreadings(problem, rw.solve(problem))[0].mistake is Mistake.INVERTED


@pytest.mark.parametrize("seed", range(3))
def test_good_poses_are_accused_of_neither(seed: int) -> None:
    calibration = rw.calibrate(over_a_board(seed, slips=False))
    assert calibration.misreadings == ()
    assert rw.Ground.MOVED not in calibration.judgement.grounds
