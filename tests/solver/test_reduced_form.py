"""Q' against Q, against the cost written as plain loops, and the way back to translations."""

from __future__ import annotations

import numpy as np
import pytest
from naive_cost import naive_cost
from rwhec_factors import se3
from small_problems import SMALL_NOISE, flat, part_of, reduced, simulated, true_rotations

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver.answers import answer_of, as_point
from gtsam_rwhec.solver.descent import homogeneous
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.reduced_form import ReducedForm, generalised_inverse_factor
from gtsam_rwhec.solver.rotations import random_rotations

SCALES: tuple[ScaleMode, ...] = ("known", "shared", "per_target")


def with_everything(seed: int, scale: ScaleMode) -> rw.Problem:
    """Motions, a prior on every target, different weights on every pair, a known size; more sensors than targets."""
    generator = np.random.default_rng(seed)
    noise = {
        (f"target{j}", f"sensor{k}"): Noise(10.0 ** generator.uniform(-3, 0), 10.0 ** generator.uniform(0, 4))
        for j in range(2)
        for k in range(3)
    }
    known_sizes = ("target0",) if scale == "per_target" else ()
    simulation = general(
        2, 3, seed=seed, noise=noise, odometry=4, odometry_noise=SMALL_NOISE, scale=scale, known_sizes=known_sizes
    )
    for name, T in simulation.X.items():
        simulation.problem.add_prior(name, T, sigma=None if scale == "shared" else 0.1, kappa=100.0)
    return simulation.problem


CASES = {
    **{f"{scale}": (lambda seed, scale=scale: simulated(3, 2, seed, scale=scale).problem) for scale in SCALES},
    **{f"star, {scale}": (lambda seed, scale=scale: simulated(1, 4, seed, scale=scale).problem) for scale in SCALES},
    **{f"everything, {scale}": (lambda seed, scale=scale: with_everything(seed, scale)) for scale in SCALES},
    "motions alone": lambda seed: simulated(0, 1, seed, odometry=8, odometry_noise=SMALL_NOISE).problem,
}


def used(Q: Array) -> np.ndarray:
    """Variables that the problem has."""
    return np.flatnonzero(np.diagonal(Q) > 0.0)


def rotation_entries(form: ReducedForm) -> np.ndarray:
    """Where vec R of every frame and h are in the full form."""
    return np.r_[(13 * np.arange(form.rotations)[:, None] + np.arange(4, 13)).ravel(), 13 * form.rotations + 1]


@pytest.mark.parametrize("name", CASES)
def test_it_is_the_schur_complement_of_the_full_form(name: str) -> None:
    """Eq. 48, by a dense solve on what the problem has."""
    forms = PartForm.of(part_of(CASES[name](0)))
    Q, form = forms.full.dense(), forms.reduced
    keep = rotation_entries(form)
    eliminated = np.setdiff1d(used(Q), keep)
    inverse = np.linalg.pinv(Q[np.ix_(eliminated, eliminated)], rcond=1e-13, hermitian=True)
    expected = Q[np.ix_(keep, keep)] - Q[np.ix_(keep, eliminated)] @ inverse @ Q[np.ix_(eliminated, keep)]
    np.testing.assert_allclose(form.Q, expected, atol=1e-12 * form.magnitude)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("scale", SCALES)
def test_symmetry_survives_motions_and_priors(scale: ScaleMode, seed: int) -> None:
    form = reduced(with_everything(seed, scale))
    np.testing.assert_array_equal(form.Q, form.Q.T)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", CASES)
def test_its_value_is_the_cost_of_the_best_translations(name: str, seed: int) -> None:
    """x'Q'x = J at the recovered translations and scales, and no others cost less."""
    part = part_of(CASES[name](seed))
    forms = PartForm.of(part)
    generator = np.random.default_rng(seed)
    R = random_rotations(len(part.free), generator)
    x = homogeneous(R)
    value = x @ forms.reduced.apply(x)
    recovered, alpha = forms.reduced.recover(x)
    numbers = np.zeros((len(R), 13))
    numbers[:, :4], numbers[:, 4:] = recovered, flat(R).reshape(-1, 9)
    best = np.r_[numbers.ravel(), alpha, 1.0]
    Q = forms.full.dense()
    assert value == pytest.approx(best @ Q @ best, abs=1e-12 * forms.reduced.magnitude)
    free = np.setdiff1d(used(Q), rotation_entries(forms.reduced))
    for _ in range(10):
        other = best.copy()
        other[free] += 10.0 ** generator.uniform(-3, 0) * generator.standard_normal(len(free))
        assert other @ Q @ other >= value - 1e-12 * forms.reduced.magnitude


