"""Refinement and calibration with points, planes and registrations that slide."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from mixed_sets import MOVE_M, TURN_RAD, mixed_set
from rwhec_factors import se3
from scipy.special import chdtri

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NotUniqueWarning, RwhecWarning
from gtsam_rwhec.solver.free_directions import FreeReason

KINDS = [("point_0",), ("plane_0",), ("tag_0", "point_1", "plane_2", "motions_3"), ("slide_0", "tag_1")]


def refined(problem: rw.Problem, **options: object) -> rw.Refined:
    with warnings.catch_warnings(action="ignore", category=NotUniqueWarning):
        return rw.refine(problem, rw.solve(problem), rw.RefineOptions(**options))  # type: ignore[arg-type]


def squared_error(answer: rw.Refined, truth: np.ndarray) -> float:
    xi = se3.logmap((np.linalg.inv(answer.Y["sensor"].matrix()) @ truth)[None])[0]
    return float(xi @ np.linalg.solve(answer.covariance("sensor"), xi))


@pytest.mark.parametrize("things", KINDS)
def test_the_refined_answer_is_the_certified_one_where_noise_is_given(things: tuple[str, ...]) -> None:
    of = mixed_set(1, things, scale="known")
    with warnings.catch_warnings(action="ignore", category=NotUniqueWarning):
        found = rw.solve(of.problem)
    answer = refined(of.problem, noise="given")
    assert answer.cost == pytest.approx(found.cost, rel=1e-3)  # chords are not angles
    off = se3.logmap((np.linalg.inv(answer.Y["sensor"].matrix()) @ found.Y["sensor"].matrix())[None])[0]
    assert np.abs(off / np.sqrt(np.diagonal(answer.covariance("sensor")))).max() < 0.1


@pytest.mark.parametrize("things", KINDS)
def test_ellipsoids_hold_the_truth(things: tuple[str, ...]) -> None:
    """24 sets: fewer than 19 of 95 % ellipsoids hold the truth once in 1,000 runs."""
    inside, squares = 0, []
    for seed in range(24):
        of = mixed_set(seed, things, count=20, scale="known")
        squares.append(squared_error(refined(of.problem, noise="given"), of.truth["sensor"]))
        inside += squares[-1] < chdtri(6, 0.05)
    assert inside >= 19
    assert 4.2 < np.mean(squares) < 8.2


def test_what_means_nothing_has_no_deviation() -> None:
    of = mixed_set(2, ("tag_0", "point_1", "plane_2"), scale="known")
    answer = refined(of.problem, noise="given")
    assert not answer.free_directions
    point, plane = (np.concatenate(answer.standard_deviations(name)) for name in ("point_1", "plane_2"))
    assert np.isinf(point).tolist() == [True] * 3 + [False] * 3
    assert np.isinf(plane).tolist() == [False, False, True, True, True, False]
    assert np.isfinite(np.concatenate(answer.standard_deviations("sensor"))).all()


@pytest.mark.parametrize("things", [("point_0",), ("plane_0", "tag_1"), ("slide_0", "point_1")])
def test_noise_is_estimated_from_what_is_measured(things: tuple[str, ...]) -> None:
    """Noise of half the stated size: the share of directions that mean nothing would make it smaller still."""
    sets = [mixed_set(seed, things, count=60, scale="known", noise=0.5) for seed in range(3)]
    found = [noise for of in sets for noise in refined(of.problem, noise="estimate").noise.values()]
    factors = np.mean([[noise.rotation_rad / TURN_RAD, noise.translation_m / MOVE_M] for noise in found], axis=0)
    if things != ("point_0",):
        assert 0.0 < factors[0] < 0.6
    if things == ("point_0",):
        assert factors == pytest.approx([0.0, 0.5], abs=0.06)


@pytest.mark.parametrize("things", [("point_0", "point_1"), ("plane_0", "plane_1"), ("tag_0", "slide_1", "point_2")])
def test_outliers_among_them_are_found(things: tuple[str, ...]) -> None:
    of = mixed_set(3, things, count=30, scale="known")
    measurements = {pair: of.problem.measurements(*pair) for pair in of.problem.pairs}
    for raw in measurements.values():
        raw.B[:3, :3, 3] += 0.3 * raw.B[:3, :3, 2] + 0.1
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        for noise in ("given", "estimate"):
            options = rw.RefineOptions(robust="gnc", noise=noise)
            answer = rw.refine(of.problem.with_measurements(measurements), None, options)
            for inliers in answer.inliers.values():
                assert not inliers[:3].any()
                assert inliers[3:].sum() >= 25
            assert squared_error(answer, of.truth["sensor"]) < chdtri(6, 1e-4)


def test_calibrate_uses_them_and_says_the_noise_of_what_is_measured() -> None:
    of = mixed_set(4, ("point_0", "plane_1", "tag_2"), count=25, scale="known")
    found = rw.calibrate(of.problem)
    assert found.verdict is rw.Verdict.USE
    assert found.refined is not None
    assert squared_error(found.refined, of.truth["sensor"]) < chdtri(6, 1e-3)
    assert all(noise < 0.1 for noise in found.noise.translation_m.values())
    assert found.uncertainty_at([0.0, 0.0, 1.0], frame="sensor")


def test_points_alone_are_calibrated_without_any_rotation() -> None:
    of = mixed_set(5, ("point_0", "point_1"), count=25, scale="known")
    found = rw.calibrate(of.problem)
    assert found.verdict is rw.Verdict.USE
    assert set(found.noise.rotation_rad.values()) == {0.0}
    assert "mm for B" in str(found)


def test_a_target_that_slides_does_not_speak_against_the_sensor() -> None:
    of = mixed_set(5, ("slide_0", "slide_1"), count=25, scale="known")
    found = rw.calibrate(of.problem)
    assert found.verdict is rw.Verdict.USE
    assert found.refined is not None
    assert {direction.reason for direction in found.refined.free_directions} == {FreeReason.SLIDES}
    assert "but what slides of slide_0, slide_1" in str(found)
    assert np.isfinite(found.refined.covariance("sensor")).all()
