"""A stream says after each measurement what a batch of the same measurements says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rwhec_factors.se3 import expmap
from streamed import One, add, farthest, ones_of, streamed

import gtsam_rwhec as rw
from gtsam_rwhec.errors import (
    FrameError,
    MeasurementsNotKeptError,
    NoiseError,
    OptionError,
    PoseError,
    RwhecError,
    StampError,
    UnderdeterminedError,
)
from gtsam_rwhec.geometry.pose_covariances import error_of
from gtsam_rwhec.problem.selection import reweighted
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(sigma_m=0.002, kappa=1.0 / (2.0 * 0.003**2))


def ones(seed: int = 1, count: int = 8, **options: object) -> list[One]:
    """Measurements of two targets by two sensors."""
    return ones_of(general(2, 2, seed=seed, number_of_measurements=count, noise=NOISE, **options).problem)


@settings(max_examples=3, deadline=None)
@given(st.permutations(range(16)), st.integers(0, 3))
def test_any_order_of_arrival_gives_the_same_final_problem(order: list[int], seed: int) -> None:
    every = ones(seed, 4)
    first, second = (streamed(ones, robust=False) for ones in (every, [every[i] for i in order]))
    for pair in first.problem.pairs:
        raw = [vars(of.problem.measurements(*pair)) for of in (first, second)]
        for one, other in zip(*(each.values() for each in raw), strict=True):
            assert np.array_equal(one, other) if one is not None else other is None
    assert first.problem.pairs == second.problem.pairs


def test_the_final_answer_is_the_batchs() -> None:
    simulation = general(2, 2, seed=2, number_of_measurements=12, noise=NOISE)
    every = ones_of(simulation.problem)
    found = streamed([every[i] for i in np.random.default_rng(0).permutation(len(every))]).calibrate()
    batch = rw.calibrate(simulation.problem)
    assert farthest(found, batch) < 1e-9
    assert found.judgement.verdict == batch.judgement.verdict


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@settings(max_examples=2, deadline=None)
@given(st.integers(0, 1000), st.integers(18, 24))
def test_after_each_measurement_it_is_what_solve_finds(scale: rw.ScaleMode, seed: int, count: int) -> None:
    every = ones(seed, 8, scale=scale)
    order = np.random.default_rng(seed).permutation(len(every))[:count]
    stream = streamed([every[i] for i in order], rw.Problem(scale), robust=False)
    update = stream.last
    assert update.certificate is not None
    assert update.certificate.lower_bound <= update.certificate.cost
    assert update.certificate.is_certified
    assert not update.outliers
    batch = rw.solve(reweighted(stream.problem, {}, update.noise_factors))
    # Of the inverse equation the cost depends on the gauge, which is another one here.
    assert farthest(update, batch) < (1e-9 if scale != "per_target" else 1e-4)
    if scale != "per_target":
        assert update.certificate.cost == pytest.approx(batch.cost, rel=1e-9)


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 1000), st.integers(0, 15), st.floats(0.0, 1.0))
def test_add_then_remove_gives_what_was(seed: int, which: int, size: float) -> None:
    every = ones(seed, 4)
    stream = streamed(every[:which] + every[which + 1 :], noise="given")
    before = stream.last
    added = add(stream, every[which].off_by([size] * 6))
    after = stream.remove(added.number)
    assert farthest(before, after) < 1e-9
    assert before.outliers == after.outliers == ()
    assert before.refined is not None
    assert after.refined is not None
    np.testing.assert_allclose(after.refined.covariance(), before.refined.covariance(), rtol=1e-9, atol=1e-18)
    assert (before.measurements, before.counting) == (after.measurements, after.counting)


def test_covariances_are_those_of_a_refinement_of_the_same_measurements() -> None:
    stream = streamed(ones_of(general(1, 1, seed=3, number_of_measurements=60, noise=NOISE).problem))
    refined = stream.last.refined
    problem = stream.problem
    batch = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    assert refined is not None
    assert refined.degrees_of_freedom == pytest.approx(batch.degrees_of_freedom, rel=0.02)
    for name in (*stream.last.X, *stream.last.Y):
        ratio = np.concatenate(refined.standard_deviations(name)) / np.concatenate(batch.standard_deviations(name))
        np.testing.assert_allclose(ratio, 1.0, atol=0.05)
    point = stream.last.uncertainty_at([0.0, 0.0, 0.8], "sensor0")
    assert 0.1 < point.radius_mm < 10.0


def boards_at_once(seed: int, takes: int) -> tuple[list[One], np.ndarray]:
    """Three boards that a camera sees at each pose of an arm whose noise is larger than the camera's; the camera."""
    simulation = general(3, 1, seed=seed, number_of_measurements=takes)
    rng = np.random.default_rng(seed)
    first = simulation.problem.measurements("target0", "sensor0").A
    Y, every = simulation.Y["sensor0"], []
    for stamp, A in enumerate(first):
        measured = expmap(rng.normal(0.0, [2e-4] * 3 + [5e-4] * 3, (1, 6)))[0] @ A
        for target, X in simulation.X.items():
            B = np.linalg.inv(Y) @ A @ X @ expmap(rng.normal(0.0, [3e-4] * 3 + [1e-4] * 3, (1, 6)))[0]
            every.append(One(target, "sensor0", measured, B, stamp, 1.0, 1.0))
    return every, Y