@pytest.mark.parametrize("name", CASES)
def test_its_value_is_the_cost_by_plain_loops(name: str) -> None:
    """All the way from measurements: poses recovered at true and at random rotations, costed one by one."""
    problem = CASES[name](2)
    part = part_of(problem)
    forms = PartForm.of(part)
    # Random rotations make the best scale negative as often as not, which no poses have.
    answers = [
        answer_of(part, forms.reduced, random_rotations(len(part.free), np.random.default_rng(s))) for s in range(40)
    ]
    answers = [a for a in answers if a.scale > 0.0 and not (a.own_scale <= 0.0).any()][:3]
    assert answers
    for answer in answers:
        R = answer.R if part.kind == "direct" else answer.R.transpose(0, 2, 1)
        T = se3.pose(answer.R, answer.t + [part.frame_shift(each) for each in part.free])
        poses = dict(zip(part.free, T, strict=True))
        own = dict(zip(part.free, answer.own_scale, strict=True)) | part.fixed_scales
        scale = own if part.scale == "per_target" else answer.scale
        X, Y = ({each: poses[each] for each in side} for side in (part.targets, part.sensors))
        x = homogeneous(R)
        loops = naive_cost(problem, X, Y, scale, form=part.kind, gauge=part.gauge)
        assert x @ forms.reduced.apply(x) == pytest.approx(loops, rel=1e-9)


@pytest.mark.parametrize("scale", SCALES)
def test_variables_and_answers_are_each_others_inverse(scale: ScaleMode) -> None:
    part = part_of(with_everything(0, scale))
    forms = PartForm.of(part)
    R = random_rotations(len(part.free), np.random.default_rng(4))
    answer = answer_of(part, forms.reduced, R)
    point = as_point(part, answer)
    x = homogeneous(R)
    assert forms.cost.at(point).cost == pytest.approx(x @ forms.reduced.apply(x), rel=1e-9)


def test_a_form_of_exact_data_is_zero_at_the_truth() -> None:
    for scale in SCALES:
        simulation = simulated(3, 2, 5, noise=None, scale=scale)
        form = reduced(simulation.problem)
        x = homogeneous(true_rotations(simulation))
        assert abs(x @ form.apply(x)) < 1e-13 * form.magnitude


def test_generalised_inverse_of_every_rank() -> None:
    generator = np.random.default_rng(0)
    for rank in range(5):
        V = generator.standard_normal((4, rank)) * np.array([1.0, 1e-3, 1e3, 1.0])[:, None]
        M = V @ V.T
        F, null = generalised_inverse_factor(M)
        inverse = F @ F.T
        np.testing.assert_allclose(M @ inverse @ M, M, atol=1e-9 * max(1.0, np.abs(M).max()))
        if rank:
            assert null.shape[1] == 4 - rank
            np.testing.assert_allclose(M @ null, 0.0, atol=1e-9 * np.abs(M).max())
        else:
            assert not F.any()
            assert not null.any()


def test_variables_that_the_problem_does_not_have_stay_out() -> None:
    M = np.diag([2.0, 0.0, 3.0, 0.0])
    F, null = generalised_inverse_factor(M)
    assert not F[[1, 3]].any()
    assert not null.any()


@pytest.mark.parametrize("targets", [1, 3])
def test_a_scale_that_motion_leaves_open_is_set_to_one(targets: int) -> None:
    """A carrier that does not move: the scale is anybody's, and recovery says 1, at the same cost."""
    problem = rw.Problem(scale="shared")
    simulation = simulated(targets, 1, 0, motion="none", scale="shared", noise=None)
    for target, sensor in simulation.problem.pairs:
        data = simulation.problem.measurements(target, sensor)
        problem.add(target, sensor, np.repeat(data.A[:1], 5, axis=0), np.repeat(data.B[:1], 5, axis=0))
    part = part_of(problem)
    forms = PartForm.of(part)
    answer = answer_of(part, forms.reduced, true_rotations(simulation))
    assert answer.scale == pytest.approx(1.0)
    assert abs(forms.cost.at(as_point(part, answer)).cost) < 1e-12 * forms.reduced.magnitude
