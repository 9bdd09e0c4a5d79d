"""What the motion determines: alone, along the graph, together; without noise and with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identified_problems import FRAMES, MOCAP, NOISE, identify, of_motions
from places import GOLDEN
from rwhec_factors.se3 import inverse, pose

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NotUniqueWarning
from gtsam_rwhec.simulate import Motion, general, perturb, sphere
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver import FreeKind, FreeReason

# -- one pair: Corollaries 2 and 4 ------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "axes"), [("general", 2), ("planar", 1), ("single_axis", 1), ("none", 0)])
@pytest.mark.parametrize(
    ("noise", "noise_in_A"), [(None, None), (NOISE, None), (NOISE, MOCAP)], ids=["exact", "noise in B", "in A and B"]
)
@pytest.mark.parametrize("count", [4, 25])
def test_one_pair_needs_two_axes(kind: Any, axes: int, noise: Any, noise_in_A: Any, count: int) -> None:
    problem = of_motions({(0, 0): (Motion(kind), count)}, noise, noise_in_A)
    known = identify(problem)
    (pair,) = known.pairs.values()
    assert pair.rotation_axes == axes
    assert known.is_unique is pair.is_unique is (axes == 2)
    assert bool(known.free_directions) is bool(pair.free_directions) is (axes != 2)
    assert pair.number_of_measurements == count
    assert (known.weakest > known.threshold) is (axes == 2)
    assert (pair.weakest > pair.threshold) is (axes == 2)
    assert known.parts == (("tag0", "cam0"),)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 2.0, -0.5)])
@pytest.mark.parametrize("noise", [None, NOISE])
def test_axes_are_told_whatever_their_direction(axis: Any, noise: Any) -> None:
    known = identify(of_motions({(0, 0): (Motion("single_axis", axis), 20)}, noise))
    assert next(iter(known.pairs.values())).rotation_axes == 1
    (direction,) = known.free_directions
    assert (direction.kind, direction.reason) == (FreeKind.TRANSLATION, FreeReason.ONE_AXIS)
    assert list(direction.frames) == ["tag0", "cam0"]


def test_two_measurements_are_one_axis() -> None:
    """Any two poses differ by a turn about one axis."""
    known = identify(of_motions({(0, 0): (Motion(), 2)}, NOISE))
    assert not known.is_unique


@pytest.mark.parametrize("scale", ["known", "shared"])
def test_odometry_needs_two_axes(scale: Any) -> None:
    for kind, unique in (("general", True), ("single_axis", False)):
        simulation = general(0, 1, seed=4, motion=kind, odometry=20, odometry_noise=NOISE, noise=NOISE, scale=scale)
        known = identify(simulation.problem)
        assert known.is_unique is unique
        assert known.pairs["sensor0", "sensor0"].is_unique is unique
        assert known.pairs["sensor0", "sensor0"].rotation_axes == (2 if unique else 1)


# -- scale ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [None, NOISE])
def test_monocular_on_one_sphere_is_not_unique(noise: Any) -> None:
    """Section 8.1: at one distance from the target, the scale and the hand's lever arm cannot be told apart."""
    with pytest.warns(NotUniqueWarning, match="scale"):
        solution = rw.solve(sphere(noise, 3, monocular=True, spheres=1).problem)
    assert solution.certificate.status == "certified_not_unique"
    assert not solution.certificate.is_certified
    assert solution.certificate.is_optimal
    assert not solution.identifiability.is_unique
    assert any(direction.kind is FreeKind.SCALE for direction in solution.identifiability.free_directions)
    # Not for want of turning: the pair itself turned about all axes.
    assert solution.identifiability.pairs["camera", "marker"].rotation_axes == 2


@pytest.mark.parametrize("noise", [None, NOISE])
def test_two_spheres_or_a_known_scale_make_it_unique(noise: Any) -> None:
    for simulation in (sphere(noise, 3, monocular=True), sphere(noise, 3, spheres=1)):
        solution = rw.solve(simulation.problem)
        assert solution.certificate.status == "certified"
        assert solution.identifiability.is_unique