@pytest.mark.slow
def test_measurements_of_one_stamp_share_the_arms_error() -> None:
    squares, alones = [], []
    for seed in range(24):
        every, Y = boards_at_once(seed, 6)
        update = streamed(every, robust=False).last
        e = error_of(update.refined.Y["sensor0"], Y)
        covariance = update.refined.covariance("sensor0")
        squares.append(e @ np.linalg.solve(covariance, e) / update.refined.squared_radius(6))
        alone = replace(update, _counting=None).refined
        alones.append(e @ np.linalg.solve(alone.covariance("sensor0"), e) / alone.squared_radius(6))
    assert np.sum(np.array(squares) <= 1.0) >= 21  # fewer by chance in 1 of 35 where 95 % is true
    assert np.sum(np.array(alones) <= 1.0) < 18  # as if errors were independent


def test_what_is_shared_widens_moments_too() -> None:
    every, _ = boards_at_once(3, 40)
    kept, flat = (
        streamed(every, robust=False, keep=keep, window=64).last.refined for keep in ("measurements", "moments")
    )
    ratio = np.trace(flat.covariance("sensor0")) / np.trace(kept.covariance("sensor0"))
    assert 0.7 < ratio < 3.0


def test_an_update_stays_as_it_was() -> None:
    every, _ = boards_at_once(4, 8)
    stream, twin = (streamed(every[:20], robust=False) for _ in range(2))
    before = stream.last
    add(stream, every[20])
    stream.remove(3)
    np.testing.assert_array_equal(before.refined.covariance(), twin.last.refined.covariance())


def test_covariances_that_are_stated_are_kept_and_judged_by() -> None:
    every = ones(12, 10)
    stated = np.diag([0.003, 0.003, 0.003, 0.001, 0.001, 0.003]) ** 2
    stream = rw.Stream()
    for one in every:
        update = add(stream, one, sigma=None, kappa=None, covariance=stated)
    assert stream.problem.has_covariances
    assert not stream.problem.is_relative
    batch = rw.solve(reweighted(stream.problem, {}, update.noise_factors))
    assert farthest(update, batch) < 1e-9
    assert not update.outliers
    assert not add(stream, every[0].off_by([0, 0, 0, 0.1, 0, 0]), sigma=None, kappa=None, covariance=stated).counts


