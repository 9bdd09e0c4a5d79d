"""Gross outliers of a pair found without knowing X or Y."""

from __future__ import annotations

import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.runs import ConsensusOptions, find_consensus
from gtsam_rwhec.runs.pair_consensus import distances, hypotheses_of
from gtsam_rwhec.simulate import Noise, general, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses

NOISE = Noise(0.02, 0.5 / np.radians(2.0) ** 2)


def pair(count: int, seed: int = 0, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    raw = general(1, 1, seed=seed, number_of_measurements=count).problem.measurements("target0", "sensor0")
    B = raw.B.copy()
    B[:, :3, 3] *= scale
    return raw.A, B, np.arange(count) * 10**8


def test_closed_form_is_exact_without_noise() -> None:
    A, B, _ = pair(12)
    X, Y, scale = hypotheses_of(A[None], B[None], ConsensusOptions())
    metres, radians = distances(A, B, X, Y, scale)
    assert metres.max() < 1e-9
    assert radians.max() < 1e-6
    A, B, _ = pair(12, scale=1.07)
    X, Y, scale = hypotheses_of(A[None], B[None], ConsensusOptions(scale_known=False))
    assert scale[0] == pytest.approx(1.07, rel=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("scale", [1.0, 1.05])
def test_gross_outliers_are_found(share: float, scale: float) -> None:
    A, B, stamps = pair(80, seed=3, scale=scale)
    B = perturb(B, NOISE, 1)
    generator = np.random.default_rng(0)
    bad = generator.random(80) < share
    B[bad] = random_poses(int(bad.sum()), 3.0, generator)
    options = ConsensusOptions(scale_known=scale == 1.0, max_translation_m=0.2, max_rotation_rad=np.radians(15))
    found = find_consensus(A, B, stamps, options)
    assert found.kept.mask[~bad].all()
    assert not found.kept.mask[bad].any()
    assert len(found.kept.removed) == bad.sum()
    assert {item.reason for item in found.kept.removed} <= {
        "rotation off the pair's consensus (rad)",
        "translation off the pair's consensus (m)",
    }
    assert all(item.value > item.limit for item in found.kept.removed)
    assert all(item.stamp_ns == stamps[item.index] for item in found.kept.removed)


def test_nothing_agrees() -> None:
    A, _, stamps = pair(40)
    B = random_poses(40, 3.0, np.random.default_rng(1))
    found = find_consensus(A, B, stamps, ConsensusOptions(max_translation_m=0.1, max_rotation_rad=0.1))
    assert not found.kept.mask.any()
    assert found.kept.counts == {"the pair has no consensus (share that agrees)": 40}


def test_a_single_measurement_is_named() -> None:
    A, B, stamps = pair(1)
    found = find_consensus(A, B, stamps)
    assert found.kept.counts == {"a single measurement of the pair": 1}


def test_the_order_of_samples_does_not_matter() -> None:
    A, B, stamps = pair(60, seed=5)
    B = perturb(B, NOISE, 1)
    B[::4] = random_poses(15, 3.0, np.random.default_rng(2))
    options = ConsensusOptions(max_translation_m=0.2, max_rotation_rad=0.3)
    straight = find_consensus(A, B, stamps, options).kept.mask
    turned = find_consensus(A[::-1], B[::-1], stamps[::-1], options).kept.mask
    np.testing.assert_array_equal(straight, turned[::-1])


@pytest.mark.parametrize("option", [{"max_translation_m": 0.0}, {"min_inlier_share": 0.0}, {"max_scale_error": 2.0}])
def test_bad_options(option: dict[str, float]) -> None:
    with pytest.raises(rw.errors.OptionError, match=next(iter(option))):
        ConsensusOptions(**option)


def test_on_the_real_dataset_the_papers_limits_keep_nearly_all(utias_folder: object) -> None:
    """The published measurements went through the paper's own RANSAC."""
    problem = rw.read_csv(utias_folder)
    kept = total = 0
    for names in problem.pairs:
        raw = problem.measurements(*names)
        if len(raw.A) < 2:
            continue
        found = find_consensus(raw.A, raw.B, np.arange(len(raw.A)))
        kept, total = kept + int(found.kept.mask.sum()), total + len(raw.A)
    assert kept / total > 0.98
