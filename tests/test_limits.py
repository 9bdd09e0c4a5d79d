"""Where answers are not what their numbers seem: twins far away, digits lost, nothing measured."""

from __future__ import annotations

import warnings

import gtsam
import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import FreeKind
from gtsam_rwhec.solver.certificate import Basis

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
@pytest.mark.parametrize("weights", [(), (1e-3, 1e5), (1e3, 1e-5)])
def test_motions_at_rest_determine_nothing(weights: tuple[float, ...]) -> None:
    rest = np.tile(np.eye(4), (10, 1, 1))
    problem = rw.Problem()
    problem.add_motion("cam", rest, rest, *weights)
    solution = rw.solve(problem)
    assert solution.certificate.status == "certified_not_unique"
    assert len(solution.identifiability.free_directions) == 6


@pytest.mark.parametrize(("rotation_rad", "sigma"), [(1e-3, 1e-6), (1e-6, 1e-6)])
@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_no_digits_are_lost_where_translations_share_almost_all(rotation_rad: float, sigma: float) -> None:
    """Two translations that differ by a thousandth of what they share: eliminated, they would be another problem's.

    A certificate of the reduced form was above or below the cost by half (format 4 had a cause for this).
    """
    A = moved(rotation_rad, 20)
    generator = np.random.default_rng(1)
    noise = generator.standard_normal((20, 6)) * np.r_[np.full(3, 1e-3), np.full(3, sigma)]
    B = np.linalg.inv(Y) @ A @ X @ np.array([gtsam.Pose3.Expmap(xi).matrix() for xi in noise])
    problem = rw.Problem()
    problem.add("t", "s", A, B, sigma=sigma, kappa=5e5)
    solution = rw.solve(problem)
    certificate = solution.certificate
    assert certificate.is_optimal
    assert certificate.basis is Basis.MEASUREMENTS
    assert certificate.relative_gap < 1e-6

    def cost(X: np.ndarray, Y: np.ndarray) -> float:
        residual = A @ X - Y @ B
        return 0.5 * float(((residual[:, :3, 3] / sigma) ** 2).sum() + 5e5 * (residual[:, :3, :3] ** 2).sum())

    assert certificate.cost == pytest.approx(cost(solution.X["t"].matrix(), solution.Y["s"].matrix()), rel=1e-6)
    assert certificate.cost < cost(X, Y)


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


def hostile(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """A and B without noise, of which something is extreme."""
    A = moved(1.0, 1 if kind == "one measurement" else 6)
    if kind in ("zero translations", "tiny translations"):
        A[:, :3, 3] *= 0.0 if kind == "zero translations" else 1e-160
    B = np.linalg.inv(Y) @ A @ X
    if kind == "zero translations of B":
        B[:, :3, 3] = 0.0
    if kind.startswith("offset"):
        A[:, :3, 3] += float(kind.split()[1])
    return A, B


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize(
    "kind",
    ["exact", "one measurement", "zero translations", "zero translations of B", "tiny translations", "offset 1e9"],
)
@pytest.mark.parametrize("weights", [(), (1e-15, 1e15), (1e-15, None), (1e15, 1e-15)])
def test_no_warning_of_numpy_leaks(scale: rw.ScaleMode, kind: str, weights: tuple[float, ...]) -> None:
    """Every warning but our own is an error here, and every exception but our own fails the test."""
    problem = rw.Problem(scale)
    with warnings.catch_warnings(action="error"):
        warnings.simplefilter("ignore", rw.errors.RwhecWarning)
        problem.add("t", "s", *hostile(kind), *weights)
        for call in (
            lambda: rw.solve(problem).certificate,
            lambda: rw.certify(problem, {"t": X}, {"s": Y}, {"t": 1.0} if scale == "per_target" else 1.0),
        ):
            try:
                certificate = call()
            except rw.errors.RwhecError:
                continue
            assert certificate.lower_bound <= certificate.cost < np.inf
