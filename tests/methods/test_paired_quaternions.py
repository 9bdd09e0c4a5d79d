"""The signs of a measurement's two quaternions."""

from __future__ import annotations

import numpy as np
import pytest
from method_problems import general_pair

from gtsam_rwhec.geometry.quaternions import left, of_rotations, right
from gtsam_rwhec.methods.linear_systems import Stack, paired_quaternions


@pytest.mark.parametrize("seed", range(5))
def test_signs_fit_together(seed: int) -> None:
    simulation = general_pair(seed=seed)
    q_A, q_B = paired_quaternions(Stack.of(simulation.problem))
    q_X = of_rotations(simulation.X["target0"][None, :3, :3])[0]
    q_Y = of_rotations(simulation.Y["sensor0"][None, :3, :3])[0]
    products = np.einsum("ni,ni->n", left(q_A) @ q_X, right(q_B) @ q_Y)
    np.testing.assert_allclose(np.abs(products), 1.0, atol=0.05)
    assert abs(np.sign(products).sum()) == len(products)  # one sign for all, that of q_X and q_Y themselves
