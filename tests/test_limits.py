"""Where answers are not what their numbers seem: twins far away, digits lost, nothing measured."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.identifiability import FreeKind
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import Cause

X = gtsam.Pose3.Expmap(np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.3])).matrix()
Y = gtsam.Pose3.Expmap(np.array([-0.4, 0.6, 0.1, 0.2, -0.5, 0.3])).matrix()


def moved(rotation_rad: float, count: int, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    twists = generator.standard_normal((count, 6)) * np.r_[np.full(3, rotation_rad), np.ones(3)]
    return np.array([gtsam.Pose3.Expmap(twist).matrix() for twist in twists])


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.NotUniqueWarning")
def test_half_turns_about_three_axes_have_twins() -> None:
    A = np.tile(np.eye(4), (4, 1, 1))
    A[:, :3, :3] = [np.diag(d) for d in ([1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
    problem = rw.Problem()
    problem.add("t", "s", A, np.linalg.inv(Y) @ A @ X)
    solution = rw.solve(problem)
    assert solution.certificate.status == "certified_not_unique"
    (twin,) = solution.identifiability.free_directions
    assert twin.kind is FreeKind.TWIN


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.NotUniqueWarning")
def test_motions_at_rest_determine_nothing() -> None:
    rest = np.tile(np.eye(4), (10, 1, 1))
    problem = rw.Problem()
    problem.add_motion("cam", rest, rest)
    assert rw.solve(problem).certificate.status == "certified_not_unique"


@pytest.mark.parametrize(("rotation_rad", "sigma"), [(1e-3, 1e-6), (1e-6, 1e-6)])
@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_digits_lost_in_the_elimination_are_no_certificate(rotation_rad: float, sigma: float) -> None:
    """Two translations that differ by a thousandth of what they share: the reduced form is another problem."""
    A = moved(rotation_rad, 20)
    generator = np.random.default_rng(1)
    noise = generator.standard_normal((20, 6)) * np.r_[np.full(3, 1e-3), np.full(3, sigma)]
    B = np.linalg.inv(Y) @ A @ X @ np.array([gtsam.Pose3.Expmap(xi).matrix() for xi in noise])
    problem = rw.Problem()
    problem.add("t", "s", A, B, sigma=sigma, kappa=5e5)
    certificate = rw.solve(problem).certificate
    assert certificate.status == "gap"
    assert certificate.cause is Cause.DIGITS_LOST
    assert certificate.lower_bound == 0.0


@pytest.mark.parametrize("sigma", [1e4, 1e5])
def test_a_sensor_that_hardly_counts_keeps_its_translation(sigma: float) -> None:
    simulated = general(3, 2, seed=1, noise=Noise(1e-3, 1e5))
    problem = rw.Problem("shared")
    for target, sensor in simulated.problem.pairs:
        raw = simulated.problem.measurements(target, sensor)
        problem.add(target, sensor, raw.A, raw.B, 1e-3 if sensor == "sensor0" else sigma, 1e5)
    found = rw.solve(problem).Y["sensor1"].translation()
    np.testing.assert_allclose(found, simulated.Y["sensor1"][:3, 3], atol=0.01)


@pytest.mark.parametrize("pose_noise_rad", [0.0002, 0.002, 0.01])
@pytest.mark.parametrize("motion", ["planar", "single_axis", "none"])
@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_noise_in_a_never_passes_for_motion(motion: str, pose_noise_rad: float) -> None:
    in_A = Noise(pose_noise_rad, 1.0 / (2.0 * pose_noise_rad**2))
    for seed in range(10):
        simulated = general(
            1, 2, seed=seed, motion=motion, noise=Noise(0.005, 6500.0), noise_in_A=in_A, number_of_measurements=30
        )
        assert not rw.solve(simulated.problem).identifiability.is_unique
