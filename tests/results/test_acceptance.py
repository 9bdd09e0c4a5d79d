"""``rw.accept``: what known points show of a calibration, in words, numbers and files."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom, t
from two_logs import KNOCKED, X, Y, calibrated, log_of

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CountError, FileFormatError, FrameError, OptionError, PoseError
from gtsam_rwhec.report.report_blocks import Paragraph
from gtsam_rwhec.report.report_page import read_shown
from gtsam_rwhec.report.verdict_section import verdict_section
from gtsam_rwhec.results import Answer, Result, Touches, Volume
from gtsam_rwhec.results.equivalence_test import TouchRows, VolumeTest, error_rows, fit_error, spread_directions
from gtsam_rwhec.simulate.simulated_rigs import Motion, carrier_poses

FloatArray = NDArray[np.float64]
NOISE_M = 1e-4
BOX, AWAY = np.array([0.4, 0.3, 0.2]), np.array([0.0, 0.0, 0.6])


@pytest.fixture(scope="module")
def calibration() -> rw.Calibration:
    return calibrated(log_of(0))


@pytest.fixture(scope="module")
def result(calibration: rw.Calibration) -> Result:
    assert calibration.solution is not None
    return Result(calibration.solution, calibration.refined, None)


def seen_points(count: int, seed: int = 0) -> FloatArray:
    """Points in front of the camera, (count, 3)."""
    return (np.random.default_rng([7, seed]).random((count, 3)) - 0.5) * BOX + AWAY


def touched(
    result: Result, seen: FloatArray, off_m: FloatArray | float = 0.0, noise_m: float = NOISE_M, seed: int = 0
) -> Touches:
    """The points as they are known, if predictions are off by ``off_m``."""
    T = result.solution.Y["left"].matrix() if result.refined is None else result.refined.Y["left"].matrix()
    noise = noise_m * np.random.default_rng([8, seed]).standard_normal(seen.shape)
    return Touches.of(seen, seen @ T[:3, :3].T + T[:3, 3] - off_m + noise)


def accepted(
    result: Result, touches: Touches | rw.Problem, limit_mm: float = 1.0, **options: Any
) -> rw.results.Acceptance:
    return rw.accept(result, touches, limit_mm=limit_mm, sensor="left", **options)


@pytest.mark.parametrize("count", [3, 5, 12])
def test_the_bound_is_the_largest_of_all_one_sided_t_bounds(count: int) -> None:
    """Over a dense grid of directions, with the covariance as a textbook has it."""
    generator = np.random.default_rng(count)
    points = (generator.random((count, 3)) - 0.5) * BOX
    corners_m = Volume.box(points.min(axis=0), points.max(axis=0)).corners_m
    rows, corners = (error_rows(each, np.zeros(3), 0.3, has_scale=False) for each in (points, corners_m))
    errors = 0.001 + 1e-4 * generator.standard_normal((count, 3))
    sight = np.tile([0.0, 0.0, 1.0], (count, 1))
    fit = fit_error(TouchRows(rows, 6, errors, sight), (1e-4, 3e-4))
    D = rows.reshape(-1, 6) / np.tile([1e-4, 1e-4, 3e-4], count)[:, None]
    d, *_ = np.linalg.lstsq(D, errors.ravel() / np.tile([1e-4, 1e-4, 3e-4], count), rcond=None)
    J = np.einsum("ja,vak->vjk", spread_directions(20_000), corners)
    deviations = np.sqrt(np.einsum("vjk,kl,vjl->vj", J, np.linalg.inv(D.T @ D), J))
    np.testing.assert_allclose(fit.estimate, d, rtol=1e-9)
    expected = (J @ d + t.ppf(0.95, np.inf) * deviations).max()
    assert VolumeTest(fit, corners, 0.95).upper()[0] == pytest.approx(expected, rel=1e-4)


def test_variances_of_both_directions_are_estimated_without_bias() -> None:
    """Over many sets of six touches, with noise three times as large along the line of sight."""
    generator = np.random.default_rng(0)
    points = (generator.random((6, 3)) - 0.5) * BOX
    rows = error_rows(points, np.zeros(3), 0.3, has_scale=False)
    sight = points + AWAY
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    found = []
    for _ in range(1000):
        noise = generator.standard_normal((6, 3))
        noise += 2.0 * np.einsum("ni,ni->n", noise, sight)[:, None] * sight
        found.append(fit_error(TouchRows(rows, 6, noise, sight)).variances)
    across, along = np.mean(found, axis=0)
    assert across == pytest.approx(1.0, abs=0.2)  # the least share of 0.1 is above 0
    assert along == pytest.approx(9.0, abs=0.8)


def test_a_calibration_that_is_off_by_the_limit_is_seldom_accepted(result: Result) -> None:
    """A rotation, whose worst corner decides: there the test has its full size."""
    seen = seen_points(5)
    at = touched(result, seen, noise_m=0.0).known_m
    volume = Volume.box(at.min(axis=0), at.max(axis=0))
    middle, omega = np.array(volume.centre_m), np.array([0.3, -0.5, 0.8])
    most = np.linalg.norm(np.cross(omega, volume.corners_m - middle), axis=1).max()
    off = np.cross(omega, at - middle) * 0.001 / most
    runs = 200
    answers = [
        accepted(result, touched(result, seen, off, 2e-5, seed), volume=volume, noise_mm=0.02).answer
        for seed in range(runs)
    ]
    number = answers.count(Answer.ACCEPTED)
    assert binom.cdf(number, runs, 0.05) < 0.999
    assert answers.count(Answer.REJECTED) < 0.05 * runs
    assert number > 0  # a test that accepts nothing would also keep its level


def test_a_good_calibration_is_accepted_and_the_bound_holds(result: Result) -> None:
    found = accepted(result, touched(result, seen_points(8)))
    assert found.answer is Answer.ACCEPTED
    assert found.lower_mm <= found.estimate_mm < found.upper_mm < 1.0
    assert str(found).startswith("Accepted: left is off by less than 1 mm with 95 %: by less than 0.")
    assert "in the box x " in str(found)
    assert found.more is None
    assert found.places_m == ()


def test_a_wrong_calibration_is_rejected(result: Result) -> None:
    found = accepted(result, touched(result, seen_points(8), off_m=np.array([0.002, 0.0, 0.0])))
    assert found.answer is Answer.REJECTED
    assert 1.0 < found.lower_mm < 2.0 < found.upper_mm
    assert str(found).startswith("Rejected: left is off by more than 1 mm with 95 %")


def test_it_says_how_many_more_touches_and_they_are_enough(result: Result) -> None:
    seen = seen_points(4)
    first = accepted(result, touched(result, seen, noise_m=2e-4), limit_mm=0.7)
    assert first.answer is Answer.NOT_YET
    assert first.more is not None
    assert f"Touch {first.more} more of the same kind" in str(first)
    runs = []
    for seed in range(20):
        more = seen_points(4 + first.more, seed)
        touches = touched(result, more, noise_m=2e-4, seed=seed)
        runs.append(accepted(result, touches, limit_mm=0.7, volume=first.volume).answer)
    assert runs.count(Answer.ACCEPTED) >= 14  # the chance is 80 % if the estimate, which is of four touches, is right
    corners = first.volume.corners_m
    assert all(np.abs(corners - place).max(axis=1).min() < 1e-12 for place in np.array(first.places_m))


def test_touches_at_the_proposed_places_tell_more_than_others(result: Result) -> None:
    """Three touches near one corner: three more at the proposed places halve the bound that others leave."""
    near = 0.3 * (seen_points(4) - AWAY) + (0.05, 0.05, 0.6)
    at = touched(result, seen_points(30), noise_m=0.0).known_m
    volume = Volume.box(at.min(axis=0), at.max(axis=0))
    first = accepted(result, touched(result, near), volume=volume, noise_mm=0.1, limit_mm=0.3)
    assert first.answer in (Answer.NOT_YET, Answer.NOT_DETERMINED)
    answer = result.refined
    assert answer is not None
    back = np.array([answer.Y["left"].transformTo(np.array(place)) for place in first.places_m])
    bounds = [
        accepted(result, touched(result, np.concatenate([near, more])), volume=volume, noise_mm=0.1).upper_mm
        for more in (back, near[: len(back)] + 0.001)
    ]
    assert bounds[0] < 0.5 * bounds[1]


def test_touches_on_a_line_do_not_determine_it_whatever_the_noise_is(result: Result) -> None:
    line = np.outer(np.linspace(-1.0, 1.0, 10), [0.1, 0.05, 0.08]) + AWAY
    for noise_m in (0.0, 1e-7, 1e-4, 1e-3):
        found = accepted(result, touched(result, line, noise_m=noise_m))
        assert found.answer is Answer.NOT_DETERMINED
        assert "touch points away from the line" in str(found)
        assert math.isinf(found.upper_mm)
    beside = touched(result, line, noise_m=0.0).known_m.mean(axis=0)
    assert accepted(result, touched(result, line), volume=Volume.ball(beside, 0.1)).answer is Answer.NOT_DETERMINED


@pytest.mark.parametrize(("count", "words"), [(1, "one touch cannot tell it"), (2, "two touches cannot tell it")])
def test_few_touches_do_not_determine_it(result: Result, count: int, words: str) -> None:
    found = accepted(result, touched(result, seen_points(count)))
    assert found.answer is Answer.NOT_DETERMINED
    assert words in str(found)


def test_touches_in_a_plane_are_told_and_say_less_of_points_above_it(result: Result) -> None:
    seen = seen_points(8) * (1.0, 1.0, 0.0) + AWAY
    touches = touched(result, seen)
    flat = accepted(result, touches)
    assert any("lie in a plane" in remark for remark in flat.remarks)
    middle = touches.known_m.mean(axis=0)
    near, far = (accepted(result, touches, volume=Volume.ball(middle, radius)) for radius in (0.1, 0.5))
    assert near.upper_mm < 0.5 * far.upper_mm


def test_touches_near_one_another_are_not_enough_for_a_large_volume(result: Result) -> None:
    seen = 0.02 * (seen_points(6) - AWAY) + AWAY
    touches = touched(result, seen)
    found = accepted(result, touches, volume=Volume.ball(touches.known_m.mean(axis=0), 0.3))
    assert found.answer is Answer.NOT_DETERMINED
    assert "too near to one another" in str(found)


def test_the_error_of_the_tool_tip_is_added(result: Result) -> None:
    touches = touched(result, seen_points(8))
    without, given = accepted(result, touches), accepted(result, touches, known_to_mm=0.5)
    assert given.upper_mm == pytest.approx(without.upper_mm + 0.5)
    assert accepted(result, touches, known_to_mm=1.0).answer is Answer.NOT_YET


def test_stated_noise_that_the_residuals_contradict_does_not_count(result: Result) -> None:
    touches = touched(result, seen_points(8), noise_m=5e-4)
    estimated, stated = accepted(result, touches), accepted(result, touches, noise_mm=0.1)
    assert stated.upper_mm == estimated.upper_mm
    assert stated.noise == "estimated"
    assert any("larger than the stated noise allows" in remark for remark in stated.remarks)


def test_a_touch_that_is_off_is_named(result: Result) -> None:
    touches = touched(result, seen_points(20))
    wrong = touches.known_m + np.where(np.arange(20)[:, None] == 6, 0.01, 0.0)
    found = accepted(result, Touches.of(touches.sensor_m, wrong))
    assert any(remark.startswith("touch 7 is ") for remark in found.remarks)


def test_an_unknown_scale_counts_as_an_error_too() -> None:
    """Lengths of the sensor that are 1 % too long are found, where a rigid motion would not show them."""
    problem = rw.Problem("shared")
    for pair in (log := log_of(0)).pairs:
        one = log.measurements(*pair)
        problem.add(*pair, one.A, one.B, 0.001, 1e5)
    answer = calibrated(problem)
    assert answer.solution is not None
    assert answer.refined is not None
    shared = Result(answer.solution, answer.refined, None)
    seen = seen_points(10)
    touches = touched(shared, seen)
    long = Touches.of(1.01 * float(np.asarray(answer.refined.scale)) * seen, touches.known_m)
    found = rw.accept(shared, long, limit_mm=20.0, sensor="left")
    assert found.scale_is_free
    lengths = np.linalg.norm(0.01 * (found.volume.corners_m - answer.refined.Y["left"].translation()), axis=1)
    assert found.estimate_mm == pytest.approx(1e3 * lengths.max(), rel=0.1)
    assert found.noise_mm[0] == pytest.approx(0.1, rel=0.5)


def test_points_of_the_other_carrier_are_brought_over(result: Result) -> None:
    """For a camera in the hand: the tip touches a point in the base's frame that the camera saw from another pose."""
    touches = touched(result, seen_points(6))
    A = carrier_poses(Motion("general"), 6, np.random.default_rng(0))
    there = np.einsum("nji,nj->ni", A[:, :3, :3], touches.known_m - A[:, :3, 3])
    found = accepted(result, Touches.of(touches.sensor_m, there, A))
    assert found.upper_mm == pytest.approx(accepted(result, touches).upper_mm, rel=1e-6)


