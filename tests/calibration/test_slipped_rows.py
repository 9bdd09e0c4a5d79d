"""Rows that slipped are found with their row, named and repaired; good rows, late clocks and loose mounts are not."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from rwhec_factors.se3 import expmap, inverse

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import is_plain
from gtsam_rwhec.calibration.other_readings import Mistake
from gtsam_rwhec.calibration.row_shifts import AS_GIVEN, SHIFTS, cheapest
from gtsam_rwhec.calibration.slipped_rows import Slips, slips_of, with_rows_shifted
from gtsam_rwhec.calibration.trial_fits import Sampled, residual_of, signal_of
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate.simulated_noise import random_poses

pytestmark = pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
X, Y = random_poses(2, 0.5, np.random.default_rng(7))


def stations(n: int, seed: int) -> Array:
    return expmap(np.random.default_rng(seed).normal(size=(n, 6)) * np.repeat([0.35, 0.15], 3))


def path(n: int, seed: int, late: float = 0.0) -> Array:
    """About 4 degrees from one row to the next; ``late`` rows later."""
    g = np.random.default_rng(seed)
    phase = (np.arange(n)[:, None] + late) * g.uniform(0.08, 0.14, 6) + g.uniform(0.0, 6.0, 6)
    return expmap(np.sin(phase) * np.repeat([0.6, 0.3], 3))


def measured(A: Array, seed: int, degrees: float = 0.2) -> Array:
    """B of the carriers' poses, with 0.2 degrees and 2 mm of noise."""
    noise = np.random.default_rng(seed + 100).normal(size=(len(A), 6)) * np.repeat([np.radians(degrees), 0.002], 3)
    return np.asarray(inverse(Y) @ A @ X @ expmap(noise))


def slipped(A: Array, lost: tuple[int, ...], seed: int = 0, *, of_A: bool = False) -> rw.Problem:
    """Poses A whose images ``lost`` (from zero) have no detection, paired by their order; ``of_A``: poses are lost."""
    first, second = A, measured(A, seed)
    if of_A:
        first = np.delete(first, lost, axis=0)
    else:
        second = np.delete(second, lost, axis=0)
    n = len(A) - len(lost)
    problem = rw.Problem()
    problem.add("tag", "cam", first[:n], second[:n])
    return problem


def found_in(problem: rw.Problem) -> Slips | None:
    """As ``misreadings`` asks for them."""
    solution, sampled = rw.solve(problem), Sampled.of(problem)
    assert sampled is not None
    residual = residual_of(problem, solution)
    assert residual is not None
    return slips_of(problem, solution, is_plain=is_plain(residual, signal_of(sampled.as_read())))


@pytest.mark.parametrize(
    ("A", "lost"),
    [
        (stations(18, 0), (9,)),
        (stations(60, 1), (20, 41)),
        (stations(60, 2), (53,)),  # late: half of the residuals are small
        (path(80, 3), (40,)),
        (path(80, 4), (11, 30, 62)),
    ],
    ids=["few stations", "two images", "late", "path", "three images"],
)
def test_the_rows_where_they_slip_are_found(A: Array, lost: tuple[int, ...]) -> None:
    slips = found_in(slipped(A, lost))
    assert slips is not None
    rows = [row - k + 1 for k, row in enumerate(lost)]
    assert [slip.from_row for slip in slips.slips] == rows
    assert [slip.shift for slip in slips.slips] == [1, 2, 3][: len(rows)]
    assert sum(slip.number for slip in slips.slips) == len(A) - len(lost) - rows[0] + 1
    assert all(slip.between[0] <= slip.from_row <= slip.between[1] for slip in slips.slips)


def test_a_pose_that_was_not_recorded_is_the_other_way_round() -> None:
    slips = found_in(slipped(stations(30, 5), (12,), of_A=True))
    assert slips is not None
    (slip,) = slips.slips
    assert slip.shift == -1
    assert slip.between[0] <= 13 <= slip.between[1]  # row 13 has no pose at all
    assert "belongs to the A that is 1 row earlier" in str(slip)


def test_a_slip_among_wrong_measurements() -> None:
    problem = slipped(stations(60, 6), (25,))
    raw = problem.measurements("tag", "cam")
    B = raw.B.copy()
    B[[3, 17, 33, 34, 51]] = random_poses(5, 1.0, np.random.default_rng(0))
    wrong = rw.Problem()
    wrong.add("tag", "cam", raw.A, B)
    slips = found_in(wrong)
    assert slips is not None
    assert [slip.from_row for slip in slips.slips] == [26]


@pytest.mark.parametrize("late", [0.0, 0.5, 0.9])
def test_good_rows_and_late_clocks_do_not_slip(late: float) -> None:
    for seed in range(3):
        problem = rw.Problem()
        problem.add("tag", "cam", path(80, seed), measured(path(80, seed, late), seed))
        assert found_in(problem) is None
    assert found_in(slipped(stations(20, 3), ())) is None


def test_a_loose_mount_does_not_slip() -> None:
    A = stations(40, 8)
    B = measured(A, 8)
    B[22:] = expmap(np.array([[0.05, 0.02, 0.0, 0.01, 0.0, 0.005]]))[0] @ B[22:]
    problem = rw.Problem()
    problem.add("tag", "cam", A, B)
    assert found_in(problem) is None


