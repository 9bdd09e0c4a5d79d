"""Horn 2023: its quadratic form, its relaxation and polishing, and what the quaternions' signs do to it."""

from __future__ import annotations

import numpy as np
import pytest
from method_problems import exchanged, four_targets, one_pair
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.quaternions import conjugate, left, of_rotations
from gtsam_rwhec.methods import run
from gtsam_rwhec.methods.horn2023 import (
    DualQuaternionAnswer,
    Signs,
    form_of,
    horn2023,
    multipliers_of,
    polished,
    relaxed,
    residual_rows,
    signed_quaternions,
    solve_dual_quaternions,
    vector_of,
)
from gtsam_rwhec.methods.linear_systems import Stack
from gtsam_rwhec.methods.method import MethodOptions
from gtsam_rwhec.simulate import Noise, Simulation

LARGE = Noise(0.01, 12.0, "released")


def dual_quaternion(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    q = of_rotations(T[None, :3, :3])[0]
    return q, 0.5 * left(np.r_[T[:3, 3], 0.0]) @ q


def product(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return np.concatenate([left(a[0]) @ b[0], left(a[0]) @ b[1] + left(a[1]) @ b[0]])


def errors_m(simulation: Simulation, answer: DualQuaternionAnswer) -> np.ndarray:
    truth = {**simulation.X, **simulation.Y}
    names = [*simulation.problem.targets, *simulation.problem.sensors]
    return np.array([np.linalg.norm(t - truth[name][:3, 3]) for name, t in zip(names, answer.t, strict=True)])


def test_the_form_is_the_sum_of_squares_of_a_x_minus_y_b() -> None:
    simulation = four_targets()
    stack = Stack.of(simulation.problem)
    q_A, q_B = signed_quaternions(stack, "random", 0)
    generator = np.random.default_rng(0)
    T = se3.expmap(generator.standard_normal((5, 6)))
    q, t = of_rotations(T[:, :3, :3]), T[:, :3, 3]
    z = vector_of(q, t)
    expected = 0.0
    for i in range(len(stack.A)):
        a, b = dual_quaternion(stack.A[i]), dual_quaternion(stack.B[i])
        # the same signs as the form's
        a, b = (tuple(np.sign(p[0] @ s) * half for half in p) for p, s in ((a, q_A[i]), (b, q_B[i])))
        x, y = (tuple(z.reshape(5, 2, 4)[k]) for k in (stack.target[i], 4))
        expected += np.sum((product(a, x) - product(y, b)) ** 2)
    assert z @ form_of(stack, *residual_rows(stack, q_A, q_B)) @ z == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("noise", [Noise(0.01, 125.0, "released"), pytest.param(LARGE, marks=pytest.mark.slow)])
def test_the_relaxation_is_tight_and_its_bound_is_one(noise: Noise) -> None:
    stack = Stack.of(four_targets(noise).problem)
    answer = solve_dual_quaternions(stack)
    assert answer.contradicted == 0
    assert 0.0 <= answer.gap < 1e-8
    q_A, q_B = signed_quaternions(stack, "aligned", 0)
    Q = form_of(stack, *residual_rows(stack, q_A, q_B))
    _, _, bound = relaxed(Q, 5)
    assert bound == pytest.approx(answer.cost, rel=1e-6)
    generator = np.random.default_rng(3)
    for _ in range(5):  # no descent from anywhere goes below
        q = generator.standard_normal((5, 4))
        q /= np.linalg.norm(q, axis=1)[:, None]
        q, t, cost = polished(Q, q, generator.standard_normal((5, 3)))
        assert cost >= answer.lower_bound * (1.0 - 1e-9)
        value, smallest = multipliers_of(Q, q, t)
        assert value == pytest.approx(cost, rel=1e-6)
        assert (cost < answer.cost * (1.0 + 1e-6)) == (smallest > -1e-6)


@pytest.mark.parametrize("signs", ["scalar", "random"])
def test_wrong_signs_give_a_wrong_answer_with_a_perfect_certificate(signs: Signs) -> None:
    simulation = four_targets(None)
    stack = Stack.of(simulation.problem)
    wrong, right = solve_dual_quaternions(stack, signs), solve_dual_quaternions(stack)
    assert errors_m(simulation, right).max() < 1e-6
    assert errors_m(simulation, wrong).max() > 0.5
    assert wrong.gap < 1e-6
    assert wrong.contradicted > 10
    # what is contradicted is what differs, pair by pair, up to the sign of the pair
    differs = stack.sums((wrong.signs != right.signs).astype(float))
    assert np.minimum(differs, stack.counts - differs).sum() > 10
    notes = horn2023(simulation.problem, MethodOptions(), signs).notes
    assert any("contradict" in note for note in notes)
    assert not any("contradict" in note for note in run("horn2023", simulation.problem).notes)


@pytest.mark.parametrize(
    "seeds",
    [pytest.param(range(9, 12), marks=pytest.mark.slow), pytest.param(range(12), marks=pytest.mark.campaign)],
    ids=["few", "all"],
)
def test_continuous_signs_are_right_until_noise_jumps_over_a_half_turn(seeds: range) -> None:
    """What the RWHEC paper's Tables 4 and 5 show of this method: a sign lost once is lost for the rest of a path."""
    lost = []
    for seed in seeds:
        simulation = four_targets(LARGE, seed)
        stack = Stack.of(simulation.problem)
        continuous, aligned = solve_dual_quaternions(stack, "continuous"), solve_dual_quaternions(stack)
        assert aligned.contradicted == 0
        lost.append(continuous.contradicted > 0)
        if not lost[-1]:
            np.testing.assert_allclose(continuous.t, aligned.t, atol=1e-9)
        else:
            assert errors_m(simulation, continuous).max() > errors_m(simulation, aligned).max()
            assert aligned.cost < continuous.cost
    assert 1 <= sum(lost) <= len(seeds) / 2
    for seed in seeds[:3:2]:
        stack = Stack.of(four_targets(Noise(0.01, 125.0, "released"), seed).problem)
        assert solve_dual_quaternions(stack, "continuous").contradicted == 0


def test_aligned_signs_do_not_depend_on_what_stands_where() -> None:
    """Nor on the order of measurements, which continuous signs follow."""
    simulation = four_targets(LARGE, 5)
    order = np.random.default_rng(0).permutation(108)
    shuffled = rw.Problem()
    for pair in simulation.problem.pairs:
        raw = simulation.problem.measurements(*pair)
        shuffled.add(*pair, raw.A[order], raw.B[order])
    here = solve_dual_quaternions(Stack.of(simulation.problem))
    there = solve_dual_quaternions(Stack.of(shuffled))
    np.testing.assert_allclose(here.t, there.t, atol=1e-8)
    assert solve_dual_quaternions(Stack.of(shuffled), "continuous").contradicted > 10
    turned = solve_dual_quaternions(Stack.of(exchanged(simulation).problem))
    assert turned.contradicted == 0


def test_a_cost_that_changes_with_the_origin() -> None:
    simulation = one_pair(LARGE)
    raw = simulation.problem.measurements("camera", "marker")
    moved = rw.Problem()
    A = raw.A.copy()
    A[:, :3, 3] += [3.0, 0.0, 0.0]  # the sensor's carrier elsewhere: Y moves along, X stays
    moved.add("camera", "marker", A, raw.B)
    X, X_moved = run("horn2023", simulation.problem).X["camera"], run("horn2023", moved).X["camera"]
    assert np.abs(X.matrix() - X_moved.matrix()).max() > 1e-3


def test_other_signs_are_refused_by_name() -> None:
    with pytest.raises(OptionError, match="aligned"):
        horn2023(one_pair().problem, MethodOptions(), "given")  # type: ignore[arg-type]


def test_the_other_residual_is_x_against_what_each_measurement_makes_of_y() -> None:
    simulation = four_targets()
    stack = Stack.of(simulation.problem)
    q_A, q_B = signed_quaternions(stack, "aligned", 0)
    Q = form_of(stack, *residual_rows(stack, q_A, q_B, "x - a* y b"))
    frames = [T for frame in (simulation.X, simulation.Y) for T in frame.values()]
    z = np.concatenate([np.concatenate(dual_quaternion(T)) for T in frames])
    expected = 0.0
    for i in range(len(stack.A)):
        made = np.linalg.inv(stack.A[i]) @ frames[stack.sensor[i]] @ stack.B[i]
        x, y = z[8 * stack.target[i] :][:8], np.concatenate(dual_quaternion(made))
        # Signs as the form has them: those of q_A, q_B and the frames.
        real = left(left(conjugate(q_A[i])) @ z[32:36]) @ q_B[i]
        expected += ((x - np.sign(real @ y[:4]) * y) ** 2).sum()
    assert z @ Q @ z == pytest.approx(expected, rel=1e-9)
    truth = four_targets(None)
    found = solve_dual_quaternions(Stack.of(truth.problem), residual="x - a* y b")
    np.testing.assert_allclose(found.t, [T[:3, 3] for f in (truth.X, truth.Y) for T in f.values()], atol=1e-6)
    with pytest.raises(OptionError, match="residual"):
        solve_dual_quaternions(stack, residual="y - a x b*")  # type: ignore[arg-type]
