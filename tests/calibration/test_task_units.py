"""How far off a point is, against sampling, against the frame's own covariance; and where sensors saw their targets."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from refinement_problems import rig
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.point_uncertainty import Carriers, ball_radius, ellipsoid, point_sentence, views_of
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate import Noise

POINT = np.array([0.1, -0.2, 0.8])


@pytest.fixture(scope="module")
def calibration() -> rw.Calibration:
    return rw.calibrate(rig(seed=3).problem)


@pytest.mark.parametrize("variances", [(1.0, 1.0, 1.0), (9.0, 1.0, 0.04), (1.0, 1e-6, 0.0), (1.0, 1.0, 0.0)])
@pytest.mark.parametrize("freedom", [np.inf, 7.0])
def test_the_ball_holds_the_share_of_samples_that_it_says(variances: tuple[float, ...], freedom: float) -> None:
    rng = np.random.default_rng(0)
    e = rng.standard_normal((400_000, 3)) * np.sqrt(variances)
    if np.isfinite(freedom):
        e *= np.sqrt(freedom / rng.chisquare(freedom, (len(e), 1)))
    inside = np.mean(np.linalg.norm(e, axis=1) <= ball_radius(np.array(variances), 0.95, freedom))
    assert inside == pytest.approx(0.95, abs=0.0015)  # four standard deviations of the share


def test_the_covariance_is_that_of_sampled_poses(calibration: rw.Calibration) -> None:
    rng = np.random.default_rng(0)
    pose, covariance = calibration.Y["sensor0"], calibration.covariance("sensor0")
    twists = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    points = np.array([pose.retract(xi).transformFrom(POINT) for xi in twists])
    found = calibration.uncertainty_at(POINT, frame="sensor0", seen_from="hand")
    np.testing.assert_allclose(found.centre_m, pose.transformFrom(POINT))
    np.testing.assert_allclose(found.covariance_m2, np.cov(points.T), atol=0.03 * np.trace(found.covariance_m2))


def test_another_sensor_sees_it_with_the_relative_covariance(calibration: rw.Calibration) -> None:
    found = calibration.uncertainty_at(POINT, "sensor0", "sensor1")
    pose, covariance = calibration.relative("sensor1", "sensor0")
    J = np.zeros((3, 6), order="F")
    np.testing.assert_allclose(found.centre_m, pose.transformFrom(POINT, J, np.zeros((3, 3), order="F")))
    np.testing.assert_allclose(found.covariance_m2, J @ covariance @ J.T, rtol=1e-9, atol=1e-15)


A = gtsam.Pose3.Expmap(np.array([0.4, -0.3, 0.8, 0.5, -0.2, 0.9]))


@pytest.mark.parametrize(
    ("frame", "seen_from"),
    [("sensor0", "base"), ("sensor0", "target1"), ("target0", "hand"), ("target0", "sensor1"), ("sensor0", None)],
)
def test_with_A_it_is_expressed_on_the_other_carrier(
    calibration: rw.Calibration, frame: str, seen_from: str | None
) -> None:
    """Against samples of both poses from their joint covariance."""
    rng = np.random.default_rng(0)
    names = [frame, *([seen_from] if seen_from in calibration.X | calibration.Y else [])]
    poses = [(calibration.X | calibration.Y)[name] for name in names]
    twists = rng.multivariate_normal(np.zeros(6 * len(names)), calibration.covariance(*names), 20_000)

    def expressed(*at: gtsam.Pose3) -> np.ndarray:
        across = (A.inverse() if frame.startswith("sensor") else A).compose(at[0])
        return np.asarray((across if len(at) == 1 else at[1].between(across)).transformFrom(POINT))

    moved = [
        expressed(*(pose.retract(xi) for pose, xi in zip(poses, np.split(row, len(poses)), strict=True)))
        for row in twists
    ]
    found = calibration.uncertainty_at(POINT, frame, seen_from, A=A)
    np.testing.assert_allclose(found.centre_m, expressed(*poses), atol=1e-12)
    np.testing.assert_allclose(
        found.covariance_m2, np.cov(np.array(moved).T), atol=0.03 * np.trace(found.covariance_m2)
    )
    assert found.seen_from == (
        seen_from if len(names) == 2 else f"the frame that carries the {'target' if frame == 'sensor0' else 'sensor'}s"
    )


@pytest.mark.parametrize("about", ["targetcarrier", "sensorcarrier"])
def test_the_noise_of_one_new_A_is_apart(about: str) -> None:
    """Noise of A that is stated by the measurement is in the noise of one new measurement: by samples."""
    noise = rw.CarrierNoise(0.01, 0.002, about=about)  # type: ignore[arg-type]
    problem = rig(2, 1, noise=Noise(1e-3, 0.5 / 1e-3**2)).problem
    calibration = rw.calibrate(problem, rw.CalibrateOptions(noise="given", carrier_noise=noise, misreadings=False))
    found = calibration.uncertainty_at(POINT, "sensor0", A=A)
    rng = np.random.default_rng(0)
    here = calibration.Y["sensor0"].transformFrom(POINT)
    there = A.inverse().transformFrom(here)
    moved = []
    for xi in rng.normal(size=(20_000, 6)) * np.repeat([0.01, 0.002], 3):
        E = gtsam.Pose3.Expmap(xi)
        new = A.compose(E) if about == "targetcarrier" else E.compose(A)
        moved.append(new.inverse().transformFrom(here) - there)
    error = np.linalg.norm(np.array(moved) + 1e-3 * rng.normal(size=(20_000, 3)), axis=1)
    assert found.measurement_mm == pytest.approx(1e3 * np.quantile(error, 0.95), rel=0.03)
    alone = calibration.uncertainty_at(POINT, "sensor0").measurement_mm
    assert alone is not None
    assert alone < 0.3 * found.measurement_mm
    assert calibration.uncertainty_at(POINT, "target0").measurement_mm is None
    assert calibration.uncertainty_at(POINT, "target0", A=A).measurement_mm is not None


def test_axes_and_half_lengths_are_of_the_ellipsoid(calibration: rw.Calibration) -> None:
    found = calibration.uncertainty_at(POINT, "target0", level=0.9)
    assert calibration.refined is not None
    square = calibration.refined.squared_radius(3, 0.9)
    V = found.axes @ np.diag(found.half_lengths_mm**2) @ found.axes.T
    np.testing.assert_allclose(V, 1e6 * square * found.covariance_m2, rtol=1e-9, atol=1e-9)
    assert found.half_lengths_mm[0] >= found.half_lengths_mm[2]
    assert found.half_lengths_mm[0] >= found.radius_mm > found.half_lengths_mm[2]
    assert found.measurement_mm is None


def test_a_shared_scale_is_part_of_it() -> None:
    calibration = rw.calibrate(rig(scale="shared").problem)
    near, far = (calibration.uncertainty_at([0.0, 0.0, z], "sensor0") for z in (1.0, 100.0))
    along = calibration.Y["sensor0"].rotation().matrix()[:, 2]
    sigma = np.sqrt(calibration.covariance("scale")[0, 0]) / float(np.asarray(calibration.scale))
    assert near.radius_mm < far.radius_mm
    assert np.sqrt(along @ far.covariance_m2 @ along) == pytest.approx(100.0 * sigma, rel=0.1)


def test_carriers_have_the_names_that_the_problem_states(calibration: rw.Calibration) -> None:
    assert str(calibration.uncertainty_at(POINT, "sensor0")).startswith(
        "A point 0.83 m from sensor0, expressed in the frame that carries sensor0, is within "
    )
    named = replace(calibration, carriers=Carriers("arm/flange", "floor"))
    assert named.uncertainty_at(POINT, "sensor0", "arm/flange").seen_from == "arm/flange"
    assert named.uncertainty_at(POINT, "target0", "targetcarrier").seen_from == "floor"
    with pytest.raises(
        rw.errors.FrameError, match=r"'hand' is no frame .* \(arm/flange, sensorcarrier\) and sensor1, "
    ):
        named.uncertainty_at(POINT, "sensor0", "hand")


def test_carriers_with_each_others_usual_names(calibration: rw.Calibration) -> None:
    named = replace(calibration, carriers=Carriers("targetcarrier", "sensorcarrier"))
    assert named.uncertainty_at(POINT, "sensor0", A=np.eye(4)).seen_from == "sensorcarrier"
    with pytest.raises(
        rw.errors.FrameError, match=r"array.* is no frame .* the other carrier \(the frame that carries"
    ):
        named.uncertainty_at(POINT, "sensor0", np.eye(4))  # A, in the wrong place


def test_a_word_that_may_mean_either_carrier_is_refused(calibration: rw.Calibration) -> None:
    """A camera is on the hand more often than on the base; a target the other way about."""
    for frame, word in (("sensor0", "base"), ("target0", "hand")):
        with pytest.raises(rw.errors.FrameError, match=f"it is not clear which carrier '{word}' is, .*; name them: "):
            calibration.uncertainty_at(POINT, frame, word)
        across = calibration.uncertainty_at(POINT, frame, word, A=np.eye(4))
        assert across.seen_from.startswith("the frame that carries the ")
    named = replace(calibration, carriers=Carriers("base", "hand"))
    assert named.uncertainty_at(POINT, "sensor0", "base").seen_from == "base"
    half = replace(calibration, carriers=Carriers(None, "base"))
    with pytest.raises(rw.errors.FrameError, match=r"base is on the carrier of the targets, .*give the pose"):
        half.uncertainty_at(POINT, "sensor0", "base")


def test_what_cannot_be_asked_is_refused(calibration: rw.Calibration) -> None:
    with pytest.raises(rw.errors.FrameError, match="there is no frame 'cam_9'; there are the sensors sensor0, sensor1"):
        calibration.uncertainty_at(POINT, "cam_9")
    with pytest.raises(rw.errors.FrameError, match=r"target0 is on the carrier of the targets, .*; give the pose .*A="):
        calibration.uncertainty_at(POINT, "sensor0", "target0")
    with pytest.raises(rw.errors.OptionError, match="A has no use: sensor1 and sensor0 are on one carrier"):
        calibration.uncertainty_at(POINT, "sensor0", "sensor1", A=np.eye(4))
    with pytest.raises(rw.errors.PoseError, match="A"):
        calibration.uncertainty_at(POINT, "sensor0", A=np.ones((4, 4)))
    for nothing in ([], {}, 3):
        with pytest.raises(rw.errors.FrameError, match="is no frame in which a point of sensor0"):
            calibration.uncertainty_at(POINT, "sensor0", nothing)  # type: ignore[arg-type]
        with pytest.raises(rw.errors.FrameError, match="there is no frame"):
            calibration.uncertainty_at(POINT, nothing)  # type: ignore[arg-type]
    with pytest.raises(rw.errors.PoseError, match="give three"):
        calibration.uncertainty_at([0.0, 0.8], "sensor0")
    with pytest.raises(rw.errors.PoseError, match=r"give three finite numbers, metres, up to 1e\+15"):
        calibration.uncertainty_at([0.0, 0.0, 1e160], "sensor0")
    with pytest.raises(rw.errors.OptionError, match=r"level=1.5; give one between 0 and 1"):
        calibration.uncertainty_at(POINT, "sensor0", level=1.5)


def test_a_point_behind_a_camera_is_refused() -> None:
    """A camera saw every target in front of it."""
    simulated = rig(1, 1)
    pair = simulated.problem.pairs[0]
    raw = simulated.problem.measurements(*pair)
    # In a frame that is turned about the mean line of sight, every target is in front.
    mean = raw.B[:, :3, 3].mean(axis=0)
    z = mean / np.linalg.norm(mean)
    x = np.linalg.svd(z[None])[2][1]
    turn = se3.pose(np.stack([x, np.cross(z, x), z]), np.zeros(3))
    ahead = turn @ raw.B
    kept = ahead[:, 2, 3] > 0.0
    problem = rw.Problem(sensor_carrier="hand", target_carrier="base")
    problem.add("board", "camera", raw.A[kept], ahead[kept])
    calibration = rw.calibrate(problem)
    assert "expressed in hand" in str(calibration.uncertainty_at([0.0, 0.0, 0.8], frame="camera", seen_from="hand"))
    with pytest.raises(rw.errors.PoseError, match="is behind camera, which saw every target in front of it"):
        calibration.uncertainty_at([0.0, 0.0, -0.8], frame="camera", seen_from="hand")


def test_a_free_axis_is_infinite() -> None:
    axes, half_lengths, radius = ellipsoid(np.diag([np.inf, 4.0, 1.0]), 0.95, np.inf)
    assert np.isinf(half_lengths[0])
    assert np.isinf(radius)
    np.testing.assert_allclose(np.abs(axes), np.eye(3))
    assert half_lengths[1] == pytest.approx(2.0 * half_lengths[2])


def test_a_fixed_frame_has_no_error() -> None:
    simulated = rig()
    simulated.problem.fix("sensor0", simulated.Y["sensor0"])
    found = rw.calibrate(simulated.problem).uncertainty_at(POINT, "sensor0")
    assert found.radius_mm == 0.0
    assert isinstance(simulated.Y["sensor0"], np.ndarray | gtsam.Pose3)


def test_a_sentence_has_no_exponents() -> None:
    assert point_sentence("cam", "hand", 2.5, 0.95, 104.0, 4520.0) == (
        "A point 2.50 m from cam, expressed in hand, is within 100 mm of its true place with 95 % probability; the "
        "noise of one new measurement adds up to 4500 mm."
    )


def test_noise_that_no_sensor_has_is_no_fact() -> None:
    """0.057 mm at 0.8 m was printed as the noise of a camera."""
    said = point_sentence("cam", "hand", 0.8, 0.95, 1.2, 0.057)
    assert "0.057" not in said
    assert "not told: the residuals are smaller than a sensor's" in said
    assert "adds up to 0.57 mm" in point_sentence("cam", "hand", 0.8, 0.95, 1.2, 0.57)


def seen(points: np.ndarray) -> Problem:
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, 3] = points
    problem = Problem(scale="shared")
    problem.add("tag", "cam", np.tile(np.eye(4), (len(points), 1, 1)), poses)
    return problem


def test_the_median_distance_in_the_mean_direction_by_the_true_length() -> None:
    problem = seen(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 9.0]]))
    view = views_of(problem, {}, 2.0)["cam"]
    assert view.point_m == pytest.approx((0.0, 0.0, 1.0))
    assert view.in_front
    without_last = {pair: np.array([True, True, False]) for pair in problem.pairs}
    assert views_of(problem, without_last, 1.0)["cam"].point_m == pytest.approx((0.0, 0.0, 1.5))


def test_all_around_there_is_no_direction_but_forward() -> None:
    view = views_of(seen(np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])), {}, 1.0)["cam"]
    assert view.point_m == pytest.approx((0.0, 0.0, 2.0))
    assert not view.in_front


def test_motions_and_moments_have_no_view() -> None:
    assert views_of(rig(0, 2, odometry=5).problem, {}, 1.0) == {}
    assert views_of(rig(keep_measurements=False).problem, {}, 1.0) == {}
