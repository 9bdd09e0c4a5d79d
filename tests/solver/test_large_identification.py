"""Graphs of a thousand frames: the verdicts of the dense road, and what is free named right."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rwhec_factors.se3 import inverse

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Motion, Noise, general
from gtsam_rwhec.simulate.simulated_noise import perturb, random_poses
from gtsam_rwhec.simulate.simulated_rigs import carrier_poses
from gtsam_rwhec.solver import identification, weak_directions
from gtsam_rwhec.solver.answers import PairPoses, costs_of_pairs, given_answer
from gtsam_rwhec.solver.free_directions import FreeKind, FreeReason
from gtsam_rwhec.solver.identification import Identifiability, identify
from gtsam_rwhec.solver.parts import parts_of

NOISE = Noise(0.005, 5000.0)


def known_at(problem: rw.Problem, X: Any, Y: Any, scale: Any = 1.0) -> list[Identifiability]:
    """What is determined at given poses, part by part."""
    found = []
    for part in parts_of(problem):
        poses = PairPoses.of(part, given_answer(part, X, Y, scale))
        found.append(identify(part, poses, *costs_of_pairs(part, poses)))
    return found


def rig(
    motions: list[tuple[str, int, int]], measurements: int = 4
) -> tuple[rw.Problem, dict[str, Any], dict[str, Any]]:
    """One part for each (motion, targets, sensors): a chain of targets and sensors, and some more pairs."""
    draw = np.random.default_rng(3)
    problem = rw.Problem(keep_measurements=False)
    X: dict[str, Any] = {}
    Y: dict[str, Any] = {}
    for p, (kind, targets, sensors) in enumerate(motions):
        of_X, of_Y = random_poses(targets, 2.0, draw), random_poses(sensors, 0.5, draw)
        j = np.r_[np.arange(targets), np.arange(1, targets), draw.integers(0, targets, targets // 5)]
        k = np.r_[
            np.arange(targets) % sensors, np.arange(targets - 1) % sensors, draw.integers(0, sensors, targets // 5)
        ]
        edges = np.unique(np.stack([j, k], axis=1), axis=0)
        index = np.repeat(np.arange(len(edges)), measurements)
        A = inverse(carrier_poses(Motion(kind), len(index), draw))  # type: ignore[arg-type]
        B = perturb(inverse(of_Y[edges[index, 1]]) @ A @ of_X[edges[index, 0]], NOISE, draw)
        pairs = [(f"{kind}_tag{a}_{p}", f"{kind}_cam{b}_{p}") for a, b in edges.tolist()]
        problem.add_many(pairs, index, A, B, NOISE.sigma_m, NOISE.kappa)
        X |= {f"{kind}_tag{a}_{p}": T for a, T in enumerate(of_X)}
        Y |= {f"{kind}_cam{b}_{p}": T for b, T in enumerate(of_Y)}
    return problem, X, Y


def test_each_unconnected_part_of_a_thousand_frames_says_what_is_free() -> None:
    problem, X, Y = rig([("general", 500, 40), ("planar", 400, 60), ("single_axis", 300, 30), ("none", 60, 20)])
    general_, planar, single, still = known_at(problem, X, Y)
    assert general_.is_unique
    assert general_.weakest > general_.threshold
    for known, frames in ((planar, 460), (single, 330)):
        (direction,) = known.free_directions
        assert direction.kind is FreeKind.TRANSLATION
        assert direction.reason is FreeReason.ONE_AXIS
        assert len(direction.frames) == frames
        assert known.weakest <= known.threshold
    # Without a turn every frame of the part may shift along three axes, with all others.
    assert len(still.free_directions) == 3
    assert {direction.kind for direction in still.free_directions} == {FreeKind.TRANSLATION}
    assert {direction.reason for direction in still.free_directions} == {FreeReason.NO_ROTATION}


@settings(max_examples=10, deadline=None)
@given(
    kind=st.sampled_from(["general", "planar", "single_axis", "none"]),
    wobble=st.sampled_from([0.0, 0.02, 0.2]),
    scale=st.sampled_from(["known", "shared", "per_target"]),
    seed=st.integers(0, 100),
)
def test_the_sparse_road_has_the_verdict_of_the_dense_one(kind: Any, wobble: float, scale: Any, seed: int) -> None:
    motion = Motion(kind, wobble_rad=wobble)
    found = general(6, 3, seed=seed, graph="random", motion=motion, noise=NOISE, number_of_measurements=6, scale=scale)
    (dense,) = known_at(found.problem, found.X, found.Y, found.scale)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(weak_directions, "DENSE_PARAMETERS", 20)
        (sparse,) = known_at(found.problem, found.X, found.Y, found.scale)
    assert sparse.is_unique is dense.is_unique
    assert len(sparse.free_directions) == len(dense.free_directions)
    assert [d.kind for d in sparse.free_directions] == [d.kind for d in dense.free_directions]
    # The sparse road reports the direction of least information; of all directions another may be nearer its threshold.
    if dense.is_unique:
        assert 0.95 <= sparse.weakest / sparse.threshold * dense.threshold / dense.weakest <= 2.0


def test_pairs_are_tested_when_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, X, Y = rig([("general", 200, 3), ("planar", 5, 2)])
    later, together = known_at(problem, X, Y), known_at(problem, X, Y)
    monkeypatch.setattr(identification, "TESTED_AT_ONCE", 7)
    assert dict(later[0].pairs) == dict(together[0].pairs)
    merged = Identifiability.merged(later, tuple(each.parts[0] for each in later))
    assert merged.pairs == {**later[0].pairs, **later[1].pairs}
    assert pickle.loads(pickle.dumps(merged)) == merged
    with pytest.raises(KeyError):
        later[0].pairs["nobody", "nothing"]  # type: ignore[index]