def views(*, seed: int = 3, motion: Motion | None = None, is_off: bool = False, count: int = 30) -> rw.Problem:
    """Views of a board that no calibration has seen; its place is nowhere stated."""
    known = log_of(seed, count=count, motion=motion, knocked="left" if is_off else "")
    one = known.measurements("tag", "left")
    problem = rw.Problem()
    problem.add("new board", "left", one.A, one.B)
    return problem


def test_views_of_a_board_of_unknown_place_show_it_too(result: Result) -> None:
    found = accepted(result, views(), limit_mm=5.0)
    assert found.answer is Answer.ACCEPTED
    assert found.of == "views"
    assert found.noise_mm[0] == pytest.approx(1.0, rel=0.4)
    volume = Volume.ball(Y["left"][:3, 3], 0.1)
    knocked = accepted(result, views(is_off=True), limit_mm=5.0, volume=volume)
    moved = Y["left"] @ KNOCKED.matrix() @ np.linalg.inv(Y["left"])
    exact = np.linalg.norm((volume.corners_m @ moved[:3, :3].T + moved[:3, 3]) - volume.corners_m, axis=1).max()
    assert knocked.answer is Answer.REJECTED
    assert knocked.estimate_mm == pytest.approx(1e3 * exact, rel=0.15)


def test_views_without_turning_do_not_determine_it(result: Result) -> None:
    problem, T = views(), np.linalg.inv(X["tag"])
    one = problem.measurements("new board", "left")
    A = one.A.copy()
    A[:, :3, :3] = A[0, :3, :3]
    straight = rw.Problem()
    straight.add("new board", "left", A, np.linalg.inv(Y["left"]) @ A @ np.linalg.inv(T))
    found = accepted(result, straight, limit_mm=5.0)
    assert found.answer is Answer.NOT_DETERMINED
    assert "turned about two axes" in str(found)


