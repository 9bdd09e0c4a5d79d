"""Angles in the wrong unit are undone exactly where rotation matrices hold enough, and left alone where they do not."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from misread_problems import in_degrees
from rwhec_factors.se3 import inverse, pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.calibration.other_readings import readings_of_angles, stretched, stretched_euler, unwound
from gtsam_rwhec.simulate import Noise, perturb

GENERATOR = np.random.default_rng(0)
AXES = GENERATOR.normal(size=(30, 3))
VECTORS = AXES / np.linalg.norm(AXES, axis=1)[:, None] * GENERATOR.uniform(0.0, 3.0, (30, 1))
A = pose(Rotation.from_rotvec(VECTORS).as_matrix(), GENERATOR.normal(size=(30, 3)))
X, Y = pose(Rotation.random(2, random_state=1).as_matrix(), GENERATOR.normal(size=(2, 3)))
B = inverse(Y) @ A @ X


def test_rotation_vectors_that_were_divided_are_stretched() -> None:
    small = pose(Rotation.from_rotvec(np.radians(VECTORS)).as_matrix(), A[:, :3, 3])
    np.testing.assert_allclose(stretched(small), A, atol=1e-12)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))), ids=str)
def test_euler_angles_that_were_divided_are_stretched(order: tuple[int, int, int]) -> None:
    letters = "".join("XYZ"[axis] for axis in order)
    angles = Rotation.from_matrix(A[:, :3, :3]).as_euler(letters)
    small = pose(Rotation.from_euler(letters, np.radians(angles)).as_matrix(), A[:, :3, 3])
    np.testing.assert_allclose(stretched_euler(order)(small), A, atol=1e-12)


def test_rotation_vectors_in_degrees_are_unwound_by_the_other_side() -> None:
    noise = Noise(1e-3, 0.5 / np.radians(0.5) ** 2)
    np.testing.assert_allclose(unwound(in_degrees(A), perturb(B, noise, 0)), A, atol=1e-12)
    np.testing.assert_allclose(unwound(in_degrees(B), perturb(A, noise, 0)), B, atol=1e-12)


def test_few_measurements_are_left_as_they_are() -> None:
    wrong = in_degrees(A[:5])
    assert unwound(wrong, B[:5]) is wrong


def test_large_rotations_are_not_taken_for_divided_ones() -> None:
    assert [reading.likely for reading in readings_of_angles(A, B)] == [
        "the rotation vectors of A are in degrees, and were read as radians",
        "the rotation vectors of B are in degrees, and were read as radians",
    ]
