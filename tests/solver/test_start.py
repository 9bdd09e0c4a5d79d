"""Starting points: the truth where data are exact, rotations always."""

from __future__ import annotations

import numpy as np
import pytest
from small_problems import GROSS_NOISE, part_of, simulated, true_rotations

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Simulation
from gtsam_rwhec.solver.descent import spectral_start, unconstrained_start
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part

SCALES: tuple[ScaleMode, ...] = ("known", "shared", "per_target")


def starts_of(part: Part) -> list[Array]:
    return spectral_start(part, PartForm.of(part).rotation)


def assert_one_is(starts: list[Array], truth: Array, within: float) -> None:
    assert min(float(np.abs(start - truth).max()) for start in starts) < within


def assert_rotations(R: Array) -> None:
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    assert (np.linalg.det(R) > 0.0).all()


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("sides", [(1, 1), (3, 2), (2, 3), (1, 6), (6, 1)])
def test_exact_data_give_the_truth(sides: tuple[int, int], scale: ScaleMode) -> None:
    simulation = simulated(*sides, noise=None, scale=scale)
    (start,) = starts_of(part_of(simulation.problem))
    assert_one_is([start], true_rotations(simulation), 1e-6)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("seed", range(4))
def test_the_unconstrained_minimum_of_exact_data_is_the_truth(seed: int, scale: ScaleMode) -> None:
    simulation = simulated(3, 2, seed, noise=None, scale=scale)
    form = PartForm.of(part_of(simulation.problem)).reduced
    assert_one_is(unconstrained_start(form), true_rotations(simulation), 1e-4)


@pytest.mark.parametrize("seed", range(10))
def test_parts_joined_by_their_scale_alone_have_a_sign_each(seed: int) -> None:
    """Each part's eigenvector is right up to its own sign; a common sign would turn half of them round."""
    simulation = simulated(3, 3, seed, graph=[(0, 0), (1, 1), (2, 2)], scale="shared", noise=None)
    assert_one_is(starts_of(part_of(simulation.problem)), true_rotations(simulation), 1e-6)


def fixed(simulation: Simulation, name: str) -> Simulation:
    simulation.problem.fix(name, (simulation.X | simulation.Y)[name])
    return simulation


@pytest.mark.parametrize("name", ["target0", "sensor0"])
@pytest.mark.parametrize("sides", [(3, 1), (1, 3), (2, 2), (1, 1)])
def test_a_known_frame_anchors_the_start(sides: tuple[int, int], name: str) -> None:
    """Where all centers are known (a star round a known frame) and where some are not."""
    simulation = fixed(simulated(*sides, noise=None), name)
    assert_one_is(starts_of(part_of(simulation.problem)), true_rotations(simulation), 1e-6)


@pytest.mark.parametrize("strength", [1e-3, 1.0, 1e6])
def test_a_prior_gives_both_signs_one_of_them_right(strength: float) -> None:
    simulation = simulated(2, 2, noise=None)
    simulation.problem.add_prior("sensor0", simulation.Y["sensor0"], sigma=0.1, kappa=strength)
    starts = starts_of(part_of(simulation.problem))
    assert len(starts) == 2
    assert_one_is(starts, true_rotations(simulation), 1e-5)


def test_motions_alone() -> None:
    simulation = simulated(0, 1, odometry=6, noise=None)
    assert_one_is(starts_of(part_of(simulation.problem)), true_rotations(simulation), 1e-6)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("seed", range(5))
def test_starts_are_rotations_whatever_the_noise(seed: int, scale: ScaleMode) -> None:
    part = part_of(simulated(3, 2, seed, noise=GROSS_NOISE, number_of_measurements=3, scale=scale).problem)
    forms = PartForm.of(part)
    for start in spectral_start(part, forms.rotation) + unconstrained_start(forms.reduced):
        assert start.shape == (5, 3, 3)
        assert_rotations(start)
