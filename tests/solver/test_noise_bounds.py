"""How large the noise is and with how many equations to spare; the information it feigns, against draws of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rwhec_factors.se3 import inverse, pose

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general, perturb
from gtsam_rwhec.solver.answers import Answer, PairPoses, costs_of_pairs
from gtsam_rwhec.solver.information import PartInformation, pair_information
from gtsam_rwhec.solver.noise_bounds import FLOOR, PartVarianceFactors, common_axes, pair_noise, variance_factors
from gtsam_rwhec.solver.parts import parts_of


def told_by_rotations(f_R: float, spare: float) -> PartVarianceFactors:
    """Translations that tell nothing, and rotations that tell f_R."""
    nothing = np.array([1e9])
    return PartVarianceFactors(np.array([f_R]), nothing, nothing, spare, spare, spare)


def level_of(problem: rw.Problem) -> PartVarianceFactors:
    solution = rw.solve(problem)
    (part,) = parts_of(problem)
    poses = {name: T.matrix() for name, T in {**solution.X, **solution.Y}.items()}
    stacked = np.array([poses[name] for name in part.free])
    shift = np.array([part.frame_shift(name) for name in part.free])
    scale = solution.scale
    own = [scale[name] if name in part.scale_owners and isinstance(scale, dict) else np.nan for name in part.free]
    answer = Answer(
        stacked[:, :3, :3], stacked[:, :3, 3] - shift, np.array(own), scale if isinstance(scale, float) else 1.0
    )
    at = PairPoses.of(part, answer)
    return variance_factors(part, PartInformation.of(part, pair_information(part, at)), *costs_of_pairs(part, at))


@pytest.mark.parametrize(("scale", "count"), [("known", 6), ("known", 30), ("shared", 30)])
def test_true_weights_make_variance_factors_of_one(scale: Any, count: int) -> None:
    """Fitted unknowns are accounted for: with six measurements they eat a third of the residuals."""
    levels = [
        level_of(general(1, 1, seed=seed, noise=Noise(0.01, 2000.0), scale=scale, number_of_measurements=count).problem)
        for seed in range(60)
    ]
    translation = np.mean([level.on_arm for level in levels])
    rotation = np.mean([level.rotation for level in levels])
    # A mean of 60 chi-squares of about 6 count - 12 degrees of freedom each: four standard errors.
    allowed = 4.0 * np.sqrt(2.0 / (60 * (6 * count - 12)))
    assert abs(0.5 * (rotation + translation) - 1.0) < allowed
    assert abs(rotation - 1.0) < 2.0 * allowed
    assert abs(translation - 1.0) < 2.0 * allowed
    # Each unknown is fitted to one kind or the other.
    assert levels[0].spare_rotation + levels[0].spare_on_arm == pytest.approx(6 * count - 12 - (scale != "known"))
    assert levels[0].spare_translation == 3 * count - 6 - (scale != "known")


def test_weights_too_small_make_variance_factors_to_match() -> None:
    simulation = general(1, 1, seed=0, noise=Noise(0.01, 2000.0), number_of_measurements=300)
    data = simulation.problem.measurements("target0", "sensor0")
    problem = rw.Problem()
    problem.add("target0", "sensor0", data.A, data.B, 1.0, 1.0)
    level = level_of(problem)
    assert level.translation[0] == pytest.approx(0.01**2, rel=0.2)
    assert level.rotation[0] == pytest.approx(1.0 / 2000.0, rel=0.2)


def test_exact_data_have_a_floor() -> None:
    problem = general(1, 1, seed=0, number_of_measurements=10).problem
    level = level_of(problem)
    assert level.rotation[0] == pytest.approx(2.0 * FLOOR**2, rel=1e-6)
    assert level.translation[0] > 0.0


@pytest.mark.parametrize("turned_at", ["the world", "the rig"])
@pytest.mark.parametrize("A_noise", [Noise(1e-4, 2e4), Noise(1e-4, 500.0)])
def test_the_bound_on_the_carriers_noise_holds(turned_at: str, A_noise: Noise) -> None:
    """q^2 is told to be at least what A's rotations were off by, wherever they turned wrongly."""
    for seed in range(20):
        simulation = general(1, 1, seed=seed, noise=Noise(0.005, 500.0), number_of_measurements=60, motion="planar")
        data = simulation.problem.measurements("target0", "sensor0")
        if turned_at == "the world":
            A = perturb(data.A, A_noise, seed)
        else:
            A = inverse(perturb(inverse(data.A), A_noise, seed))
        problem = rw.Problem()
        problem.add("target0", "sensor0", A, data.B, data.sigma, data.kappa)
        (part,) = parts_of(problem)
        # At the truth, so that it is the bound that is tested.
        T = np.array([{**simulation.X, **simulation.Y}[name] for name in part.free])
        shift = np.array([part.frame_shift(name) for name in part.free])
        poses = PairPoses.of(part, Answer(T[:, :3, :3], T[:, :3, 3] - shift, np.full(2, np.nan), 1.0))
        pairs = pair_information(part, poses)
        level = variance_factors(part, PartInformation.of(part, pairs), *costs_of_pairs(part, poses))
        bound = pair_noise(part, poses, pairs, level, *common_axes(part)[:2]).carrier[0]
        assert bound > 0.8 / (2.0 * A_noise.kappa)


