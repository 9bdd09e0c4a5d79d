"""The cost of raw measurements in exact arithmetic, and sums of residuals in plain doubles that are near enough."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from exact_cost import RationalPoses, exact_cost
from given_rows import rows
from rwhec_factors import se3
from small_problems import optimum, simulated, whole
from stated_cost import Poses

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import measured_form, residual_sums
from gtsam_rwhec.solver import residual_sums as plain_residuals
from gtsam_rwhec.solver.answers import Answer
from gtsam_rwhec.solver.measured_form import MeasuredForm
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Given, parts_of
from gtsam_rwhec.solver.residual_sums import Coefficients, Measured, Sums, cost_sums, weighted_sums


def far_from_the_origin(seed: int, scale: str, offset_m: float, noise: Noise, *, with_knowledge: bool) -> rw.Problem:
    """Two targets, two sensors and motions, with the origins of both carriers moved away."""
    simulation = general(
        2, 2, seed=seed, noise=noise, number_of_measurements=5, scale=scale, odometry=3, odometry_noise=noise
    )
    generator = np.random.default_rng(seed)
    left, right = np.eye(4), np.eye(4)
    left[:3, 3], right[:3, 3] = offset_m * generator.standard_normal((2, 3))
    problem = rw.Problem(scale)
    for pair in simulation.problem.pairs:
        raw = simulation.problem.measurements(*pair)
        if pair.is_motion:
            problem.add_motion(pair.sensor, left @ raw.A @ np.linalg.inv(left), raw.B, raw.sigma, raw.kappa)
        else:
            problem.add(*pair, left @ raw.A @ right, raw.B, raw.sigma, raw.kappa)
    if with_knowledge:
        X = {name: np.linalg.inv(right) @ T for name, T in simulation.X.items()}
        problem.add_prior("target0", X["target0"], sigma=0.02, kappa=300.0)
        problem.add_prior("target0", X["target0"], kappa=30.0)
        if scale == "per_target":
            problem.fix_scale("target1", 1.25)
        problem.fix("target1", X["target1"])
    return problem


def exact(problem: rw.Problem, form: PartForm, answer: Answer) -> Fraction:
    """J of the poses as they are returned, exactly."""
    part, of = form.part, rows([(*pair, *batch(problem, pair)) for pair in problem.pairs], problem)
    moved = zip(part.free, answer.R, answer.t, strict=True)
    poses = {**problem.fixed, **{name: se3.pose(R, t + part.frame_shift(name)) for name, R, t in moved}}
    own = dict(zip(part.free, answer.own_scale.tolist(), strict=True))
    centre = np.full((len(of.frames), 3), np.nan)
    for x, y in zip(of.X, of.Y, strict=True):
        centre[x] = part.gauge.sensor_carrier if x == y else part.gauge.target_carrier
    given = Poses.of(of, poses, answer.scale if problem.scale == "shared" else own)
    return exact_cost(of, part.kind, centre, RationalPoses.of(given))


def batch(problem: rw.Problem, pair: Pair) -> tuple[Array, ...]:
    raw = problem.measurements(*pair)
    return raw.A, raw.B, raw.sigma, raw.kappa


CASES = [
    (scale, offset, noise, known)
    for scale in ("known", "shared", "per_target")
    for offset, noise in ((0.0, Noise(0.01, 6500.0)), (1e3, Noise(1e-6, 1e12)), (1e6, Noise(1e-6, 1e5)))
    for known in (False, True)
]


@pytest.mark.parametrize(("scale", "offset_m", "noise", "known"), CASES)
def test_the_cost_of_returned_poses_is_enclosed(scale: str, offset_m: float, noise: Noise, known: bool) -> None:
    problem = far_from_the_origin(3, scale, offset_m, noise, with_knowledge=known)
    form = whole(problem)
    answer, evaluation = form.answer_near(optimum(problem).R)
    true = exact(problem, form, answer)
    # A prior's residual t' + R'(t_0 - c) has the length of t - t_0 for exact rotations: the stored ones are rounded.
    allowed = Fraction(evaluation.cost_error) + (Fraction(1, 10**14) * true if problem.priors else 0)
    assert abs(Fraction(evaluation.cost) - true) <= allowed
    assert evaluation.cost_error <= 1e-8 * evaluation.cost
    assert Fraction(evaluation.upper) * (1 + Fraction(1, 10**14)) >= true


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize("known", [False, True])
def test_the_gradient_and_the_action_are_those_of_the_stored_form(scale: str, known: bool) -> None:
    """Near the origin both ways to the cost agree up to the rounding of the moments."""
    problem = far_from_the_origin(1, scale, 0.0, Noise(0.01, 6500.0), with_knowledge=known)
    lean = rw.Problem(scale, keep_measurements=False)
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        if pair.is_motion:
            lean.add_motion(pair.sensor, raw.A, raw.B, raw.sigma, raw.kappa)
        else:
            lean.add(*pair, raw.A, raw.B, raw.sigma, raw.kappa)
    lean._learn(problem)
    measured, stored = whole(problem), whole(lean)
    point = measured.answer_near(optimum(problem).R)[1].point
    one, other = measured.cost.at(point), stored.cost.at(point)
    assert one.cost == pytest.approx(other.cost, rel=1e-11)
    scales = np.sqrt(np.maximum(measured.curvature.diagonal, 1e-300) * one.cost)
    used = np.append(np.isin(np.arange(13 * len(point.numbers)) % 13, (3,), invert=True), scale == "shared")
    np.testing.assert_allclose((one.gradient - other.gradient)[used] / scales[used], 0.0, atol=1e-9)
    V: Array = np.random.default_rng(0).standard_normal((len(one.gradient), 2)) * used[:, None]
    of_one, of_other = measured.cost.action(one, V), stored.cost.action(other, V)
    size = float(np.abs(of_other.VQV).max())
    np.testing.assert_allclose(of_one.VQV, of_other.VQV, atol=1e-11 * size)
    np.testing.assert_allclose(of_one.VQx, of_other.VQx, atol=1e-10 * np.sqrt(size * one.cost))
    np.testing.assert_allclose(of_one.QV[used], of_other.QV[used], atol=1e-10 * size)


def test_many_measurements_in_blocks_are_the_same_as_in_stacks() -> None:
    """5,000 measurements of one pair go block by block; in batches of 100 they go stack by stack."""
    raw = simulated(1, 1, number_of_measurements=5000).problem.measurements("target0", "sensor0")
    whole_batch, small_batches = rw.Problem(), rw.Problem()
    whole_batch.add("target0", "sensor0", raw.A, raw.B, raw.sigma, raw.kappa)
    for first in range(0, 5000, 100):
        part = slice(first, first + 100)
        small_batches.add("target0", "sensor0", raw.A[part], raw.B[part], raw.sigma[part], raw.kappa[part])
    form = whole(whole_batch)
    point = form.answer_near(optimum(whole_batch).R)[1].point
    in_batches = Given.of(small_batches, form.part.pairs, frozenset(form.part.names))
    assert in_batches is not None
    one, other = form.cost.at(point), MeasuredForm(form.part, in_batches, form.slots).at(point)
    assert abs(one.cost - other.cost) <= one.cost_error + other.cost_error
    assert (np.abs(one.gradient - other.gradient) <= one.gradient_error + other.gradient_error).all()
    assert max(one.cost_error, other.cost_error) <= 1e-12 * one.cost


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
def test_pairs_that_were_added_many_at_once_are_enclosed_as_single_ones_are(
    scale: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also with few pairs at a time, in plain doubles and in exact slices."""
    single = far_from_the_origin(5, scale, 10.0, Noise(0.01, 6500.0), with_knowledge=True)
    raw = {pair: single.measurements(*pair) for pair in single.pairs}
    seen = [pair for pair in single.pairs if not pair.is_motion]
    # The last pair has fewer measurements than the others: it is padded.
    counts = [len(raw[pair].A) - 2 * (pair == seen[-1]) for pair in seen]
    index = np.repeat(np.arange(len(seen)), counts)
    order = np.random.default_rng(2).permutation(len(index))
    together = {
        name: np.concatenate([getattr(raw[pair], name)[:count] for pair, count in zip(seen, counts, strict=True)])[
            order
        ]
        for name in ("A", "B", "sigma", "kappa")
    }
    many = rw.Problem(scale)
    many.add_many(seen, index[order], **together)
    for pair in single.pairs:
        if pair.is_motion:
            many.add_motion(pair.sensor, raw[pair].A, raw[pair].B, raw[pair].sigma, raw[pair].kappa)
    many._learn(single)
    form = whole(many)
    answer, one = form.answer_near(optimum(many).R)
    true = exact(many, form, answer)
    found = [one]
    for pairs, enough in ((2, plain_residuals.MANY), (3, 1), (1, plain_residuals.MANY)):
        monkeypatch.setattr(measured_form, "PAIRS_AT_ONCE", pairs)
        monkeypatch.setattr(plain_residuals, "MANY", enough)
        found.append(form.evaluated(answer))
    V: Array = np.random.default_rng(0).standard_normal((len(one.gradient), 2))
    actions = [form.cost.action(each, V) for each in found]
    for each, action in zip(found, actions, strict=True):
        assert abs(Fraction(each.cost) - true) <= Fraction(each.cost_error) + Fraction(1, 10**14) * true
        assert each.cost_error <= 1e-9 * each.cost
        assert (np.abs(each.gradient - one.gradient) <= each.gradient_error + one.gradient_error).all()
        for name in ("QV", "VQV", "VQx"):
            error = getattr(action, f"{name}_error") + getattr(actions[0], f"{name}_error")
            assert (np.abs(getattr(action, name) - getattr(actions[0], name)) <= error).all()


