"""Sizes that the motion contradicts are found in Python, by the rule of the log road; right sizes are not doubted."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.sizes import SIZE_SHARE, TargetSize, common_factor, is_size_doubted, sizes
from gtsam_rwhec.errors import MeasurementsNotKeptError, OptionError
from gtsam_rwhec.results.log_history import SizeFields
from gtsam_rwhec.simulate import Noise, general, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses

NOISE = Noise(0.003, 0.5 / np.radians(0.3) ** 2)


def with_wrong_size(factor: float, number_of_measurements: int = 40) -> rw.Problem:
    """Two targets, of which the first was stated too large by a factor."""
    exact = general(2, 1, seed=4, noise=NOISE, number_of_measurements=number_of_measurements).problem
    problem = rw.Problem()
    for pair in exact.pairs:
        raw = exact.measurements(*pair)
        B = raw.B.copy()
        B[:, :3, 3] *= factor if pair.target == "target0" else 1.0
        problem.add(*pair, raw.A, B)
    return problem


def test_a_wrong_size_is_doubted_and_the_right_one_is_not() -> None:
    wrong, right = sizes(with_wrong_size(1.03))
    assert wrong.is_doubted
    assert wrong.scale == pytest.approx(1.03, abs=0.005)
    assert "stated size of target0 is 3" in str(wrong)
    assert "% larger" in str(wrong)
    assert not right.is_doubted
    assert right.scale == pytest.approx(1.0, abs=0.005)


def test_a_wrong_size_among_pairs_that_were_added_at_once_is_doubted() -> None:
    """Their sums of B's rotations, which an unknown size needs, are not kept where sizes count as known."""
    apart, together = with_wrong_size(1.03, 200), rw.Problem()
    raw = [apart.measurements(*pair) for pair in apart.pairs]
    A, B = (np.concatenate([getattr(one, name) for one in raw]) for name in "AB")
    together.add_many(apart.pairs, np.repeat([0, 1], 200), A, B)
    one, other = (rw.calibrate(problem, rw.CalibrateOptions(sizes="check")) for problem in (apart, together))
    assert [size.target for size in other.sizes if size.is_doubted] == ["target0"]
    assert [size.scale for size in other.sizes] == pytest.approx([size.scale for size in one.sizes], rel=1e-9)


def test_right_sizes_are_not_doubted() -> None:
    assert [size.is_doubted for size in sizes(with_wrong_size(1.0))] == [False, False]


def board_of_another_size(factor: float, reach: float = 1.0, **kwargs: object) -> tuple[rw.Problem, np.ndarray]:
    """A board at 0.8 m whose stated size is so many times the true one, and the camera's true pose."""
    rng = np.random.default_rng(0)
    Y, X = random_poses(2, 0.1, rng)
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.4, (30, 3))).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    B = se3.pose(turns, [0.0, 0.0, 0.7] + reach * rng.uniform([-0.15, -0.15, -0.2], [0.15, 0.15, 0.2], (30, 3)))
    A = perturb(Y @ B @ np.linalg.inv(X), Noise(2e-4, 0.5 / np.radians(0.03) ** 2), rng)
    B = perturb(B, Noise(3e-4, 0.5 / np.radians(0.05) ** 2), rng)
    B[:, :3, 3] *= factor
    problem = rw.Problem()
    problem.add("board", "camera", A, B, **kwargs)
    return problem, Y


@pytest.mark.parametrize("noise", ["auto", "given"])
def test_a_size_that_is_wrong_by_less_than_is_doubted_is_in_the_ellipsoid(noise: str) -> None:
    """A board that was printed 0.3 % too large: 2.1 mm off where 0.7 mm were claimed, with 'use'."""
    variances = np.repeat([np.radians(0.05) ** 2 + np.radians(0.03) ** 2, 3e-4**2 + 2e-4**2], 3)
    stated = {"covariances": np.tile(np.diag(variances), (30, 1, 1))} if noise == "given" else {}
    problem, Y = board_of_another_size(1.003, **stated)
    found = rw.calibrate(problem, rw.CalibrateOptions(noise=noise))
    assert found.verdict is rw.Verdict.USE
    (size,) = found.sizes
    assert size.may_be_off
    assert not size.is_doubted
    off = se3.logmap((np.linalg.inv(Y) @ found.refined.Y["camera"].matrix())[None])[0]
    assert off @ np.linalg.solve(found.refined.covariance("camera"), off) < 16.8  # chi-square, 99 %
    assert 2.0 * np.sqrt(np.trace(found.refined.covariance("camera")[3:, 3:])) > np.linalg.norm(off[3:]) > 1.5e-3
    assert "may be wrong" in next(choice for choice in found.choices if choice.what == "sizes of targets").chosen


def test_a_size_that_the_motion_hardly_tells_asks_for_care_with_what_it_moves() -> None:
    """From one distance, a board printed 0.2 % too large was 1.6 mm off with "use", where 0.2 mm was claimed."""
    problem, _ = board_of_another_size(1.0, reach=0.05)
    found = rw.calibrate(problem)
    assert found.judgement.grounds == (rw.Ground.SIZE_UNTOLD,)
    assert "% only, and 0.2 %, as printers err, moves" in found.verdict_reason
    assert "(of clouds: a known length with the sensor)" in found.verdict_reason
    assert rw.calibrate(problem, rw.CalibrateOptions(sizes="known")).verdict is rw.Verdict.USE