def test_without_translations_the_scale_is_free() -> None:
    """A camera that turns about its own target carrier's origin: no length but the unknown lever arms."""
    generator = np.random.default_rng(0)
    A = random_poses(20, 0.0, generator)
    problem = rw.Problem("shared")
    B = perturb(0.5 * np.eye(4) @ inverse(FRAMES[4]) @ A @ FRAMES[0] * 2.0, None, generator)
    problem.add("tag0", "cam0", A, B, 0.001, 1e5)
    known = identify(problem)
    assert not known.is_unique
    assert any(direction.kind is FreeKind.SCALE for direction in known.free_directions)


# -- along the graph, and together ------------------------------------------------------------------


@pytest.mark.parametrize("noise", [None, NOISE], ids=["exact", "noise"])
def test_what_one_pair_determines_spreads(noise: Any) -> None:
    """Theorems 1 and 3: one excited pair, and every other seen once."""
    excited, once = (Motion(), 15), (Motion(), 1)
    motions = {(0, 0): excited, (0, 1): once, (1, 1): once, (1, 2): once, (2, 0): once}
    known = identify(of_motions(motions, noise))
    assert known.is_unique
    assert {pair for pair, value in known.pairs.items() if value.is_unique} == {("tag0", "cam0")}
    assert str(known) == (
        "1 of 5 pairs determines its own frames, and the other pairs connect the rest to them, so every frame is "
        "determined (RWHEC paper, Theorem 3)."
    )
    two = identify(of_motions({(0, 0): excited, (0, 1): excited}, noise))
    assert str(two) == (
        "Each of the 2 pairs determines its own frames, so every frame is determined (RWHEC paper, Theorem 3)."
    )


def test_single_measurements_alone_spread_nothing() -> None:
    motions = {(0, 0): (Motion(), 1), (0, 1): (Motion(), 2), (1, 1): (Motion(), 2), (1, 0): (Motion("planar"), 9)}
    known = identify(of_motions(motions, NOISE))
    assert not any(pair.is_unique for pair in known.pairs.values())


CROSSED = {
    (0, 0): (Motion("single_axis", (1.0, 0.0, 0.0)), 12),
    (0, 1): (Motion("single_axis", (0.0, 1.0, 0.0)), 12),
    (1, 0): (Motion("single_axis", (0.0, 0.0, 1.0)), 12),
    (1, 1): (Motion("single_axis", (1.0, 1.0, 1.0)), 12),
}


@pytest.mark.parametrize(
    ("noise", "noise_in_A"), [(None, None), (NOISE, None), (NOISE, MOCAP)], ids=["exact", "noise in B", "in A and B"]
)
def test_pairs_that_only_together_determine(noise: Any, noise_in_A: Any) -> None:
    """Endnote 9: no pair alone has a unique answer, each turned about one axis; the cycle of four has."""
    problem = of_motions(CROSSED, noise, noise_in_A)
    solution = rw.solve(problem)
    known = solution.identifiability
    assert solution.certificate.status == "certified"
    assert known.is_unique
    assert not any(pair.is_unique for pair in known.pairs.values())
    assert {pair.rotation_axes for pair in known.pairs.values()} == {1}
    assert str(known).startswith("No pair determines its frames on its own; together")
    if noise is None:
        for j, k in CROSSED:
            np.testing.assert_allclose(solution.X[f"tag{j}"].matrix(), FRAMES[j], atol=1e-8)
            np.testing.assert_allclose(solution.Y[f"cam{k}"].matrix(), FRAMES[4 + k], atol=1e-8)


def test_two_pairs_that_share_a_frame_determine_each_other() -> None:
    """A target seen on turns about x by one sensor and about y by another: along which axis should it be free?"""
    x, y = CROSSED[0, 0], CROSSED[0, 1]
    assert not identify(of_motions({(0, 0): x}, NOISE)).is_unique
    assert not identify(of_motions({(0, 1): y}, NOISE)).is_unique
    assert identify(of_motions({(0, 0): x, (0, 1): y}, NOISE)).is_unique
    assert not identify(of_motions({(0, 0): x, (1, 1): y}, NOISE)).is_unique  # nothing shared


