"""What must hold for every problem: gauges, order, batches, merging, bounds, exact data, a world far away."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_cost import naive_cost
from rwhec_factors.se3 import inverse, pose

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, Simulation, general, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses, rotations_of_vectors
from gtsam_rwhec.solver.answers import answer_of
from gtsam_rwhec.solver.bound import lower_bound
from gtsam_rwhec.solver.descent import homogeneous
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.rotations import kkt_multipliers, random_rotations

NOISE = Noise(0.01, 500.0)
SEEDS = st.integers(0, 2**31 - 1)
MODES: dict[str, dict[str, Any]] = {
    "known": dict(scale="known"),
    "shared": dict(scale="shared"),
    "per_target": dict(scale="per_target", known_sizes=("target0",)),
}
few = settings(max_examples=6, deadline=None)


def matrices(poses: dict[str, Any]) -> dict[str, np.ndarray]:
    return {name: T.matrix() if hasattr(T, "matrix") else T for name, T in poses.items()}


def scales(solution: Any) -> np.ndarray:
    return np.array(
        [s for _, s in sorted(solution.scale.items())] if isinstance(solution.scale, dict) else solution.scale
    )


def assert_same(first: rw.Solution, second: rw.Solution, tolerance_m: float, relative_cost: float) -> None:
    assert first.cost == pytest.approx(second.cost, rel=relative_cost)
    assert first.certificate.status == second.certificate.status
    np.testing.assert_allclose(scales(first), scales(second), rtol=0.0, atol=tolerance_m)
    for mine, others in ((first.X, second.X), (first.Y, second.Y)):
        assert mine.keys() == others.keys()
        for name, T in mine.items():
            np.testing.assert_allclose(T.matrix(), others[name].matrix(), rtol=0.0, atol=tolerance_m)


def batches_of(problem: rw.Problem) -> Iterator[tuple[tuple[str, str], Any]]:
    for pair in problem.pairs:
        yield pair, problem.measurements(*pair)


def put(problem: rw.Problem, pair: tuple[str, str], data: Any, part: Any = slice(None)) -> None:
    """Add some of a pair's measurements."""
    arguments = (data.A[part], data.B[part], data.sigma[part], data.kappa[part])
    if pair[0] == pair[1]:
        problem.add_motion(pair[0], *arguments)
    else:
        problem.add(*pair, *arguments)


def moved(
    problem: rw.Problem, left: np.ndarray, right: np.ndarray, batch: int | None = None, **options: Any
) -> rw.Problem:
    """The problem with other carrier frames: A becomes left A right, and a motion's A left A left^-1."""
    result = rw.Problem(problem.scale, **options)
    for pair, data in batches_of(problem):
        A = left @ data.A @ (inverse(left) if pair[0] == pair[1] else right)
        count = len(A) if batch is None else batch
        for first in range(0, len(A), count):
            part = slice(first, first + count)
            arguments = (A[part], data.B[part], data.sigma[part], data.kappa[part])
            if pair[0] == pair[1]:
                result.add_motion(pair[0], *arguments)
            else:
                result.add(*pair, *arguments)
    for name, T in problem.fixed.items():
        result.fix(name, left @ T if name in problem.sensors else inverse(right) @ T)
    for name, priors in problem.priors.items():
        for prior in priors:
            T = left @ prior.transform if name in problem.sensors else inverse(right) @ prior.transform
            result.add_prior(name, T, prior.sigma, prior.kappa)
    for name, scale in problem.fixed_scales.items():
        result.fix_scale(name, scale)
    return result


def moved_back(solution: rw.Solution, left: np.ndarray, right: np.ndarray) -> tuple[dict[str, Any], dict[str, Any]]:
    return (
        {name: right @ T for name, T in matrices(solution.X).items()},
        {name: inverse(left) @ T for name, T in matrices(solution.Y).items()},
    )


def simulated(seed: int, mode: str, **options: Any) -> Simulation:
    defaults = dict(number_of_measurements=8, noise=NOISE, odometry=4, odometry_noise=NOISE)
    return general(2, 2, seed=seed, **{**defaults, **MODES[mode], **options})


