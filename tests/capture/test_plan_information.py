"""What a plan promises of a pose is what a measurement there really tells; adding one never takes anything away."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import REPOSITORY
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.capture.plan_cell import Cell
from gtsam_rwhec.capture.plan_information import rows_at
from gtsam_rwhec.capture.plan_ranking import Task, bound_of, free_frames, ranked
from gtsam_rwhec.capture.plan_sources import cell_of
from gtsam_rwhec.fitting.unknowns import Unknown

sys.path.insert(0, str(REPOSITORY / "benchmarks"))
from planned_cells import KINDS, TrueCell, cell

Array = np.ndarray
kinds = st.sampled_from(KINDS)
seeds = st.integers(0, 10_000)
few = settings(max_examples=8, deadline=None, derandomize=True)


def at_the_truth(true: TrueCell) -> tuple[Cell, dict[rw.Pair, Array], Array]:
    """A cell whose guesses are the truth, and what is seen at random poses A (n, 4, 4)."""
    known = cell_of(None, replace(true.options, guesses={**true.X, **true.Y}), None, true.cameras, true.boards)
    A = true.random_poses(8, 60.0)
    return known, {pair: np.array([true.pixels(*pair, one) is not None for one in A]) for pair in known.pairs}, A


@given(kinds, seeds)
@few
def test_the_predicted_information_is_that_of_the_answer(kind: str, seed: int) -> None:
    true = replace(cell(kind, seed), corner_px=0.15)
    known, seen, A = at_the_truth(true)
    problem = rw.Problem()
    for pair, where in seen.items():
        if where.any():
            pixels = np.array([true.pixels(*pair, one) for one in A[where]])
            stamps = np.flatnonzero(where) * 10**9
            problem.add_corners(
                *pair,
                A[where],
                pixels,
                true.boards[pair.target],
                true.cameras[pair.sensor],
                corner_px=0.15,
                stamps_ns=stamps,
            )
    options = rw.RefineOptions(noise="given", carrier_noise=true.noise)
    refined = rw.refine(problem, rw.solve(problem), options)
    frames = [name for name in known.slots if name in refined.names]
    at = np.concatenate([np.arange(known.dimension)[known.slots[name]] for name in frames])
    W = rows_at(known, A, seen)[:, :, at]  # the intrinsics are exact
    predicted = np.einsum("nij,nik->jk", W, W)
    came = refined.information(*map(Unknown.of, frames))
    unit = np.sqrt(np.diagonal(came))
    assert np.abs((predicted - came) / unit[:, None] / unit).max() < 2e-3


@given(kinds, seeds, st.permutations(range(8)))
@few
def test_order_does_not_matter_and_nothing_is_lost(kind: str, seed: int, order: list[int]) -> None:
    known, seen, A = at_the_truth(cell(kind, seed))
    task = Task.of(known, list(known.Y), [0.8] * len(known.Y), 0.95)
    W = rows_at(known, A, seen)
    number = np.sum([*seen.values()], axis=0)
    first, other = ranked(known, task, W, number, 5), ranked(known, task, W[order], number[order], 5)
    assert first.order == tuple(order[i] for i in other.order)
    assert min(first.nats) >= 0.0
    assert 0.0 < bound_of(W, first) <= 1.0 + 1e-12
    covariance, radii = np.linalg.inv(known.known + np.diag(known.rough)), [np.inf]
    for i in first.order:
        after = np.linalg.inv(np.linalg.inv(covariance) + W[i].T @ W[i])
        size = np.sqrt(np.diagonal(covariance))
        assert np.linalg.eigvalsh((covariance - after) / size[:, None] / size).min() > -1e-6
        covariance = after
        radii.append(task.radius_mm(known, covariance, np.inf)[0])
    assert all(later <= before * (1.0 + 1e-6) for before, later in pairwise(radii))
    assert np.allclose(radii[1:], first.radii_mm, rtol=1e-4)


@given(kinds, seeds)
@few
def test_every_proposed_pose_is_seen_although_guesses_are_rough(kind: str, seed: int) -> None:
    true, problem = cell(kind, seed), rw.Problem()
    options = replace(true.options, candidates=60, poses=6)
    for i in range(4):
        plan = rw.plan(problem if i else None, options, cameras=true.cameras, boards=true.boards)
        for pose in plan.poses if i else plan.poses[:1]:  # before the first take nobody knows where the board is
            assert pose.sees
            assert true.sees(pose.T_sensorcarrier_targetcarrier[None])[0]
        true.take(problem, plan.poses[0].T_sensorcarrier_targetcarrier, i)
        options = replace(options, present=None)


def test_greedy_choice_has_its_guarantee() -> None:
    # All sets of three of eight candidates: none adds more information than 1 / (1 - 1/e) of the greedy one.
    from itertools import combinations

    known, seen, A = at_the_truth(cell("hand", 3))
    known = replace(known, rough=known.rough * 1e-4)  # all is free: the information decides
    task = Task.of(known, list(known.Y), [0.8], 0.95)
    W = rows_at(known, A, seen)
    greedy = ranked(replace(known, rough=known.rough), task, W, np.ones(8), 3)
    prior = known.known + np.diag(known.rough)
    best = max(
        np.linalg.slogdet(prior + sum(W[i].T @ W[i] for i in some))[1] - np.linalg.slogdet(prior)[1]
        for some in combinations(range(8), 3)
    )
    gathered = np.linalg.slogdet(greedy.information)[1] - np.linalg.slogdet(prior)[1]
    assert gathered >= (1.0 - 1.0 / np.e) * best
    assert gathered >= bound_of(W, greedy) * best - 1e-9


def test_free_frames_are_named_until_two_axes_turned() -> None:
    true, problem = cell("hand", 1), rw.Problem()
    options = replace(true.options, candidates=60)
    known = cell_of(None, options, None, true.cameras, true.boards)
    assert free_frames(known, known.covariance) == ("cam_0", "board_0")
    plan = rw.plan(None, options, cameras=true.cameras, boards=true.boards)
    assert np.isinf(plan.poses[0].deviation_mm)
    assert np.allclose(plan.poses[0].T_sensorcarrier_targetcarrier, true.present)
    turns = [
        se3.so3_logmap((one.T_sensorcarrier_targetcarrier @ se3.inverse(true.present))[None, :3, :3])[0]
        for one in plan.poses[1:4]
    ]
    spread = np.linalg.svd(np.array(turns))[1]
    assert spread[1] > np.radians(30.0)  # two axes
    for i, pose in enumerate(plan.poses[:4]):
        true.take(problem, pose.T_sensorcarrier_targetcarrier, i)
    known = cell_of(problem, options, None, true.cameras, true.boards)
    assert free_frames(known, known.covariance) == ()


@pytest.mark.parametrize("kind", KINDS)
def test_the_next_take_leaves_what_was_predicted(kind: str) -> None:
    true, problem = cell(kind, 5), rw.Problem()
    options = replace(true.options, candidates=80)
    off, promised = [], np.inf
    for i in range(9):
        plan = rw.plan(problem if i else None, options, cameras=true.cameras, boards=true.boards)
        if np.isfinite(promised):
            off.append(abs(promised / plan.outlook.now_mm - 1.0))
        promised = plan.poses[0].deviation_mm
        true.take(problem, plan.poses[0].T_sensorcarrier_targetcarrier, i)
        options = replace(options, present=None)
    assert np.median(off) < 0.1