def inputs(scale: rw.ScaleMode, *, uniform: bool, offset_m: float, sigma_m: float) -> tuple[Measured, Coefficients]:
    """What the sums of the answer of a problem with two targets and two sensors are made of."""
    noise = Noise(sigma_m=sigma_m, kappa=0.5 / sigma_m**2)
    simulated = general(2, 2, seed=3, noise=noise, number_of_measurements=3000, scale=scale).problem
    generator = np.random.default_rng(4)
    problem = rw.Problem(scale)
    left = se3.pose(np.eye(3), (offset_m, -offset_m, offset_m))
    for pair in simulated.pairs:
        raw = simulated.measurements(*pair)
        many = 1.0 if uniform else generator.uniform(0.5, 2.0, len(raw.A))
        problem.add(*pair, left @ raw.A, raw.B, noise.sigma_m * many, noise.kappa * many)
    (part,) = parts_of(problem)
    form = PartForm.of(part)
    _, evaluation = form.answer_near(optimum(problem).R)
    whole = slice(0, len(part.pairs))
    return form.cost._coefficients(evaluation.ends(whole), whole)


def off_by(first: Sums, second: Sums) -> float:
    """The largest difference of two sums, in terms of both bounds together."""
    differences = [np.abs(a - b) for a, b in zip(_values(first), _values(second), strict=True)]
    bounds = [a + b for a, b in zip(_errors(first), _errors(second), strict=True)]
    return max(float((off / np.maximum(bound, 1e-300)).max()) for off, bound in zip(differences, bounds, strict=True))


