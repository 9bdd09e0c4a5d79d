"""Errors of an answer against the truth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rwhec_factors.se3 import pose

from gtsam_rwhec.errors import FrameError, ScaleError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Simulation, frame_distance, general
from gtsam_rwhec.simulate.simulated_noise import random_poses, rotations_of_vectors


@dataclass
class Estimate:
    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float | Mapping[str, float]


def exact(simulation: Simulation) -> Estimate:
    return Estimate(
        {name: gtsam.Pose3(T) for name, T in simulation.X.items()},
        {name: gtsam.Pose3(T) for name, T in simulation.Y.items()},
        simulation.scale,
    )


def moved(T: Array, vector_rad: list[float], offset_m: list[float]) -> gtsam.Pose3:
    R = T[:3, :3] @ rotations_of_vectors(vector_rad)
    return gtsam.Pose3(pose(R, T[:3, 3] + np.array(offset_m)))


def test_the_truth_has_no_error() -> None:
    simulation = general(3, 2, seed=1, scale="per_target")
    errors = simulation.errors(exact(simulation))
    assert set(errors.X) == {"target0", "target1", "target2"}
    assert set(errors.Y) == {"sensor0", "sensor1"}
    for distance in (errors.X | errors.Y).values():
        assert distance.translation_m == 0.0
        assert distance.rotation_rad < 1e-15
    assert errors.relative_scale == {"target0": 0.0, "target1": 0.0, "target2": 0.0}


def test_errors_are_where_they_were_made() -> None:
    simulation = general(2, 2, seed=2, scale="shared")
    answer = exact(simulation)
    answer.X["target1"] = moved(simulation.X["target1"], [0.0, 0.0, math.radians(2.0)], [0.0, 0.0, 0.0])
    answer.Y["sensor0"] = moved(simulation.Y["sensor0"], [0.0, 0.0, 0.0], [0.003, 0.004, 0.0])
    answer.scale = 0.45
    errors = simulation.errors(answer)
    assert errors.X["target1"].rotation_deg == pytest.approx(2.0)
    assert errors.X["target1"].translation_mm == pytest.approx(0.0, abs=1e-12)
    assert errors.Y["sensor0"].translation_mm == pytest.approx(5.0)
    assert errors.Y["sensor0"].rotation_rad == pytest.approx(0.0, abs=1e-14)
    assert errors.X["target0"].translation_m == errors.Y["sensor1"].translation_m == 0.0
    assert errors.relative_scale == pytest.approx(0.1)


@given(
    angle=st.floats(0.0, math.pi) | st.floats(0.0, 1e-6) | st.floats(math.pi - 1e-6, math.pi),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_rotation_error_is_the_angle_at_every_size(angle: float, seed: int) -> None:
    generator = np.random.default_rng(seed)
    truth = random_poses(1, 1.0, generator)[0]
    axis = generator.standard_normal(3)
    axis /= np.linalg.norm(axis)
    estimate = pose(truth[:3, :3] @ rotations_of_vectors(angle * axis), truth[:3, 3])
    assert frame_distance(estimate, truth).rotation_rad == pytest.approx(angle, abs=1e-14)


def test_an_answer_to_something_else_is_refused() -> None:
    simulation = general(2, 1, seed=3, scale="per_target")
    answer = exact(simulation)
    del answer.X["target1"]
    with pytest.raises(FrameError, match="X has no target1"):
        simulation.errors(answer)
    answer = exact(simulation)
    answer.scale = {"target0": 1.0}
    with pytest.raises(FrameError, match="scale has no target1"):
        simulation.errors(answer)
    answer.scale = 1.0
    with pytest.raises(ScaleError, match="mapping"):
        simulation.errors(answer)
    simulation = general(2, 1, seed=3)
    answer = exact(simulation)
    answer.scale = {"target0": 1.0, "target1": 1.0}
    with pytest.raises(ScaleError, match="number"):
        simulation.errors(answer)


def test_the_truth_cannot_be_changed_by_accident() -> None:
    simulation = general(1, 1, seed=4)
    with pytest.raises(ValueError, match="read-only"):
        simulation.X["target0"][0, 3] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        simulation.scale = 2.0  # type: ignore[misc]
