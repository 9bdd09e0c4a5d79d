"""Measurements of many pairs in one call are those of one call for each pair: moments, raw measurements, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CountError, FrameError, NoiseError, PoseError, RotationsProjectedWarning, StampError
from gtsam_rwhec.problem.accumulation import OPENING
from gtsam_rwhec.problem.moment_stack import PAIRS_AT_ONCE
from gtsam_rwhec.problem.moments import BLOCK, R_B, T_A, shift_of
from gtsam_rwhec.simulate.simulated_noise import random_poses

#: All features but B's rotation.
WITHOUT_R_B = np.r_[:12, 21:25]


def drawn(counts: list[int], seed: int) -> tuple[list[tuple[str, str]], dict[str, Any]]:
    """Pairs with so many measurements each, in any order, and the arguments of `add_many`."""
    draw = np.random.default_rng(seed)
    pairs = [(f"t{i % 7}", f"s{i // 7}") for i in range(len(counts))]
    index = draw.permutation(np.repeat(np.arange(len(counts)), counts))
    N = len(index)
    A, B = random_poses(N, 2.0, draw), random_poses(N, 3.0, draw)
    A[:, :3, 3] += 100.0
    sigma, kappa = draw.uniform(0.01, 1.0, N), draw.uniform(1.0, 300.0, N)
    return pairs, {"index": index, "A": A, "B": B, "sigma": sigma, "kappa": kappa}


def one_by_one(problem: rw.Problem, pairs: list[tuple[str, str]], given: dict[str, Any]) -> None:
    """The same measurements, a call for each pair."""
    for i, pair in enumerate(pairs):
        own = given["index"] == i
        problem.add(*pair, *(given[name][own] for name in ("A", "B", "sigma", "kappa")))


@settings(max_examples=15, deadline=None)
@given(
    counts=st.lists(st.integers(1, 40), min_size=1, max_size=20),
    scale=st.sampled_from(["known", "shared", "per_target"]),
    seed=st.integers(0, 1000),
)
def test_moments_are_those_of_a_call_for_each_pair(counts: list[int], scale: Any, seed: int) -> None:
    pairs, given_ = drawn(counts, seed)
    many, single = rw.Problem(scale), rw.Problem(scale)
    first = {**given_, "A": given_["A"][::-1], "index": given_["index"][::-1]}
    _, opening = drawn([OPENING], 7)
    for problem in (many, single):  # one gauge for both
        problem.add("t0", "s0", opening["A"], opening["B"], 1.0, 1.0)
    many.add_many(pairs, **given_)
    many.add_many(pairs, **first)
    one_by_one(single, pairs, given_)
    one_by_one(single, pairs, first)
    assert (many.targets, many.sensors) == (single.targets, single.sensors)
    assert many.number_of_measurements == single.number_of_measurements
    kept = np.arange(25) if scale != "known" else WITHOUT_R_B
    for pair in single.pairs:
        a, b = many.moments(*pair), single.moments(*pair)
        assert (a.count, a.projected) == (b.count, b.projected)
        m, e = b.magnitude, b.feature_error
        size = 1e-13 * np.outer(m, m) + 2.0 * (np.outer(m, e) + np.outer(e, m) + np.outer(e, e))
        assert (np.abs(a.translation - b.translation) <= size)[kept][:, kept].all()
        np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-12 * b.kappa)
        np.testing.assert_allclose(a.magnitude, b.magnitude, rtol=1e-9, atol=2.0 * e.max())
        assert (a.feature_error > 0.0).tolist() == (b.feature_error > 0.0).tolist()
        raw, expected = many.measurements(*pair), single.measurements(*pair)
        for name in ("A", "B", "sigma", "kappa"):
            np.testing.assert_array_equal(getattr(raw, name), getattr(expected, name))


def test_all_moments_are_about_one_gauge_that_few_measurements_began() -> None:
    """The first measurements, fewer than fix a gauge, are at another place than those of many pairs."""
    pairs, given_ = drawn([10, 30, 40], 3)
    given_["A"][given_["index"] == 0, 0, 3] += 50.0
    problem = rw.Problem()
    one_by_one(problem, pairs[:1], given_)
    rest = {name: values[given_["index"] > 0] for name, values in given_.items()}
    problem.add_many(pairs[1:], **{**rest, "index": rest["index"] - 1})
    again = problem.with_measurements({pair: problem.measurements(*pair) for pair in problem.pairs})
    for pair in problem.pairs:
        got, expected = problem.moments(*pair).translation[T_A, -1], again.moments(*pair).translation[T_A, -1]
        np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_a_stack_of_several_calls_is_shifted_as_single_moments_are() -> None:
    """Pairs of several calls and of `add`, more than are made at once, one with more measurements than a block."""
    counts = [2] * (PAIRS_AT_ONCE + 50) + [BLOCK + 3]
    pairs, given_ = drawn(counts, 5)
    problem = rw.Problem("shared", keep_measurements=False)
    half = given_["index"] < 40
    first = {name: values[half] for name, values in given_.items()}
    rest = {name: values[~half] for name, values in given_.items()}
    problem.add_many(pairs[:40], **first)
    problem.add_many(pairs[40:], **{**rest, "index": rest["index"] - 40})
    problem.add("t0", "s0", given_["A"][:3], given_["B"][:3], 0.1, 10.0)
    a, c = np.array([0.5, -2.0, 1.0]), np.array([3.0, 0.1, -0.2])
    stack = problem.moment_stack(problem.pairs).shifted(a, c)
    assert stack.is_finite().all()
    shift = shift_of(a, c)
    for e in (0, 39, 40, 41, len(pairs) - 1):
        single = problem.moment_stack([problem.pairs[e]]).shifted(a, c).as_summed().one(0)
        np.testing.assert_allclose(
            stack.translations(slice(e, e + 1))[0], shift @ problem.moments(*problem.pairs[e]).translation @ shift.T
        )
        np.testing.assert_array_equal(stack.rotations(slice(e, e + 1))[0], single.rotation)
        np.testing.assert_allclose(stack.magnitude[e], single.magnitude, rtol=1e-12)
        np.testing.assert_allclose(stack.feature_error[e], single.feature_error, rtol=1e-12)
        assert (stack.count[e], stack.operations[e]) == (single.count, single.operations)
    whole = stack.translations(slice(None))
    np.testing.assert_allclose(stack.squares(T_A), np.einsum("ekk->e", whole[:, T_A, T_A]), rtol=1e-14)
    assert whole.shape == (len(pairs), 25, 25)


def test_sums_of_rotations_of_B_are_kept_only_where_a_scale_may_need_them() -> None:
    pairs, given_ = drawn([3, 4], 1)
    for scale, is_kept in (("known", False), ("per_target", True)):
        problem = rw.Problem(scale)  # type: ignore[arg-type]
        problem.add_many(pairs, **given_)
        assert np.isfinite(problem.moments(*pairs[0]).translation[R_B]).all() == is_kept


def test_rotations_that_are_not_exact_are_projected_and_counted() -> None:
    pairs, given_ = drawn([5, 1, 3], 2)
    given_["A"][[1, 4], 0, 0] += 1e-6
    given_["B"][2, 0, 0] += 1e-6
    problem = rw.Problem()
    with pytest.warns(RotationsProjectedWarning, match="3 rotations were not exact") as caught:
        problem.add_many(pairs, **given_, source="a log")
    assert caught[0].filename == __file__
    assert sum(problem.moments(*pair).projected for pair in pairs) == 3
    for pair in pairs:
        R = problem.measurements(*pair).A[:, :3, :3]
        np.testing.assert_allclose(R.transpose(0, 2, 1) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14)


def broken(name: str, given_: dict[str, Any]) -> dict[str, Any]:
    """Arguments with one thing wrong."""
    given_ = {key: value.copy() for key, value in given_.items()}
    N = len(given_["A"])
    if name == "pose":
        given_["B"][7, 0, 3] = np.nan
    elif name == "rotation":
        given_["A"][3, :3, :3] *= 1.1
    elif name == "index":
        given_["index"][2] = 9
    elif name == "nothing":
        given_["index"][given_["index"] == 1] = 0
    elif name == "sigma":
        given_["sigma"][4] = -1.0
    elif name == "stamps":
        given_["stamps_ns"] = np.arange(N)[::-1].copy()
    elif name == "length":
        given_["index"] = given_["index"][:-1]
    return given_


@pytest.mark.parametrize(
    ("name", "kind", "words"),
    [
        ("pose", PoseError, r"B of t\d-s0 \(a log\): measurement 7 has an entry that is NaN"),
        ("rotation", PoseError, r"A of t\d-s0 \(a log\): the rotation of measurement 3 is off"),
        ("index", CountError, "index of measurement 2 is 9; give 0 to 2"),
        ("nothing", CountError, "pair 1, t1-s0, has no measurement"),
        ("sigma", NoiseError, "sigma of measurement 4 is -1.0"),
        ("stamps", StampError, r"t\d-s0 \(a log\): the stamp of measurement \d+ .* is before"),
        ("length", CountError, r"index has shape \(12,\)"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_is_added(name: str, kind: type[Exception], words: str) -> None:
    pairs, given_ = drawn([5, 3, 5], 3)
    problem = rw.Problem()
    with pytest.raises(kind, match=words):
        problem.add_many(pairs, **broken(name, given_), source="a log")
    assert (problem.pairs, problem.targets) == ((), ())


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ([("a", "a"), ("b", "c"), ("d", "c")], "is given as target and as sensor in pair 0"),
        ([("a", "b"), ("a", "b"), ("d", "c")], "a-b is given twice"),
        ([("a", "b"), ("b", "c"), ("d", "c")], "'b' is a target in pair 1 and a sensor in another"),
        (["ab", ("b", "c"), ("d", "c")], "pair 0 is 'ab'"),
        ([("a", ""), ("b", "c"), ("d", "c")], "the sensor's name of pair 0"),
    ],
)
def test_names_that_cannot_be_are_refused(pairs: Any, words: str) -> None:
    _, given_ = drawn([2, 2, 2], 4)
    problem = rw.Problem()
    with pytest.raises(FrameError, match=words):
        problem.add_many(pairs, **given_)
    assert problem.pairs == ()