def test_noise_feigns_what_it_is_said_to() -> None:
    """A carrier at rest whose orientation is measured with noise: the information of turning both frames together."""
    q2 = 1.0 / (2.0 * 2000.0)
    ratios = []
    for seed in range(40):
        generator = np.random.default_rng(seed)
        count = 30
        A = perturb(np.tile(np.eye(4), (count, 1, 1)), Noise(1e-9, 2000.0), generator)
        X, Y = pose(np.eye(3), [1.0, 0.0, 0.0]), np.eye(4)
        B = np.tile(inverse(Y) @ X, (count, 1, 1))
        problem = rw.Problem()
        problem.add("tag", "cam", A, B, 0.1, 50.0)
        (part,) = parts_of(problem)
        T = np.array([{"tag": X, "cam": Y}[name] for name in part.free])
        shift = np.array([part.frame_shift(name) for name in part.free])
        poses = PairPoses.of(part, Answer(T[:, :3, :3], T[:, :3, 3] - shift, np.full(2, np.nan), 1.0))
        # Rotation residuals that say exactly how much A's rotations are off: f_R = 2 kappa q^2.
        pairs = pair_information(part, poses)
        feigned = pair_noise(
            part, poses, pairs, told_by_rotations(2.0 * 50.0 * q2, 3.0 * count - 6.0), *common_axes(part)[:2]
        )
        together = np.zeros(15)
        together[[2, 9]] = 1.0  # both frames about z
        ratios.append((together @ pairs.rotation()[0] @ together) / (together**2 @ feigned.rotation[0]))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)


def level_at_three(sigma: float, kappa: float) -> PartVarianceFactors:
    """Three measurements of one pair, with these weights."""
    simulation = general(1, 1, seed=3, noise=Noise(0.01, 2000.0), number_of_measurements=3)
    data = simulation.problem.measurements("target0", "sensor0")
    problem = rw.Problem()
    problem.add("target0", "sensor0", data.A, data.B, sigma, kappa)
    return level_of(problem)


def test_who_weighs_more_is_fitted_more() -> None:
    """Eighteen equations and twelve unknowns, six of them of rotations, which may be fitted to either kind."""
    by_rotations, by_translations = level_at_three(10.0, 1e6), level_at_three(1e-4, 1.0)
    assert (by_rotations.spare_rotation, by_rotations.spare_on_arm) == pytest.approx((3.0, 3.0), abs=0.01)
    # Nine equations of translations leave three after the six translations: these all go into rotations.
    assert (by_translations.spare_rotation, by_translations.spare_on_arm) == pytest.approx((6.0, 0.0), abs=0.01)


def test_translations_with_nothing_to_spare_do_not_bound_the_carriers_noise() -> None:
    """On a long arm they would bound it by a residual that the fit has made zero."""
    simulation = general(1, 1, seed=3, noise=Noise(0.01, 2000.0), number_of_measurements=3)
    (part,) = parts_of(simulation.problem)
    T = np.array([{**simulation.X, **simulation.Y}[name] for name in part.free])
    shift = np.array([part.frame_shift(name) for name in part.free])
    poses = PairPoses.of(part, Answer(T[:, :3, :3], T[:, :3, 3] - shift, np.full(2, np.nan), 1.0))
    pairs = pair_information(part, poses)
    zero, one = np.full(1, 1e-12), np.ones(1)
    for spare, told in ((0.0, False), (0.9, False), (3.0, True)):
        noise = PartVarianceFactors(one, one, zero, 3.0, 3.0, spare)
        bound = pair_noise(part, poses, pairs, noise, *common_axes(part)[:2])
        of_rotations = part.moments.count[0] / (2.0 * part.moments.kappa[0])
        assert bool(bound.carrier[0] < 1e-3 * of_rotations) is told
        assert bound.spare[0] == pytest.approx(2.0 if told else 3.0)


def test_with_few_equations_an_arm_along_the_common_axis_does_not_count() -> None:
    """The target 263 m up the axis of the motion, as noise may put it: translations then bound A's noise no better."""
    simulation = general(1, 1, seed=5, noise=Noise(0.001, 2000.0), number_of_measurements=5, motion="planar")
    bounds = []
    for far_m in (0.0, 263.0):
        (part,) = parts_of(simulation.problem)
        T = np.array([{**simulation.X, **simulation.Y}[name] for name in part.free])
        shift = np.array([part.frame_shift(name) for name in part.free])
        t = T[:, :3, 3] - shift + np.array([0.0, 0.0, far_m])  # both frames, along the axis of planar motion
        poses = PairPoses.of(part, Answer(T[:, :3, :3], t, np.full(2, np.nan), 1.0))
        pairs = pair_information(part, poses)
        level = variance_factors(part, PartInformation.of(part, pairs), *costs_of_pairs(part, poses))
        bounds.append(pair_noise(part, poses, pairs, level, *common_axes(part)[:2]).carrier[0])
    assert bounds[1] == pytest.approx(bounds[0], rel=1e-4)


def test_a_free_direction_of_exact_data_is_fitted_to_nothing() -> None:
    """Twelve unknowns, one of them free: eleven are fitted."""
    problem = general(1, 1, seed=2, number_of_measurements=3, motion="single_axis").problem
    level = level_of(problem)
    assert level.spare_rotation >= 0.0
    assert level.spare_on_arm >= 0.0
    assert level.spare_rotation + level.spare_on_arm == pytest.approx(6 * 3 - 11, abs=1e-6)
