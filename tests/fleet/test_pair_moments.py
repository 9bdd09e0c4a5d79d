"""Moments of parts, merged in any partition, are the moments of the whole."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import gtsam_rwhec as rw
from gtsam_rwhec.fleet.merging import CHUNK, merged
from gtsam_rwhec.fleet.pair_moments import PairMoments
from gtsam_rwhec.problem.moments import Gauge
from gtsam_rwhec.problem.selection import problem_of_moments
from gtsam_rwhec.simulate.simulated_noise import Noise, perturb, random_poses
from gtsam_rwhec.simulate.simulated_rigs import Motion, carrier_poses

NOISE = Noise(sigma_m=0.002, kappa=0.5 / np.radians(0.2) ** 2)
RNG = np.random.default_rng(5)
A = np.linalg.inv(carrier_poses(Motion("general"), 120, RNG))
#: The robots stand a kilometre from the world's origin.
A[:, :3, 3] += A[:, :3, :3] @ np.array([800.0, -600.0, 3.0])
X = {name: pose @ np.eye(4) for name, pose in zip(("a", "b"), random_poses(2, 1.0, RNG), strict=True)}
for T in X.values():
    T[:3, 3] -= np.array([800.0, -600.0, 3.0])
Y = dict(zip(("left", "right"), random_poses(2, 0.3, RNG), strict=True))
B = {(x, y): perturb(np.linalg.inv(Y[y]) @ A @ X[x], NOISE, RNG) for x in X for y in Y}
SIGMA, KAPPA = RNG.uniform(0.001, 0.003, 120), RNG.uniform(1e4, 1e5, 120)


def problem(at: np.ndarray) -> rw.Problem:
    """The problem of some of the instants."""
    result = rw.Problem()
    for (target, sensor), of_pair in B.items():
        result.add(target, sensor, A[at], of_pair[at], SIGMA[at], KAPPA[at])
    return result


WHOLE = problem(np.arange(120))


@settings(max_examples=12, deadline=None)
@given(st.integers(1, 20), st.randoms(use_true_random=False))
def test_any_partition_has_the_moments_of_the_whole(parts: int, random: object) -> None:
    order = np.random.default_rng(random.getrandbits(32)).permutation(120)  # type: ignore[attr-defined]
    ends = np.sort(np.random.default_rng(random.getrandbits(32)).choice(np.arange(1, 120), parts - 1, replace=False))  # type: ignore[attr-defined]
    found = merged([PairMoments.of(problem(at)) for at in np.split(order, ends)])
    expected = PairMoments.of(WHOLE).about(found.gauge)
    assert found.pairs == expected.pairs
    assert found.count.tolist() == expected.count.tolist() == [120] * 4
    size = np.maximum(found.magnitude, expected.magnitude)
    assert (np.abs(found.translation - expected.translation) <= 1e-12 * size[:, :, None] * size[:, None]).all()
    np.testing.assert_allclose(found.rotation, expected.rotation, rtol=0.0, atol=1e-12 * expected.kappa.max())
    np.testing.assert_allclose(found.kappa, expected.kappa, rtol=1e-12)


def test_the_poses_are_those_of_one_process() -> None:
    expected = rw.solve(WHOLE)
    order = np.random.default_rng(1).permutation(120)
    parts = merged([PairMoments.of(problem(at)) for at in np.split(order, [10, 40, 41, 90])])
    found = rw.solve(problem_of_moments(parts.moments(), parts.gauge))
    assert found.certificate.basis is rw.Basis.MOMENTS
    assert found.certificate.is_optimal
    for name, pose in (expected.X | expected.Y).items():
        # 1e-12 times the condition number of some thousands, and a kilometre of distance.
        np.testing.assert_allclose((found.X | found.Y)[name].matrix(), pose.matrix(), rtol=0.0, atol=1e-8)


def test_chunks_of_the_tree_give_the_same_bits() -> None:
    leaves = [PairMoments.of(problem(np.arange(i, i + 3))) for i in range(0, 114, 3)]
    for count in (1, 2, 17, 33, 38):
        some = leaves[:count]
        chunks = [merged(some[i : i + CHUNK]) for i in range(0, count, CHUNK)]
        assert merged(chunks).sha256() == merged(some).sha256()


def test_a_shift_there_and_back_and_its_bounds() -> None:
    start = PairMoments.of(WHOLE)
    moved = start.about(Gauge(np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.0, 7.0])))
    exact = {pair: of.shifted(*_shift(start, moved)) for pair, of in start.moments().items()}
    for pair, of in moved.moments().items():
        bound = 1e-14 * of.magnitude[:, None] * of.magnitude
        assert (np.abs(of.translation - exact[pair].translation) <= bound).all()
        np.testing.assert_allclose(of.magnitude, exact[pair].magnitude)
        assert (of.translation == of.translation.T).all()
    back = moved.about(start.gauge)
    size = moved.magnitude
    assert (np.abs(back.translation - start.translation) <= 1e-13 * size[:, :, None] * size[:, None]).all()


def _shift(start: PairMoments, moved: PairMoments) -> tuple[np.ndarray, np.ndarray]:
    return (
        moved.gauge.sensor_carrier - start.gauge.sensor_carrier,
        moved.gauge.target_carrier - start.gauge.target_carrier,
    )


def test_other_names_and_files() -> None:
    start = PairMoments.of(WHOLE)
    renamed = start.renamed({"left": "z/left", "right": "a/right"})
    assert [pair.sensor for pair in renamed.pairs] == ["a/right", "z/left", "a/right", "z/left"]
    assert renamed.count.sum() == start.count.sum()
    again = PairMoments.of_arrays(start.facts(), start.arrays())
    assert again.sha256() == start.sha256()
    assert again.sha256() != renamed.sha256()