def test_the_corners_of_a_ball_hold_it() -> None:
    corners = Volume.ball([1.0, 2.0, 3.0], 0.5).corners_m - (1.0, 2.0, 3.0)
    assert (spread_directions(20_000) @ corners.T).max(axis=1).min() >= 0.5
    assert np.linalg.norm(corners, axis=1).max() < 0.51


@pytest.mark.parametrize(
    ("error", "words", "options"),
    [
        (OptionError, "limit_mm=0", {"limit_mm": 0}),
        (OptionError, "known_to_mm=-1", {"known_to_mm": -1}),
        (OptionError, "noise_mm=", {"noise_mm": (0.1, 0.0)}),
        (OptionError, "level=1.0", {"level": 1.0}),
        (FrameError, "say which one", {"sensor": None}),
        (FrameError, "there is no sensor 'top'", {"sensor": "top"}),
    ],
)
def test_what_cannot_be_used_is_said(
    result: Result, error: type[Exception], words: str, options: dict[str, Any]
) -> None:
    with pytest.raises(error, match=words):
        rw.accept(result, touched(result, seen_points(4)), **{"limit_mm": 1.0, "sensor": "left"} | options)


def test_a_log_without_the_sensor_and_other_things_are_refused(result: Result) -> None:
    with pytest.raises(FrameError, match="nothing in the new measurements is seen by left"):
        accepted(result, log_of(1, sensors=("right",)))
    with pytest.raises(OptionError, match="measured is a list"):
        accepted(result, [1.0])  # type: ignore[arg-type]
    with pytest.raises(PoseError, match=r"shape \(3,\)"):
        Touches.of([0.0, 0.0, 1.0], [[0.0, 0.0, 1.0]])
    with pytest.raises(CountError, match="1, 2 rows"):
        Touches.of([[0.0, 0.0, 1.0]], [[0.0, 0.0, 1.0]] * 2)
    with pytest.raises(OptionError, match="negative length"):
        Volume.box([0.0, 0.0, 1.0], [1.0, 1.0, 0.0])
    with pytest.raises(OptionError, match="give a positive one"):
        Volume.ball([0.0, 0.0, 1.0], 0.0)