def test_what_the_motion_says_of_a_printers_error_is_what_is_added() -> None:
    """At 1.8 deviations nothing was added, and a board that was 0.2 % too large was outside at chi2(6) 39 to 78."""
    right, speaking, sure = (TargetSize("tag", 1.0 + off, 0.0007).share_off for off in (0.0, 0.00125, 0.003))
    assert 0.0 < right < 0.0005 < 0.0008 < speaking < 0.00125 < 0.0025 < sure < 0.003
    assert TargetSize("tag", 1.0005, 0.01).share_off == pytest.approx(0.0014, rel=0.05)
    assert TargetSize("tag", 1.0005, None).share_off == 0.0


def test_all_sizes_are_estimated_where_that_is_asked_for() -> None:
    """It did nothing, in silence, where clocks are left to the data."""
    found = rw.calibrate(board_of_another_size(1.02)[0], rw.CalibrateOptions(sizes="estimate"))
    assert found.scale["board"] == pytest.approx(1.02, abs=0.002)
    moments = general(1, 1, seed=4, noise=NOISE, keep_measurements=False).problem
    with pytest.raises(MeasurementsNotKeptError, match='sizes="estimate"'):
        rw.calibrate(moments, rw.CalibrateOptions(sizes="estimate"))


def test_the_log_road_has_the_same_rule() -> None:
    for scale, sigma in ((1.02, 0.003), (1.02, 0.005), (1.0 + 0.9 * SIZE_SHARE, 1e-5), (0.98, 0.003), (1.5, None)):
        of_a_log = SizeFields(target="tag", stated_m=0.1, scale=scale, sigma=sigma, is_free=False)
        assert of_a_log.is_doubted is TargetSize("tag", scale, sigma).is_doubted is is_size_doubted(scale, sigma)


def test_sizes_that_are_not_said_to_be_known_are_not_looked_at() -> None:
    assert sizes(general(1, 1, seed=0, noise=NOISE, scale="shared").problem) == ()
    assert sizes(general(1, 1, seed=0, noise=NOISE, keep_measurements=False).problem) == ()


def test_what_is_no_problem_is_refused() -> None:
    with pytest.raises(OptionError, match=r"give a gtsam_rwhec\.Problem"):
        sizes("folder")  # type: ignore[arg-type]


def test_a_size_that_is_off_by_one_percent_is_doubted() -> None:
    """80 measurements of each with 3 mm tell a size to 0.2 %; leaving out blocks of rows told it to 0.4 % only."""
    wrong, right = sizes(with_wrong_size(1.012, number_of_measurements=80))
    assert wrong.sigma is not None
    assert wrong.sigma < 0.0025
    assert wrong.is_doubted or wrong.is_uncertain
    assert not right.is_doubted
    assert not right.is_uncertain


def test_a_size_between_the_limits_is_uncertain() -> None:
    uncertain = TargetSize("tag", 1.01, 0.01 / 4.0)
    assert uncertain.is_uncertain
    assert not uncertain.is_doubted
    assert not TargetSize("tag", 1.01, 0.01 / 3.0).is_uncertain
    assert not TargetSize("tag", 1.01, 0.01 / 6.0).is_uncertain
    assert not TargetSize("tag", 1.0 + 0.9 * SIZE_SHARE, 1e-4).is_uncertain


def test_an_uncertain_size_asks_for_care(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gtsam_rwhec.calibration.sizes.SIZE_SIGMAS", 1e6)
    calibration = rw.calibrate(with_wrong_size(1.03))
    assert calibration.verdict is rw.Verdict.CARE
    assert rw.Ground.SIZE_UNCERTAIN in calibration.judgement.grounds
    assert "target0 is 3" in calibration.verdict_reason


def test_sizes_that_are_off_by_one_factor_are_said_together() -> None:
    """Some of them may be known too little to be doubted alone."""
    common = common_factor([TargetSize("a", 1.05, 0.002), TargetSize("b", 1.047, 0.02), TargetSize("c", 1.0, None)])
    assert common.startswith("the stated sizes of all 2 targets are 5 % larger than the motion says ")
    assert not common_factor([TargetSize("a", 1.05, 0.002), TargetSize("b", 1.0, 0.002)])
    assert not common_factor([TargetSize("a", 1.001, 0.0001), TargetSize("b", 1.001, 0.0001)])
    assert not common_factor([TargetSize("a", 1.05, 0.002)])
    assert not common_factor([TargetSize("a", 1.05, 0.002), TargetSize("b", 1.0, 0.05)])  # b says nothing


def test_lengths_that_run_away_are_no_sizes() -> None:
    """Where motion tells no size the scale may run to 1e14, which ended in a LinAlgError of LAPACK."""
    assert sizes(with_wrong_size(1e6)) == ()