# -- gauges -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@given(SEEDS)
@few
def test_moving_a_carriers_frame_moves_its_frames_and_nothing_else(mode: str, seed: int) -> None:
    problem = simulated(seed, mode).problem
    solution = rw.solve(problem)
    T = random_poses(2, 3.0, np.random.default_rng(seed))
    for left, right in ((T[0], np.eye(4)), (np.eye(4), T[1]), (T[0], T[1])):
        other = rw.solve(moved(problem, left, right))
        X, Y = moved_back(other, left, right)
        assert other.cost == pytest.approx(solution.cost, rel=1e-9)
        assert other.certificate.status == solution.certificate.status
        np.testing.assert_allclose(scales(other), scales(solution), rtol=1e-9)
        for got, expected in ((X, matrices(solution.X)), (Y, matrices(solution.Y))):
            for name, transform in got.items():
                np.testing.assert_allclose(transform, expected[name], rtol=0.0, atol=2e-8)


@pytest.mark.parametrize("mode", MODES)
def test_known_frames_and_priors_move_along(mode: str) -> None:
    simulation = simulated(3, mode)
    problem = simulation.problem
    problem.fix("target0", simulation.X["target0"])
    problem.add_prior("sensor1", simulation.Y["sensor1"] @ pose(np.eye(3), [0.03, 0.0, -0.02]), sigma=0.05, kappa=40.0)
    left, right = random_poses(2, 3.0, np.random.default_rng(1))
    solution, other = rw.solve(problem), rw.solve(moved(problem, left, right))
    X, Y = moved_back(other, left, right)
    assert other.cost == pytest.approx(solution.cost, rel=1e-9)
    for name, T in matrices({**solution.X, **solution.Y}).items():
        np.testing.assert_allclose({**X, **Y}[name], T, rtol=0.0, atol=2e-8)


# -- order, batches, merging ------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@given(SEEDS, st.integers(1, 20))
@settings(max_examples=6, deadline=None)
def test_order_and_batches_do_not_matter(mode: str, seed: int, size: int) -> None:
    # More measurements than the first that settle where to centre, and weights of their own.
    problem = simulated(seed % 50, mode, number_of_measurements=18).problem
    generator = np.random.default_rng(seed)
    pieces = []
    for pair, data in batches_of(problem):
        order = generator.permutation(len(data.A))
        pieces += [(pair, data, order[first : first + size]) for first in range(0, len(order), size)]
    shuffled = rw.Problem(problem.scale, keep_measurements=False)
    for i in generator.permutation(len(pieces)):
        put(shuffled, *pieces[i])
    for name, scale in problem.fixed_scales.items():
        shuffled.fix_scale(name, scale)
    first, second = rw.solve(problem), rw.solve(shuffled)
    assert_same(first, second, 1e-8, 1e-9)
    assert first.identifiability.weakest == pytest.approx(second.identifiability.weakest, rel=1e-6)
    for pair, residual in first.residuals.items():
        assert residual.number_of_measurements == second.residuals[pair].number_of_measurements
        assert residual.translation_rms_m == pytest.approx(second.residuals[pair].translation_rms_m, rel=1e-7)
        assert residual.rotation_rms_rad == pytest.approx(second.residuals[pair].rotation_rms_rad, rel=1e-7)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("count", [5, 90], ids=["before centring settles", "after"])
@given(SEEDS)
@settings(max_examples=6, deadline=None)
def test_merging_is_adding(mode: str, count: int, seed: int) -> None:
    """Logs of three drives, each centred on its own, some with odometry only."""
    problem = simulated(seed % 50, mode, number_of_measurements=count, odometry=count).problem
    generator = np.random.default_rng(seed)
    logs = [rw.Problem(problem.scale, keep_measurements=bool(generator.integers(2))) for _ in range(3)]
    for pair, data in batches_of(problem):
        cuts = np.sort(generator.integers(0, len(data.A) + 1, 2))
        for log, part in zip(logs, np.split(np.arange(len(data.A)), cuts), strict=True):
            if len(part) and (pair[0] == pair[1] or log is not logs[0]):
                put(log, pair, data, part)
            elif len(part):
                put(logs[1], pair, data, part)
    for name, scale in problem.fixed_scales.items():
        logs[int(generator.integers(3))].fix_scale(name, scale)
    order = generator.permutation(3)
    merged = logs[order[0]] + logs[order[1]] + logs[order[2]]
    assert merged.number_of_measurements == problem.number_of_measurements
    assert_same(rw.solve(merged), rw.solve(problem), 1e-8, 1e-9)