POINTS = "sensor_x_m,sensor_y_m,sensor_z_m,known_x_m,known_y_m,known_z_m"


def test_a_file_of_touches_is_read_by_its_header(tmp_path: Path) -> None:
    file = tmp_path / "touches.csv"
    file.write_text("known_x_m, known_y_m,known_z_m,sensor_x_m,sensor_y_m,sensor_z_m\n1,2,3,4,5,6\n\n7,8,9,1e-1,0,2\n")
    found = rw.results.read_touches(file)
    np.testing.assert_array_equal(found.known_m, [[1, 2, 3], [7, 8, 9]])
    np.testing.assert_array_equal(found.sensor_m, [[4, 5, 6], [0.1, 0, 2]])
    assert found.A is None
    file.write_text(f"{POINTS},A_qw,A_qx,A_qy,A_qz,A_x_m,A_y_m,A_z_m\n1,2,3,4,5,6,0,0,0,1,0.5,0,0\n")
    again = rw.results.read_touches(file)
    assert again.A is not None
    np.testing.assert_allclose(again.A[0], [[-1, 0, 0, 0.5], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-15)


def test_points_that_were_not_measured_or_do_not_belong_together_are_no_fault_of_the_calibration(
    result: Result,
) -> None:
    seen = seen_points(8)
    exact = accepted(result, touched(result, seen, noise_m=0.0))
    assert exact.answer is Answer.NOT_DETERMINED
    assert "they were computed and not measured" in str(exact)
    good = touched(result, seen)
    rows_off = accepted(result, Touches.of(good.sensor_m, np.roll(good.known_m, 1, axis=0)))
    assert rows_off.answer is not Answer.ACCEPTED
    assert any("do both points of each line belong together" in remark for remark in rows_off.remarks)
    assert not any("belong together" in remark for remark in accepted(result, good).remarks)
    with pytest.raises(PoseError, match="give metres, not millimetres"):
        Touches.of(1e3 * good.sensor_m, 1e3 * good.known_m)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty: give a header"),
        ("1,2,3,4,5,6\n", "line 1: the columns are"),
        (f"{POINTS}\n", "has no touches"),
        (f"{POINTS}\n1,2,3\n", "line 2: 3 fields in place of 6"),
        (f"{POINTS}\n1,2,3,4,5,6\n1,2,3,4,nan,6\n", "line 3: known_y_m is 'nan'"),
        (f"{POINTS}\n1,2,3,4,5,x\n", "line 2: known_z_m is 'x'"),
    ],
)
def test_a_wrong_file_of_touches_is_refused_with_the_line(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "touches.csv").write_text(text)
    with pytest.raises(FileFormatError, match=words):
        rw.results.read_touches(tmp_path / "touches.csv")


