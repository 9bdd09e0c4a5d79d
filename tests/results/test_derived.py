"""What follows from poses and covariances is what the calibration itself says of each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from places import REPOSITORY
from refinement_problems import rig

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.results.derived import DISTANCES_M, Derived, clock_effects, derived_of


@pytest.fixture(scope="module")
def calibration() -> rw.Calibration:
    return rw.calibrate(rig(targets=2, sensors=3).problem)


@pytest.fixture(scope="module")
def derived(calibration: rw.Calibration) -> Derived:
    return derived_of(calibration)


def test_points_are_those_of_uncertainty_at(calibration: rw.Calibration, derived: Derived) -> None:
    assert len(derived.points) == 3 * (len(DISTANCES_M) + 1)
    for point in derived.points:
        seen = np.array(calibration.views[point.sensor].point_m)
        at = seen * point.distance_m / np.linalg.norm(seen)
        assert point.radius_mm == pytest.approx(calibration.uncertainty_at(at, point.sensor).radius_mm, rel=1e-9)
        assert point.is_seen == (point.distance_m not in DISTANCES_M)


def test_sensors_are_in_the_frame_of_the_first(calibration: rw.Calibration, derived: Derived) -> None:
    first = min(calibration.Y)
    assert [one.second for one in derived.relative] == sorted(set(calibration.Y) - {first})
    for one in derived.relative:
        pose, covariance = calibration.relative(first, one.second)
        assert one.translation_m == pytest.approx(pose.translation())
        assert one.deviations_mm == pytest.approx(1e3 * np.sqrt(np.diagonal(covariance)[3:]))


def test_scales_have_their_deviations() -> None:
    calibration = rw.calibrate(rig(targets=1, sensors=2, scale="shared").problem)
    (scale,) = derived_of(calibration).scalars
    assert (scale.kind, scale.owner) == ("scale", "")
    assert scale.value == calibration.scale
    assert scale.deviation == pytest.approx(math.sqrt(calibration.covariance("scale")[0, 0]))


def test_a_clock_moves_poses_as_the_best_poses_of_another_offset_do() -> None:
    refined = rw.read_refined(REPOSITORY / "tests" / "golden" / "result_scales.json")
    frames = [Unknown.of(name) for name in (*refined.X, *refined.Y)]
    unknowns = (*frames, Unknown(UnknownKind.TIME_OFFSET, "sensor0"))
    size = 6 * len(frames) + 1
    J = np.random.default_rng(0).standard_normal((3 * size, size))
    information = J.T @ J
    joint = JointCovariance.of(unknowns, information, np.zeros((size, 0)), np.ones(size))
    found = list(clock_effects(replace(refined, joint=joint)))
    assert {one.frame for one in found} == {*refined.X, *refined.Y}
    # The poses of least cost where the offset is 1 ms away: information_pp x = -information_po 1e-3.
    best = np.linalg.solve(information[:-1, :-1], -1e-3 * information[:-1, -1])
    for one in found:
        omega, v = best[joint.slots[Unknown.of(one.frame)]].reshape(2, 3)
        assert one.rotation_deg == pytest.approx(math.degrees(np.linalg.norm(omega)))
        assert one.translation_mm == pytest.approx(1e3 * np.linalg.norm(v))