def test_late_verdicts_take_early_ones_back() -> None:
    every = ones(4, 15)
    target = every[0].target
    moved = [0.0, 0.3, 0.0, 0.1, 0.0, 0.0]  # the target stood elsewhere at first
    early = [one.off_by(moved) if one.target == target and i < 14 else one for i, one in enumerate(every)]
    stream = rw.Stream()
    updates = [add(stream, one) for one in early]
    bad = {i for i, one in enumerate(early) if one is not every[i]}
    assert any(update.taken_back for update in updates)
    assert any(set(update.left_out) & bad for update in updates)
    assert {outlier.number for outlier in stream.last.outliers} == bad
    assert all(outlier.deviations > 4.0 and outlier.judged_at <= 60 for outlier in stream.last.outliers)
    assert stream.last.is_settled


def test_a_search_goes_on_over_updates_and_over_a_removal() -> None:
    every = ones_of(general(3, 3, seed=13, number_of_measurements=12, noise=NOISE).problem)
    order = np.random.default_rng(0).permutation(len(every)).tolist()
    wrong = set(range(0, 50, 3))
    stream, settled = rw.Stream(), []
    for k, i in enumerate(order):
        update = add(stream, every[i].off_by([0.0, 0.3, 0.0, 0.1, 0.0, 0.0]) if k in wrong else every[i])
        settled.append(update.is_settled)
        if k == 64:  # of the search that began at 64
            stream.remove(39)
    assert not any(settled[63:67])
    assert settled[-1]
    left_out = {outlier.number for outlier in stream.last.outliers}
    assert wrong - {39} <= left_out
    assert len(left_out) <= len(wrong) + 1


def test_a_wrong_measurement_is_left_out_when_it_comes_and_the_answer_stays() -> None:
    every = ones(5, 15)
    stream = streamed(every[:-1])
    before = stream.last
    update = add(stream, every[-1].off_by([0.5, 0.0, 0.0, 0.0, 0.2, 0.0]))
    assert not update.counts
    assert [outlier.number for outlier in update.outliers] == [59]
    assert farthest(before, update) < 1e-12
    assert streamed([*every[:-1], every[-1].off_by([0.5, 0, 0, 0, 0.2, 0])], robust=False).last.counting == 60


def test_moments_alone_give_the_same_answer_in_flat_memory() -> None:
    every = ones(6, 30)
    kept = streamed(every, noise="given", robust=False)
    flat = streamed(every, noise="given", robust=False, keep="moments", window=16)
    assert farthest(kept.last, flat.last) < 1e-9
    assert len(flat._store.rows) < 32 < len(kept._store.rows) == 120
    assert len(flat._store._rows) == 32
    assert flat.problem.number_of_measurements == 120
    assert not flat.problem.has_measurements
    assert farthest(flat.calibrate(), kept.last) < 1e-3
    with pytest.raises(MeasurementsNotKeptError, match="measurement 3 is not kept"):
        flat.remove(3)
    assert flat.remove().measurements == 119


def test_frames_with_too_few_measurements_wait_and_parts_are_solved_alone() -> None:
    every = ones(7, 12)
    near = [one for one in every if one.target == "target0" and one.sensor == "sensor0"]
    far = [one for one in every if one.target == "target1" and one.sensor == "sensor1"]
    update = streamed([*near, far[0]]).last
    assert set(update.X) == {"target0"}
    assert list(update.waiting) == [("target1", "sensor1")]
    assert "1 measurements give 6 equations" in update.waiting["target1", "sensor1"]
    assert not update.is_unique
    assert "no answer as yet for target1, sensor1" in str(update)
    both = streamed(near + far).last
    assert both.is_unique
    assert len(both.X) == 2
    alone = streamed(near).last
    assert np.allclose(both.X["target0"].matrix(), alone.X["target0"].matrix(), atol=1e-4)