# -- bounds -----------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")  # so much noise
@pytest.mark.parametrize("mode", MODES)
@given(SEEDS)
@few
def test_the_bound_is_below_the_cost_of_every_answer(mode: str, seed: int) -> None:
    simulation = simulated(seed, mode, noise=Noise(0.3, 2.0), number_of_measurements=6)
    problem = simulation.problem
    try:
        solution = rw.solve(problem, options=rw.SolveOptions(random_starts=0))
    except rw.errors.ScaleError:
        return  # the noise drowned the scale: no answer, no bound
    bound = solution.certificate.lower_bound
    assert bound <= solution.cost
    (part,) = parts_of(problem)
    generator = np.random.default_rng(seed)
    size = len(solution.X) + len(solution.Y)
    near = [
        T @ N
        for T, N in zip(matrices({**solution.X, **solution.Y}).values(), small_poses(size, generator), strict=True)
    ]
    truth = list({**simulation.X, **simulation.Y}.values())
    for poses in (near, truth, list(random_poses(size, 2.0, generator))):
        X = dict(zip(solution.X, poses, strict=False))
        Y = dict(zip(solution.Y, poses[len(X) :], strict=True))
        cost = naive_cost(problem, X, Y, solution.scale, part.kind, part.gauge)
        assert bound <= cost * (1.0 + 1e-12)


def small_poses(count: int, generator: np.random.Generator) -> np.ndarray:
    """Poses near the identity: within a milliradian and a millimetre or so."""
    return pose(
        rotations_of_vectors(1e-3 * generator.standard_normal((count, 3))), 1e-3 * generator.standard_normal((count, 3))
    )


@pytest.mark.parametrize("mode", MODES)
@given(SEEDS, st.sampled_from([0.0, 1e-6, 1.0, 1e3]))
@few
def test_any_multipliers_bound_the_cost_at_any_rotations(mode: str, seed: int, size: float) -> None:
    problem = simulated(seed, mode, noise=Noise(0.1, 20.0)).problem
    (part,) = parts_of(problem)
    forms = PartForm.of(part)
    form = forms.reduced
    generator = np.random.default_rng(seed)
    R = random_rotations(form.rotations, generator)
    multipliers = kkt_multipliers(R, form.apply(homogeneous(R))[:-1].reshape(-1, 9))
    multipliers += size * generator.standard_normal(multipliers.shape)
    bound = lower_bound(forms, forms.evaluated(answer_of(part, form, R)), multipliers)
    assert bound.region is None  # x'Q'x below takes the best translations, wherever they are
    assert np.isfinite(bound.lower_bound)
    others = random_rotations(20 * form.rotations, generator).reshape(20, form.rotations, 3, 3)
    for rotations in (R, *others):
        x = homogeneous(rotations)
        assert bound.lower_bound <= x @ form.apply(x)


# -- exact data -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        dict(scale="known"),
        dict(scale="shared"),
        dict(scale="per_target"),
        dict(scale="per_target", known_sizes=("target0",), odometry=4),
        dict(scale="known", odometry=5),
        dict(scale="shared", odometry=5),
    ],
    ids=str,
)
@given(SEEDS, st.integers(1, 3), st.integers(1, 3), st.sampled_from(["complete", "star", "random"]))
@few
def test_without_noise_the_truth_comes_back(options: Any, seed: int, targets: int, sensors: int, graph: Any) -> None:
    simulation = general(targets, sensors, seed=seed, graph=graph, number_of_measurements=8, **options)
    solution = rw.solve(simulation.problem)
    assert solution.certificate.is_certified
    assert solution.cost < 1e-12
    errors = simulation.errors(solution)
    for error in (*errors.X.values(), *errors.Y.values()):
        assert error.translation_m < 1e-8
        assert error.rotation_rad < 1e-8
    relative = errors.relative_scale
    assert max(relative.values() if isinstance(relative, dict) else [relative]) < 1e-8