def test_it_is_named_and_repaired_on_request() -> None:
    problem = slipped(stations(24, 9), (10,))
    plain = rw.calibrate(problem)
    assert plain.verdict is rw.Verdict.DO_NOT_USE
    assert [one.mistake for one in plain.misreadings] == [Mistake.ROWS_SLIPPED]
    assert "from row 11 of tag-cam on, B belongs to the A that is 1 row later (13 rows)" in plain.verdict_reason
    assert "--repair" in plain.verdict_reason
    repaired = rw.calibrate(problem, rw.CalibrateOptions(repair=True))
    assert repaired.verdict is rw.Verdict.CARE
    assert rw.Ground.ROWS_REPAIRED in repaired.judgement.grounds
    assert (
        "12 rows were shifted and 1 left out, because rows slipped: from row 11 of tag-cam" in repaired.verdict_reason
    )
    np.testing.assert_allclose(repaired.X["tag"].matrix(), X, atol=0.01)
    np.testing.assert_allclose(repaired.Y["cam"].matrix(), Y, atol=0.01)


def test_where_nothing_slipped_the_choices_say_so() -> None:
    asked = rw.calibrate(slipped(stations(24, 9), ()), rw.CalibrateOptions(repair=True))
    assert [one.chosen for one in asked.choices if one.what == "rows of A and B"] == ["as they are"]
    assert rw.Ground.ROWS_REPAIRED not in asked.judgement.grounds


def test_rows_that_are_all_shifted_are_repaired_too() -> None:
    A = stations(25, 10)
    problem = rw.Problem()
    problem.add("tag", "cam", A[:-1], measured(A, 10)[1:])
    assert [one.mistake for one in rw.calibrate(problem).misreadings] == [Mistake.ROWS_SHIFTED]
    repaired = rw.calibrate(problem, rw.CalibrateOptions(repair=True))
    assert repaired.judgement.grounds == (rw.Ground.ROWS_REPAIRED,)
    np.testing.assert_allclose(repaired.Y["cam"].matrix(), Y, atol=0.01)


def test_rows_that_are_all_shifted_do_not_slip_where_the_carriers_stand_first() -> None:
    """Rows of a standstill agree with either shift: a real log's rows, all shifted by three, were said to slip."""
    A = path(60, 4)[np.maximum(np.arange(68) - 8, 0)]
    problem = rw.Problem()
    problem.add("tag", "cam", A[3:], measured(A, 4)[:-3])
    assert found_in(problem) is None
    assert [one.mistake for one in rw.calibrate(problem).misreadings] == [Mistake.ROWS_SHIFTED]


def test_the_option_changes_nothing_of_good_rows() -> None:
    problem = slipped(stations(20, 3), ())
    repaired = rw.calibrate(problem, rw.CalibrateOptions(repair=True))
    assert repaired.judgement == rw.calibrate(problem).judgement


@pytest.mark.parametrize("late", [0.0, 0.05])
def test_a_late_clock_is_no_size_and_a_size_no_late_clock(late: float) -> None:
    """Ten rows a second, with a clock that is said to be right: each of the two is named, and not the other one."""
    problem = rw.Problem()
    B = measured(path(150, 1, 10.0 * late), 1)
    B[:, :3, 3] *= 1.0 if late else 1.03
    problem.add("tag", "cam", path(150, 1), B, stamps_ns=np.arange(150) * 10**8)
    calibration = rw.calibrate(problem, rw.CalibrateOptions(time_offsets=False))
    ground = rw.Ground.LATE_CLOCK if late else rw.Ground.SIZE_DOUBTED
    assert calibration.judgement.grounds == (ground,)


def test_stamps_stay_with_B() -> None:
    A = stations(12, 11)
    problem = rw.Problem()
    problem.add("tag", "cam", A, measured(A, 11), stamps_ns=np.arange(12) * 10**9)
    shifted = with_rows_shifted(problem, {problem.pairs[0]: np.repeat([0, 1], 6)}).measurements("tag", "cam")
    np.testing.assert_array_equal(shifted.stamps_ns, np.arange(11) * 10**9)
    np.testing.assert_array_equal(shifted.A, np.delete(A, 6, axis=0))


def test_a_repair_without_a_search_is_refused() -> None:
    with pytest.raises(OptionError, match="repair=True needs"):
        rw.CalibrateOptions(repair=True, misreadings=False)


def test_the_cheapest_shifts_are_those_of_all_combinations() -> None:
    costs, price = np.random.default_rng(0).uniform(0.0, 4.0, (len(SHIFTS), 5)), 1.5
    states, total = cheapest(costs, price)
    sums = {
        tried: sum(costs[s, i] for i, s in enumerate(tried))
        + price * np.count_nonzero(np.diff(tried, prepend=AS_GIVEN))
        for tried in itertools.product(range(len(SHIFTS)), repeat=5)
    }
    best = min(sums, key=lambda tried: sums[tried])
    assert tuple(states) == best
    assert total == pytest.approx(sums[best])
