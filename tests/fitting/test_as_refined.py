"""A refinement from corners in the form of every refinement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_as_refined import made

from gtsam_rwhec.fitting.corners_as_refined import as_refined, boards_of, intrinsics_of
from gtsam_rwhec.fitting.detector_bias import covariance_of_bias
from gtsam_rwhec.fitting.projection_uncertainty import projection_deviations
from gtsam_rwhec.fitting.refinement import beyond_independent_errors
from gtsam_rwhec.fitting.reprojection_record import Reprojection


def test_poses_covariances_and_names_are_those_of_the_corners() -> None:
    _, _, _, corners, refined = made()
    assert set(refined.names) == {
        "board", "cam_0", "cam_1", "intrinsics:cam_0", "intrinsics:cam_1", "scale:board",
    }  # fmt: skip
    for name in ("board", "cam_0", "cam_1", "intrinsics:cam_1"):
        np.testing.assert_allclose(refined.covariance(name), corners.covariance(name), rtol=1e-9)
    together = refined.covariance("cam_0", "intrinsics:cam_0")
    np.testing.assert_allclose(together, corners.covariance("cam_0", "intrinsics:cam_0"), rtol=1e-9)
    assert refined.X["board"].equals(corners.X["board"], 0.0)
    assert refined.graph.error(refined.values) == pytest.approx(refined.cost)
    assert all(refined.values.exists(key) for key in refined.keys.values())
    assert 5.0 < refined.degrees_of_freedom < 1e5


def test_a_size_is_a_scale_as_everywhere() -> None:
    given, _, _, corners, refined = made()
    assert isinstance(refined.scale, dict)
    true = 1.0 / (1.0 + given.shape[0])
    sigma = float(np.sqrt(refined.covariance("scale:board")[0, 0]))
    assert abs(refined.scale["board"] - true) < 4.0 * sigma
    share = float(np.sqrt(corners.covariance("shape:board")[0, 0]))
    assert sigma == pytest.approx(share * refined.scale["board"] ** 2)


def test_intrinsics_are_in_numbers_that_make_the_camera_again() -> None:
    given, _, _, corners, refined = made()
    for name, intrinsics in refined.intrinsics.items():
        np.testing.assert_array_equal(intrinsics.camera.K, corners.intrinsics[name].camera.K)
        np.testing.assert_array_equal(intrinsics.camera.D, corners.intrinsics[name].camera.D)
        np.testing.assert_allclose(intrinsics.stated_camera.K, given.observations.cameras[name].K)
        assert intrinsics.names[:5] == ("fx", "fy", "cx", "cy", "k1")
        assert intrinsics.stated_as == "calibration"
        assert 0.8 < intrinsics.projection_m < 2.2  # where the corners were seen
        regions = np.array(intrinsics.projection_px, dtype=float)
        assert regions[1, 1] < regions[[0, 0, 2, 2], [0, 2, 0, 2]].min()
        pixels, together = projection_deviations(refined, name, intrinsics.projection_m)
        middle = np.median(together[(np.abs(pixels - [960.0, 540.0]) < [320.0, 180.0]).all(axis=-1)])
        assert regions[1, 1] < middle  # which the errors of A share
        off = np.array(intrinsics.values)[:4] - given.cameras[name].K[[0, 1, 0, 1], [0, 1, 2, 2]]
        assert (np.abs(off) < 4.0 * np.array(intrinsics.standard_deviations)[:4]).all()


def test_intrinsics_that_no_camera_has_say_so() -> None:
    *_, refined = made()
    one = refined.intrinsics["cam_0"]
    assert one.fault == ""
    absurd = replace(one, values=(-5.0, *one.values[1:]))
    assert absurd.fault.startswith("intrinsics of the result: fx = -5 pixels for an image of 1920 x 1080 pixels")


def test_deviations_in_numbers_are_those_of_the_widened_covariance() -> None:
    _, base, _, corners, _ = made()
    intrinsics = intrinsics_of(corners, dict.fromkeys(corners.Y, "calibration"))
    bias = covariance_of_bias(corners)
    more = beyond_independent_errors(corners, None, dict.fromkeys(corners.slots, 3.0)) - bias
    found = Reprojection(0.1, 0.1, "estimated", 5e-4, 2e-4, {}, boards_of(corners), (), ())
    wide = as_refined(base, corners, found, intrinsics, more)
    assert wide.reprojection is not None
    deviations = wide.reprojection.boards["board"].standard_deviations
    assert deviations == pytest.approx(3.0 * np.array(found.boards["board"].standard_deviations))
    for name, one in wide.intrinsics.items():
        np.testing.assert_allclose(one.standard_deviations, 3.0 * np.array(intrinsics[name].standard_deviations))


def test_what_the_poses_noise_model_found_widens_the_poses_alone() -> None:
    _, base, noise, corners, _ = made()
    more = beyond_independent_errors(corners, noise, {}) - covariance_of_bias(corners)
    assert np.linalg.eigvalsh(corners.joint + more).min() > 0.0
    wider = corners.joint + more
    for letter, name in corners.slots:
        rows = corners.slots[letter, name]
        before, after = np.diagonal(corners.joint)[rows], np.diagonal(wider)[rows]
        if letter in "xy":
            assert (after > before).all()
        else:
            np.testing.assert_allclose(after, before)
    # what nothing explains widens all alike, and deviations in numbers with it
    twice = corners.joint + beyond_independent_errors(corners, None, dict.fromkeys(corners.slots, 2.0))
    np.testing.assert_allclose(twice, 4.0 * corners.joint + covariance_of_bias(corners))
    # a constant error moves all frames of a carrier together: two cameras to each other are as before
    both = as_refined(base, corners, Reprojection(0.1, 0.1, "estimated", 0.0, 0.0, {}, {}, (), ()), {}, more)
    before_deg, _ = np.sqrt(np.diagonal(corners.covariance("cam_0"))[:2])
    relative = np.sqrt(np.diagonal(both.relative("cam_0", "cam_1")[1]))
    assert relative[0] < 20.0 * before_deg
