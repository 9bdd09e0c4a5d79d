"""Whether an old calibration still holds on a new log: knocked cameras, moved boards, short logs, gross errors."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from refinement_problems import copied
from rwhec_factors.se3 import expmap
from two_logs import X, Y, calibrated, log_of

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CountError, FrameError, OptionError, UnderdeterminedError
from gtsam_rwhec.results.near_answer import without_gross_errors
from gtsam_rwhec.results.result_file import Result
from gtsam_rwhec.simulate.simulated_rigs import Motion


def verified(
    old: rw.Calibration | Result, problem: rw.Problem, *, systematic: bool = False, **options: Any
) -> rw.results.Verification:
    """These carriers are no arms; without errors of the configuration it is quick."""
    return rw.results.verify(old, problem, systematic=systematic, **options)


@pytest.fixture(scope="module")
def old() -> rw.Calibration:
    return calibrated(log_of(0))


def test_it_holds_where_nothing_moved(old: rw.Calibration) -> None:
    found = verified(old, log_of(1))
    assert found.holds
    assert str(found).startswith("The calibration still holds at 1 %: ")
    assert found.sensors["left"].held.translation_rms_mm == pytest.approx(np.sqrt(3.0), rel=0.3)  # 1 mm an axis
    assert found.sensors["left"].noise_ratio == pytest.approx(1.0, abs=0.3)


def test_its_estimate_is_that_of_a_new_calibration(old: rw.Calibration) -> None:
    """One local step under the new log's noise is nearly the answer of all stages, with nearly its covariance."""
    found = verified(old, log_of(2, knocked="left"), systematic=True)
    new = rw.calibrate(log_of(2, knocked="left"), rw.CalibrateOptions(robust="none", misreadings=False, sizes="known"))
    difference = rw.results.difference(old, new)
    assert found.test.dimension == 24
    assert found.movements["left"].xi == pytest.approx(difference.movements["left"].xi, abs=2e-4)
    assert difference.test is not None
    assert found.test.deviations == pytest.approx(difference.test.deviations, rel=0.15)


def test_the_camera_that_was_knocked_is_named(old: rw.Calibration) -> None:
    found = verified(old, log_of(2, knocked="left"))
    assert not found.holds
    assert found.test.changed == ("left",)
    assert str(found).startswith("The calibration no longer holds: left moved ")
    left, right = (found.sensors[name] for name in ("left", "right"))
    assert left.held.translation_rms_mm > 3.0 * left.best.translation_rms_mm
    assert right.held.translation_rms_mm < 1.3 * right.best.translation_rms_mm


def test_a_board_that_was_moved_is_named_unless_it_may_move(old: rw.Calibration) -> None:
    log = log_of(2, knocked="board")
    assert verified(old, log).test.changed == ("board",)
    sensors_alone = verified(old, log, targets_may_move=True)
    assert sensors_alone.holds
    assert sensors_alone.test.dimension == 12
    assert "the targets may stand elsewhere than before: their poses are not tested" in sensors_alone.remarks


def test_a_camera_that_the_new_log_lacks_is_named(old: rw.Calibration) -> None:
    found = verified(old, log_of(1, sensors=("left",)))
    assert found.holds
    assert found.unchecked_sensors == ("right",)
    assert str(found).endswith("Not checked: right.")


def test_what_the_new_log_leaves_free_is_not_tested(old: rw.Calibration) -> None:
    found = verified(old, log_of(3, motion=Motion("planar")))
    assert found.holds
    assert found.test.dimension == 23
    assert found.remarks[0].startswith("the new log leaves free: translation of ")


def test_gross_errors_do_not_count(old: rw.Calibration) -> None:
    wrong = expmap(np.random.default_rng(0).normal(0.0, 0.3, (3, 6)))
    problem = copied(log_of(1), B=lambda pair, one: np.concatenate([one.B[:3] @ wrong, one.B[3:]]))
    assert old.refined is not None
    for mask in without_gross_errors(old.refined, problem).values():
        assert not mask[:3].any()
        assert mask[3:].all()
    found = verified(old, problem)
    assert found.holds
    assert found.sensors["left"].outliers == 6


def test_a_camera_that_was_turned_round_is_named(old: rw.Calibration) -> None:
    """So far off that from the old poses on its residuals look as if nothing were determined."""
    round_about = expmap(np.array([[2.5, 0.0, 0.0, 0.0, 3.0, 0.0]]))[0]
    turned = copied(log_of(1), B=lambda pair, one: round_about @ one.B if pair.sensor == "left" else one.B)
    found = verified(old, turned)
    assert found.test is not None
    assert found.test.changed == ("left",)
    assert found.movements["left"].rotation_deg == pytest.approx(np.degrees(2.5), abs=0.5)


def test_measurements_that_fit_nothing_are_no_verification(old: rw.Calibration) -> None:
    log, chance = log_of(1), np.random.default_rng(0)
    garbage = rw.Problem()
    for pair in log.pairs:
        garbage.add(*pair, *expmap(chance.standard_normal((40, 6))).reshape(2, 20, 4, 4))
    found = verified(old, garbage)
    assert not found.holds
    assert found.test is None
    assert str(found).startswith("The calibration no longer holds: what left sees is ")
    assert "Check also that A and B are read as before." in str(found)


def test_a_log_that_is_too_short_is_refused_in_words(old: rw.Calibration) -> None:
    with pytest.raises((CountError, UnderdeterminedError), match="measure"):
        verified(old, log_of(1, count=1))


def test_frames_that_are_not_of_the_calibration_are_refused(old: rw.Calibration) -> None:
    other = rw.simulate.general(1, 1, seed=0).problem
    with pytest.raises(FrameError, match="no target and sensor of one pair are in both"):
        verified(old, other)


def test_an_answer_without_covariances_cannot_be_tested(old: rw.Calibration) -> None:
    assert old.solution is not None
    with pytest.raises(UnderdeterminedError, match="no covariances"):
        verified(Result(old.solution, None, None), log_of(1))


def test_what_is_no_problem_is_refused(old: rw.Calibration) -> None:
    with pytest.raises(OptionError, match="the problem is a str"):
        verified(old, "log.mcap")  # type: ignore[arg-type]


def test_sizes_that_were_estimated_stay_as_they_were_found() -> None:
    """A board that is 2 % too large in the rig file: its scale is an unknown of the old answer, and of the new log."""

    def with_sizes(seed: int) -> rw.Problem:
        log, problem = log_of(seed), rw.Problem("per_target")
        for pair in log.pairs:
            one = log.measurements(*pair)
            B = one.B.copy()
            B[:, :3, 3] *= 1.02 if pair.target == "board" else 1.0
            problem.add(*pair, one.A, B, one.sigma, one.kappa, stamps_ns=one.stamps_ns)
        problem.fix_scale("tag")
        return problem

    sized = calibrated(with_sizes(0))
    found = verified(sized, with_sizes(1))
    assert found.holds
    assert "scale:board" in found.test.groups
    assert found.test.dimension == 25


def test_fixed_frames_stay_fixed(old: rw.Calibration) -> None:
    def known(seed: int) -> rw.Problem:
        problem = log_of(seed)
        problem.fix("board", X["board"])
        return problem

    found = verified(calibrated(known(0)), known(1))
    assert found.holds
    assert found.not_checked == {"board": "its pose was given as known, in both"}
    assert dataclasses.is_dataclass(found)
    assert set(found.movements) == set(X) | set(Y)