@pytest.mark.parametrize("scale", ["known", "shared"])
@given(SEEDS)
@few
def test_without_noise_odometry_alone_gives_the_truth(scale: Any, seed: int) -> None:
    """AX = XB."""
    simulation = general(0, 1, seed=seed, odometry=10, scale=scale)
    solution = rw.solve(simulation.problem)
    assert solution.certificate.is_certified
    error = simulation.errors(solution)
    assert error.Y["sensor0"].translation_m < 1e-8
    assert error.Y["sensor0"].rotation_rad < 1e-8


# -- a world far away -------------------------------------------------------------------------------

FAR = {"1 km": (1e3, 1e-9), "1,000 km": (1e6, 1e-6)}
BATCHES: dict[str, dict[str, Any]] = {
    "at once": dict(),
    "one at a time": dict(batch=1),
    "small batches, not kept": dict(batch=7, keep_measurements=False),
}


def assert_as_if_near(problem: rw.Problem, distance: str, side: str, how: dict[str, Any]) -> None:
    """The carrier's frames as if it had not been moved: the same to the rounding of the moved poses."""
    far_m, tolerance = FAR[distance]
    direction = np.array([0.6, -0.64, 0.48])
    shift, eye = pose(np.eye(3), far_m * direction), np.eye(4)
    left, right = (shift, eye) if side == "sensor carrier" else (eye, shift)
    near, far = rw.solve(problem), rw.solve(moved(problem, left, right, **how))
    X, Y = moved_back(far, left, right)
    assert far.certificate.status == near.certificate.status
    assert far.cost == pytest.approx(near.cost, rel=tolerance)
    # One frame against another of the same carrier, and each against its carrier: a far frame holds no more digits.
    for got, expected in ((X, matrices(near.X)), (Y, matrices(near.Y))):
        for name, T in got.items():
            np.testing.assert_allclose(T, expected[name], rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("how", BATCHES)
@pytest.mark.parametrize("side", ["sensor carrier", "target carrier"])
@pytest.mark.parametrize("distance", FAR)
@pytest.mark.parametrize("mode", MODES)
def test_a_world_far_away_changes_nothing(mode: str, distance: str, side: str, how: str) -> None:
    problem = simulated(1, mode, number_of_measurements=30).problem
    assert_as_if_near(problem, distance, side, BATCHES[how])


def driving_after_rest(of_rest: Noise | None) -> rw.Problem:
    """Sixty poses of a drive after three thousand of its first one, which have noise of their own or none."""
    simulation = general(1, 1, seed=2, number_of_measurements=60)
    driving = simulation.problem.measurements("target0", "sensor0").A
    generator, rest = np.random.default_rng(0), np.repeat(driving[:1], 3000, axis=0)
    A = np.concatenate([rest if of_rest is None else perturb(rest, of_rest, generator), driving])
    B = perturb(inverse(simulation.Y["sensor0"]) @ A @ simulation.X["target0"], NOISE, generator)
    problem = rw.Problem()
    problem.add("target0", "sensor0", A, B, NOISE.sigma_m, NOISE.kappa)
    return problem


@pytest.mark.parametrize(
    "how", [dict(batch=100), dict(keep_measurements=False)], ids=["in batches, kept", "at once, not kept"]
)
@pytest.mark.parametrize("side", ["sensor carrier", "target carrier"])
@pytest.mark.parametrize("distance", FAR)
def test_a_log_that_begins_at_rest_far_away(distance: str, side: str, how: dict[str, Any]) -> None:
    """Many measurements near one pose say little of where to centre; the others do."""
    assert_as_if_near(driving_after_rest(Noise(1e-4, 1e7)), distance, side, how)


@pytest.mark.parametrize("side", ["sensor carrier", "target carrier"])
def test_a_log_that_begins_with_one_pose_repeated(side: str) -> None:
    """As an arm at rest gives it; centred by looking at the whole batch, for nothing is kept to begin anew."""
    assert_as_if_near(driving_after_rest(None), "1,000 km", side, dict(keep_measurements=False))


@pytest.mark.parametrize("how", BATCHES)
@pytest.mark.parametrize("distance", FAR)
def test_the_real_dataset_far_away(utias_folder: Path, distance: str, how: str) -> None:
    problem = rw.read_csv(utias_folder, sigma=1.0, kappa=1.0)
    side = "target carrier" if distance == "1 km" else "sensor carrier"
    assert_as_if_near(problem, distance, side, BATCHES[how])