@pytest.fixture
def file(tmp_path: Path, calibration: rw.Calibration) -> Path:
    rw.write_calibration(calibration, tmp_path / "result.json")
    return tmp_path / "result.json"


def test_it_is_written_into_the_result_and_read_back(result: Result, file: Path) -> None:
    before = rw.results.read_result(file)
    evidence = rw.results.evidence_path(file)
    rw.results.write_evidence(rw.results.Evidence(), evidence, file)
    first = accepted(result, touched(result, seen_points(1)))
    second = accepted(result, touched(result, seen_points(8)))
    other = replace(first, sensor="right")
    for found in (first, other, second):
        rw.results.write_acceptance(found, file.parent)
    after = rw.results.read_result(file)
    assert after.acceptance == (other, second)
    assert json.loads(file.read_text())["format_version"] == 1
    assert json.loads(file.read_text())["acceptance"][1]["sentence"] == str(second)
    assert after.judgement == before.judgement
    assert rw.results.difference(before, after).is_same
    shown = read_shown(file)  # with its evidence, whose checksum is the new file's: pytest makes warnings errors
    assert any(isinstance(block, Paragraph) and block.words == str(second) for block in verdict_section(shown).blocks)


@pytest.mark.parametrize(
    ("place", "change", "words"),
    [
        ("answer", "rejected", "lead to 'accepted'"),
        ("upper_mm", 2.0, "lead to 'not_accepted_yet'"),
        ("upper_mm", None, "lead to 'not_determined'"),
        ("lower_mm", 5.0, "above upper_mm"),
        ("sensor", "top", "the sensors are left, right"),
        ("noise_mm", [-1.0, 1.0], "must not be negative"),
        ("count", 0, "test nothing"),
        ("more_than_that", 1, "more_than_that"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(
    result: Result, file: Path, place: str, change: object, words: str
) -> None:
    rw.results.write_acceptance(accepted(result, touched(result, seen_points(8))), file)
    tree = json.loads(file.read_text())
    tree["acceptance"][0][place] = change
    file.write_text(json.dumps(tree))
    with pytest.raises(FileFormatError, match=words):
        rw.results.read_result(file)


def test_one_sensor_is_there_once(result: Result, file: Path) -> None:
    rw.results.write_acceptance(accepted(result, touched(result, seen_points(8))), file)
    tree = json.loads(file.read_text())
    tree["acceptance"] *= 2
    file.write_text(json.dumps(tree))
    with pytest.raises(FileFormatError, match="left is there twice"):
        rw.results.read_result(file)
    del tree["acceptance"]
    file.write_text(json.dumps(tree))
    found = accepted(result, touched(result, seen_points(8)))
    with pytest.raises(FileFormatError, match="the sensors are left, right"):
        rw.results.write_acceptance(replace(found, sensor="top"), file)
    assert "acceptance" not in json.loads(file.read_text())
