"""The general simulator: graphs, motions, scales, odometry, noise where sensors have it; drives and their tracks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rwhec_factors import se3
from scipy.stats import chi2

from gtsam_rwhec import simulate
from gtsam_rwhec.errors import MeasurementsNotKeptError, OptionError, ScaleError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Motion, Noise, Simulation, carrier_poses, general
from gtsam_rwhec.simulate.simulated_rigs import Edge, MotionKind, bipartite_edges

Pair = tuple[str, str]


def residuals(simulation: Simulation, pair: Pair) -> Array:
    """B of a pair less what the truth says it is: (N, 4, 4), scaled as B is."""
    target, sensor = pair
    X = simulation.Y[sensor] if target == sensor else simulation.X[target]
    scale = simulation.scale[target] if isinstance(simulation.scale, Mapping) else simulation.scale
    measured = simulation.problem.measurements(target, sensor)
    expected = np.linalg.inv(simulation.Y[sensor]) @ measured.A @ X
    expected[:, :3, 3] *= scale
    return measured.B - expected


def number_of_parts(edges: list[Edge], targets: int, sensors: int) -> int:
    part = {(kind, i): (kind, i) for kind, count in (("t", targets), ("s", sensors)) for i in range(count)}
    for j, k in edges:
        old, new = part["t", j], part["s", k]
        part = {frame: new if name == old else name for frame, name in part.items()}
    return len(set(part.values()))


@given(
    seed=st.integers(0, 2**32 - 1),
    targets=st.integers(0, 4),
    sensors=st.integers(1, 4),
    graph=st.sampled_from(["complete", "star", "random"]),
    motion=st.sampled_from(["general", "planar", "single_axis", "none"]),
    scale=st.sampled_from(["known", "shared", "per_target"]),
    odometry=st.integers(0, 3),
)
@settings(max_examples=60, deadline=None)
def test_without_noise_the_truth_fits(
    seed: int, targets: int, sensors: int, graph: str, motion: str, scale: str, odometry: int
) -> None:
    if targets == 0:
        odometry += 1
    simulation = general(
        targets,
        sensors,
        seed=seed,
        graph=graph,  # type: ignore[arg-type]
        motion=motion,  # type: ignore[arg-type]
        scale=scale,  # type: ignore[arg-type]
        number_of_measurements=6,
        odometry=odometry,
    )
    assert simulation.problem.is_relative
    assert set(simulation.problem.targets) == set(simulation.X)
    assert set(simulation.problem.sensors) == set(simulation.Y)
    for pair in simulation.problem.pairs:
        assert np.abs(residuals(simulation, pair)).max() < 1e-13
    if isinstance(simulation.scale, Mapping):
        assert set(simulation.scale) == set(simulation.X) | (set(simulation.Y) if odometry else set())


@given(
    seed=st.integers(0, 2**32 - 1),
    targets=st.integers(1, 6),
    sensors=st.integers(1, 6),
    probability=st.floats(0.0, 1.0),
)
def test_random_graphs_are_connected(seed: int, targets: int, sensors: int, probability: float) -> None:
    edges = bipartite_edges("random", targets, sensors, seed, probability)
    assert len(set(edges)) == len(edges)
    assert number_of_parts(edges, targets, sensors) == 1
    if probability == 0.0:
        assert len(edges) == targets + sensors - 1


def test_named_graphs() -> None:
    assert len(bipartite_edges("complete", 3, 4, 0)) == 12
    star = bipartite_edges("star", 3, 4, 0)
    assert len(star) == 6
    assert number_of_parts(star, 3, 4) == 1
    assert bipartite_edges("star", 1, 3, 0) == bipartite_edges("complete", 1, 3, 0)
    assert len(bipartite_edges("random", 3, 4, 0, 1.0)) == 12


def test_given_edges_may_leave_parts_and_frames_alone() -> None:
    simulation = general(4, 3, seed=1, graph=[(2, 0), (0, 2)])
    assert simulation.problem.pairs == (("target2", "sensor0"), ("target0", "sensor2"))
    assert set(simulation.X) == {"target0", "target2"}
    assert set(simulation.Y) == {"sensor0", "sensor2"}


def test_motions_turn_about_what_they_say() -> None:
    axis = np.array([1.0, 2.0, 2.0]) / 3.0

    def drawn(kind: MotionKind) -> tuple[Array, Array]:
        poses = carrier_poses(Motion(kind, axis=(1.0, 2.0, 2.0), extent_m=3.0), 200, 2)
        return poses[:, :3, :3], poses[:, :3, 3]

    R, t = drawn("planar")
    assert np.allclose(R @ axis, axis)
    assert np.allclose(t @ axis, 0.0, atol=1e-14)
    R, t = drawn("single_axis")
    assert np.allclose(R @ axis, axis)
    assert np.linalg.matrix_rank(t) == 3
    R, t = drawn("none")
    assert np.array_equal(R, np.broadcast_to(np.eye(3), R.shape))
    assert np.linalg.matrix_rank(t) == 3
    assert np.abs(t).max() <= 3.0
    R, t = drawn("general")
    assert np.linalg.matrix_rank(R.reshape(-1, 9)) == 9


def test_small_angles_and_wobble() -> None:
    poses = carrier_poses(Motion(max_angle_rad=0.1), 200, 3)
    cosines = (np.trace(poses[:, :3, :3], axis1=1, axis2=2) - 1.0) / 2.0
    assert np.all(cosines >= np.cos(0.1) - 1e-12)
    poses = carrier_poses(Motion("planar", wobble_rad=0.01, wobble_m=0.02), 5000, 4)
    assert np.std(poses[:, 2, 3]) == pytest.approx(0.02, rel=0.05)
    assert np.std(poses[:, 2, 0]) == pytest.approx(0.01, rel=0.05)


def test_the_noise_has_the_size_that_the_problem_is_told() -> None:
    # t_B less its truth over sigma, and the cost's rotation part 2 kappa |R - I|_F^2 / 2, are chi-squares.
    noise = {("target0", "sensor0"): Noise(0.01, 1e4), ("target1", "sensor0"): Noise(0.05, 1e6)}
    simulation = general(2, 1, seed=5, noise=noise, number_of_measurements=2000, scale="shared", true_scale=3.0)
    assert not simulation.problem.is_relative
    for pair, noise_of_pair in noise.items():
        measured = simulation.problem.measurements(*pair)
        assert np.all(measured.sigma == noise_of_pair.sigma_m)
        assert np.all(measured.kappa == noise_of_pair.kappa)
        difference = residuals(simulation, pair)
        translation = np.sum(difference[:, :3, 3] ** 2) / noise_of_pair.sigma_m**2
        rotation = noise_of_pair.kappa * np.sum(difference[:, :3, :3] ** 2)
        for value in (translation, rotation):
            assert chi2.ppf(1e-4, 6000) < value < chi2.ppf(1.0 - 1e-4, 6000)


def test_noise_in_A_is_shared_by_all_that_is_measured_at_one_time() -> None:
    arguments = {"number_of_measurements": {("target0", "sensor0"): 30, ("target1", "sensor0"): 12}}
    exact = general(2, 1, seed=6, **arguments).problem  # type: ignore[arg-type]
    noisy = general(2, 1, seed=6, noise_in_A=Noise(0.01, 1e4), **arguments).problem  # type: ignore[arg-type]
    all_of_it, part = (noisy.measurements(f"target{j}", "sensor0") for j in (0, 1))
    assert all_of_it.stamps_ns is not None
    assert part.stamps_ns is not None
    assert len(part.A) == 12
    same = np.searchsorted(all_of_it.stamps_ns, part.stamps_ns)
    assert np.array_equal(all_of_it.A[same], part.A)
    before = exact.measurements("target1", "sensor0")
    assert np.array_equal(before.B, part.B)
    assert np.all(np.abs(before.A - part.A)[:, :3].max(axis=(1, 2)) > 0.0)


def test_one_seed_has_one_truth_at_every_noise_level() -> None:
    small, large = (general(3, 2, seed=7, graph="random", noise=Noise(s, k)) for s, k in ((0.001, 1e5), (0.1, 10.0)))
    assert small.problem.pairs == large.problem.pairs
    for name, truth in (small.X | small.Y).items():
        assert np.array_equal(truth, (large.X | large.Y)[name])
    for pair in small.problem.pairs:
        assert np.array_equal(small.problem.measurements(*pair).A, large.problem.measurements(*pair).A)


def test_scales() -> None:
    assert general(1, 1, seed=8).scale == 1.0
    assert general(1, 1, seed=8, scale="shared").scale == 0.5
    assert general(1, 1, seed=8, scale="shared", true_scale=2).scale == 2.0
    simulation = general(3, 1, seed=8, scale="per_target", known_sizes=["target1"])
    assert isinstance(simulation.scale, dict)
    assert simulation.scale["target1"] == 1.0
    assert all(0.5 <= alpha <= 2.0 for alpha in simulation.scale.values())
    assert simulation.problem.fixed_scales == {"target1": 1.0}
    given_scales = {"target0": 0.9, "target1": 1.1}
    simulation = general(2, 1, seed=8, scale="per_target", true_scale=given_scales, known_sizes=["target0"])
    assert simulation.scale == given_scales
    assert simulation.problem.fixed_scales == {"target0": 0.9}


def test_odometry_alone_and_its_noise() -> None:
    simulation = general(0, 2, seed=9, odometry=2000, odometry_noise=Noise(0.01, 1e4))
    assert simulation.problem.targets == ()
    assert simulation.problem.pairs == (("sensor0", "sensor0"), ("sensor1", "sensor1"))
    difference = residuals(simulation, ("sensor1", "sensor1"))
    assert chi2.ppf(1e-4, 6000) < np.sum(difference[:, :3, 3] ** 2) / 0.01**2 < chi2.ppf(1.0 - 1e-4, 6000)


def test_measurements_need_not_be_kept() -> None:
    problem = general(1, 1, seed=10, keep_measurements=False).problem
    with pytest.raises(MeasurementsNotKeptError):
        problem.measurements("target0", "sensor0")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"graph": "ring"}, "'ring'"),
        ({"graph": [(0, 0), (2, 0)]}, r"edge \(2, 0\)"),
        ({"graph": [(0, 0), (0, 0)]}, "twice"),
        ({"graph": []}, "nothing to measure"),
        ({"edge_probability": 1.5}, "edge_probability"),
        ({"motion": "spiral"}, "'spiral'"),
        ({"number_of_measurements": 0}, "number_of_measurements"),
        ({"number_of_measurements": {("target0", "sensor0"): 3}}, "nothing for"),
        ({"noise": Noise(0.01, 10.0, "released")}, "released"),
        ({"odometry": -1}, "odometry is -1"),
        ({"scale": "affine"}, "'affine'"),
        ({"true_scale": 2.0}, "choose scale"),
        ({"scale": "shared", "true_scale": {"target0": 1.0}}, "one scale"),
        ({"scale": "shared", "known_sizes": ["target0"]}, "known_sizes"),
        ({"scale": "per_target", "known_sizes": ["tag"]}, "tag"),
        ({"scale": "per_target", "true_scale": 2.0}, "mapping"),
        ({"scale": "per_target", "true_scale": {"target0": 1.0}}, "target1"),
    ],
)
def test_bad_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        general(2, 2, seed=0, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("alpha", [0.0, -1.0, float("nan"), float("inf")])
def test_scales_must_be_positive(alpha: float) -> None:
    with pytest.raises(ScaleError, match="positive"):
        general(1, 1, seed=0, scale="shared", true_scale=alpha)


@pytest.mark.parametrize("counts", [(-1, 1), (1, -1)])
def test_counts_cannot_be_negative(counts: tuple[int, int]) -> None:
    with pytest.raises(OptionError, match="negative"):
        general(*counts, seed=0)


@pytest.mark.parametrize(
    "options", [{"axis": (0.0, 0.0, 0.0)}, {"max_angle_rad": -1.0}, {"extent_m": float("nan")}, {"wobble_m": -0.1}]
)
def test_bad_motions_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        Motion(**options)  # type: ignore[arg-type]


def test_a_planar_drive_stays_on_its_plane_and_tracks_follow_it() -> None:
    T = se3.expmap(np.array([[0.3, -0.2, 0.5, 1.0, 2.0, 3.0]]))[0]
    exact = simulate.SimulatedOdometry(T, 0.0, 0.0, scale=0.5, clock_offset_s=0.25, every=2)
    driven = simulate.drive({"camera": exact}, "planar", seconds=10.0, seed=3)
    np.testing.assert_allclose(driven.T_world_vehicle[:, 2], np.tile([0, 0, 1, 0], (101, 1)), atol=1e-12)
    stamps, track = driven.tracks["camera"]
    np.testing.assert_array_equal(stamps, driven.stamps_ns[::2] - 250_000_000)
    true = driven.T_world_vehicle[::2] @ T
    expected = se3.inverse(true[:1]) @ true
    expected[:, :3, 3] *= 0.5
    np.testing.assert_allclose(track, expected, atol=1e-10)
    np.testing.assert_allclose(driven.T("camera", "camera"), np.eye(4), atol=1e-15)


def test_a_straight_drive_does_not_turn() -> None:
    driven = simulate.drive({}, "straight", seconds=5.0)
    np.testing.assert_allclose(driven.T_world_vehicle[:, :3, :3], np.tile(np.eye(3), (51, 1, 1)))


def test_what_is_no_drive_is_refused() -> None:
    with pytest.raises(OptionError, match="shape is 'up'"):
        simulate.drive({}, "up")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="must be positive"):
        simulate.drive({}, seconds=0.0)