def test_parallel_axes_do_not_determine_together() -> None:
    parallel = {pair: (Motion("single_axis"), 12) for pair in CROSSED}
    known = identify(of_motions(parallel, NOISE))
    assert not known.is_unique
    (direction,) = known.free_directions
    assert direction.kind is FreeKind.TRANSLATION
    assert set(direction.frames) == {"tag0", "tag1", "cam0", "cam1"}


def test_unconnected_parts_are_solved_apart_and_named() -> None:
    motions = {(0, 0): (Motion(), 10), (1, 1): (Motion("planar"), 10), (2, 1): (Motion("planar"), 10)}
    with pytest.warns(NotUniqueWarning):
        solution = rw.solve(of_motions(motions, NOISE))
    known = solution.identifiability
    assert [set(part) for part in known.parts] == [{"tag0", "cam0"}, {"tag1", "cam1", "tag2"}]
    assert [set(part.names) for part in solution.parts] == [{"tag0", "cam0"}, {"tag1", "cam1", "tag2"}]
    assert [part.certificate.status for part in solution.parts] == ["certified", "certified_not_unique"]
    assert solution.certificate.status == "certified_not_unique"
    assert "2 unconnected parts, solved separately" in solution.certificate.reason
    assert solution.cost == pytest.approx(sum(part.certificate.cost for part in solution.parts))
    (direction,) = known.free_directions
    assert set(direction.frames) == {"tag1", "tag2", "cam1"}
    # Each part is what it would be alone.
    alone = rw.solve(of_motions({(0, 0): (Motion(), 10)}, NOISE))
    np.testing.assert_allclose(solution.X["tag0"].matrix(), alone.X["tag0"].matrix(), atol=1e-10)


# -- many frames ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "noise"), [("general", None), ("planar", None), ("planar", NOISE)])
def test_many_frames_are_asked_without_a_dense_matrix(kind: Any, noise: Any) -> None:
    known = identify(general(70, 1, seed=1, motion=kind, noise=noise, number_of_measurements=6).problem)
    assert known.is_unique is (kind == "general")
    assert len(known.free_directions) == (0 if known.is_unique else 1)
    for direction in known.free_directions:
        assert direction.kind is FreeKind.TRANSLATION
        assert len(direction.frames) == 71
        assert "and 67 more: the motion turned about one axis only" in str(direction)


def test_every_one_of_many_free_directions_is_said() -> None:
    """A camera at rest, whose place is known, sees seventy targets of unknown size: each may be near or far."""
    simulation = general(
        70, 1, seed=1, motion=Motion("none", extent_m=0.0), number_of_measurements=3, scale="per_target"
    )
    simulation.problem.fix("sensor0", simulation.Y["sensor0"])
    known = identify(simulation.problem)
    assert len(known.free_directions) == len(simulation.X)
    for direction in known.free_directions:
        assert direction.kind is FreeKind.SCALE
        (name,) = direction.frames
        assert str(direction).startswith(f"change of the scale of {name}, together with {name} along ")
    assert {name for direction in known.free_directions for name in direction.own_scales} == set(simulation.X)


# -- known frames and priors ------------------------------------------------------------------------


def test_a_known_frame_closes_what_planar_motion_leaves_open() -> None:
    problem = of_motions({(0, 0): (Motion("planar"), 10), (1, 0): (Motion("planar"), 10)}, NOISE)
    assert not identify(problem).is_unique
    problem.fix("tag1", FRAMES[1])
    assert identify(problem).is_unique


@pytest.mark.parametrize(("sigma", "unique"), [(0.001, True), (None, False)])
def test_a_prior_closes_only_what_it_speaks_of(sigma: Any, unique: bool) -> None:
    problem = of_motions({(0, 0): (Motion("planar"), 10)}, NOISE)
    problem.add_prior("cam0", FRAMES[4], sigma=sigma, kappa=1e4)
    assert identify(problem).is_unique is unique


def test_one_measurement_of_a_known_frame_is_enough() -> None:
    """As many equations as unknowns: only the weights tell the noise."""
    problem = of_motions({(0, 0): (Motion(), 1)}, NOISE)
    problem.fix("tag0", FRAMES[0])
    assert identify(problem).is_unique