def test_what_motion_about_one_axis_leaves_free_is_said() -> None:
    simulation = general(1, 1, seed=8, motion="planar", number_of_measurements=20, noise=NOISE)
    update = streamed(ones_of(simulation.problem)).last
    assert update.free_directions
    assert not update.is_unique
    with pytest.warns(rw.errors.NotUniqueWarning):
        assert len(update.free_directions) == len(rw.solve(simulation.problem).identifiability.free_directions)
    assert np.isinf(update.uncertainty_at([0.0, 0.0, 1.0], "sensor0").radius_mm)


def test_knowledge_holds_also_before_its_frames_are_seen() -> None:
    simulation = general(2, 2, seed=9, number_of_measurements=10, noise=NOISE)
    knowledge = rw.Problem(sensor_carrier="hand", target_carrier="base")
    knowledge.fix("target1", simulation.X["target1"])
    every = ones_of(simulation.problem)
    stream = streamed([one for one in every if one.target == "target0"], knowledge)
    assert set(stream.last.X) == {"target0"}
    for one in every:
        if one.target == "target1":
            update = add(stream, one)
    np.testing.assert_allclose(update.X["target1"].matrix(), simulation.X["target1"], atol=1e-12)
    assert update.uncertainty_at([0.0, 0.0, 1.0], "sensor0", "hand").radius_mm > 0.0


def test_nothing_and_no_noise_stated() -> None:
    empty = rw.Stream()
    assert empty.last.certificate is None
    with pytest.raises(MeasurementsNotKeptError, match="there are none"):
        empty.remove()
    with pytest.raises(UnderdeterminedError, match="the noise is not known"):
        empty.last.uncertainty_at([0.0, 0.0, 1.0], "cam")
    every = ones(10)
    relative = rw.Stream()
    for one in every:
        update = add(relative, one, sigma=None, kappa=None)
    assert update.refined is not None
    assert max(update.noise_factors) < 1e-3  # of 1 rad and 1 m
    assert update.is_unique
    batch = rw.solve(reweighted(relative.problem, {}, update.noise_factors))
    assert farthest(update, batch) < 1e-9


def test_bad_input_leaves_the_stream_as_it_was() -> None:
    every = ones(11, 4)
    stream = streamed(every)
    before = stream.last
    one = every[0]
    not_a_pose = np.full((4, 4), np.nan)
    covariance = np.eye(6) * 1e-6
    bad: list[tuple[type[RwhecError], str, One, dict[str, object]]] = [
        (PoseError, "B of", One(one.target, one.sensor, one.A, not_a_pose, 0, 1.0, 1.0), {}),
        (NoiseError, "sigma", one, {"sigma": -1.0}),
        (NoiseError, "the first one stated kappa, sigma, stamps_ns", one, {"sigma": None}),
        (NoiseError, "covariances", one, {"sigma": None, "kappa": None, "covariance": covariance}),
        (StampError, "the first one stated", one, {"stamp_ns": None}),
        (FrameError, "already", One(one.sensor, one.target, one.A, one.B, 0, 1.0, 1.0), {}),
        (FrameError, "name", One("", one.sensor, one.A, one.B, 0, 1.0, 1.0), {}),
    ]
    for error, words, measurement, others in bad:
        with pytest.raises(error, match=words):
            add(stream, measurement, **others)
    assert stream.last is before
    assert add(stream, one.off_by([0.0] * 6)).measurements == 17
    with pytest.raises(MeasurementsNotKeptError, match="measurement 99"):
        stream.remove(99)


@pytest.mark.parametrize(
    "options",
    [{"keep": "all"}, {"window": 3}, {"noise": "auto"}, {"robust": 1}, {"inlier_confidence": 1.0}, {"solve": None}],
)
def test_bad_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        rw.StreamOptions(**options)  # type: ignore[arg-type]


def test_knowledge_is_a_problem_without_measurements() -> None:
    with pytest.raises(OptionError, match="without measurements"):
        rw.Stream(general(1, 1, seed=1).problem)
    with pytest.raises(OptionError, match="StreamOptions"):
        rw.Stream(options=rw.SolveOptions())  # type: ignore[arg-type]