def _values(sums: Sums) -> list[np.ndarray]:
    return [sums.products, *sums.by_features]


def _errors(sums: Sums) -> list[np.ndarray]:
    return [sums.products_error, *sums.by_features_error]


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize("uniform", [True, False])
def test_within_their_bounds_of_the_exact_sums(scale: rw.ScaleMode, uniform: bool) -> None:
    measured, coefficients = inputs(scale, uniform=uniform, offset_m=5.0, sigma_m=0.01)
    plain, exact = cost_sums(measured, coefficients), weighted_sums(measured, coefficients)
    assert 0.0 < off_by(plain, exact) <= 1.0
    assert exact.products_error.sum() < plain.products_error.sum() <= residual_sums.KNOWN * plain.products.sum()


def test_bounds_hold_where_doubles_tell_little() -> None:
    measured, coefficients = inputs("known", uniform=True, offset_m=1e6, sigma_m=1e-6)
    plain, exact = weighted_sums(measured, coefficients, exact=False), weighted_sums(measured, coefficients)
    assert plain.products_error.sum() > residual_sums.KNOWN * plain.products.sum()
    assert off_by(plain, exact) <= 1.0
    assert np.abs(plain.products - exact.products).sum() > exact.products_error.sum()
    assert off_by(cost_sums(measured, coefficients), exact) == 0.0


def test_few_measurements_are_summed_exactly() -> None:
    measured, coefficients = inputs("known", uniform=True, offset_m=0.0, sigma_m=0.01)
    few = Measured(measured.batches[:1], measured.a, measured.c, measured.is_swapped)
    assert off_by(cost_sums(few, coefficients), weighted_sums(few, coefficients)) == 0.0