def test_with_every_frame_known_there_is_nothing_to_determine() -> None:
    problem = of_motions({(0, 0): (Motion(), 5)}, NOISE)
    problem.fix("tag0", FRAMES[0])
    problem.fix("cam0", FRAMES[4])
    known = identify(problem)
    assert known.is_unique
    assert known.weakest == np.inf


def test_with_every_frame_known_the_scale_is_still_determined() -> None:
    problem = rw.Problem("shared")
    data = of_motions({(0, 0): (Motion(), 5)}, NOISE).measurements("tag0", "cam0")
    problem.add("tag0", "cam0", data.A, data.B, data.sigma, data.kappa)
    problem.fix("tag0", FRAMES[0])
    problem.fix("cam0", FRAMES[4])
    solution = rw.solve(problem)
    assert solution.identifiability.is_unique
    assert solution.scale == pytest.approx(1.0, abs=0.05)


def test_pose_of_the_far_frames_is_not_needed_for_the_verdict() -> None:
    """Moving the world's origin by a kilometre changes no verdict."""
    far = pose(np.eye(3), [700.0, -700.0, 100.0])
    for motions in (CROSSED, {(0, 0): (Motion("planar"), 12)}, {(0, 0): (Motion(), 12)}):
        problem, moved = of_motions(motions, NOISE, MOCAP), rw.Problem()
        for target, sensor in problem.pairs:
            data = problem.measurements(target, sensor)
            moved.add(target, sensor, data.A @ far, data.B, data.sigma, data.kappa)
        near, after = identify(problem), identify(moved)
        assert near.is_unique is after.is_unique
        assert [p.is_unique for p in near.pairs.values()] == [p.is_unique for p in after.pairs.values()]


GOLDEN_FIGURE_8 = GOLDEN / "utias_figure_8.txt"


@pytest.fixture(scope="module")
def real(utias_folder: Path) -> rw.Solution:
    return rw.solve(rw.read_csv(utias_folder, sigma=1.0, kappa=1.0))


def figure_8(known: rw.Identifiability, targets: list[str], sensors: list[str]) -> list[str]:
    """A row for each sensor, a column for each target: B blue, unique alone; r red, not; . white, not observed."""
    rows = []
    for sensor in sensors:
        pairs = [known.pairs.get((target, sensor)) for target in targets]
        rows.append(sensor + " " + "".join("." if p is None else "B" if p.is_unique else "r" for p in pairs))
    return rows


def test_the_real_dataset_is_unique(real: rw.Solution) -> None:
    known = real.identifiability
    assert real.certificate.status == "certified"
    assert known.is_unique
    assert known.free_directions == ()
    assert known.weakest > 10.0 * known.threshold
    assert len(known.parts) == 1


def test_figure_8_of_the_real_dataset(real: rw.Solution) -> None:
    targets = sorted(real.X, key=lambda name: int(name[4:]))
    grid = figure_8(real.identifiability, targets, sorted(real.Y))
    assert grid == GOLDEN_FIGURE_8.read_text().splitlines()
    joined = "".join(row.split()[1] for row in grid)
    assert (len(joined) - joined.count(".")) == 73


def test_red_squares_are_motions_in_the_plane(real: rw.Solution, utias_folder: Path) -> None:
    """Read from A itself, without any residual: how far each pair's rotations leave one common axis, in degrees."""
    problem = rw.read_csv(utias_folder, sigma=1.0, kappa=1.0)
    for pair, value in real.identifiability.pairs.items():
        R = problem.measurements(*pair).A[:, :3, :3]
        # The direction that the rotations keep best, and the mean angle by which they tilt it.
        _, s, _ = np.linalg.svd(R.mean(axis=0))
        tilt_deg = np.degrees(np.arccos(min(1.0, s[0])))
        if tilt_deg < 0.2:
            assert not value.is_unique, pair
            assert value.rotation_axes < 2, pair
        if tilt_deg > 3.0 and len(R) >= 10:
            assert value.is_unique, pair
            assert value.rotation_axes == 2, pair


def test_nothing_that_was_not_seen_is_in_the_grid(real: rw.Solution) -> None:
    assert set(real.identifiability.pairs) == set(real.residuals)
    for pair, value in real.identifiability.pairs.items():
        assert value.number_of_measurements == real.residuals[pair].number_of_measurements
        assert value.is_unique is (value.free_directions == ())
