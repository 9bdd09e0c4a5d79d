"""Sums of rows with free corners, against the dense rows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.corner_model import Rows, Sums
from gtsam_rwhec.fitting.corner_residuals import Stack


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 4), st.integers(4, 7), st.booleans(), st.booleans(), st.integers(0, 1000))
def test_few_rows_have_the_sums_of_all_rows(V: int, n: int, free: bool, hidden: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = np.array([1.0, 1e3, 1e-3, 1.0, 10.0])  # columns of different units
    J, r, J_A = rng.normal(size=(V, 2 * n, 5)) * sizes, rng.normal(size=(V, 2 * n)), rng.normal(size=(V, 2 * n, 6))
    B = rng.normal(size=(V, n, 2, 3))
    if hidden:
        for rows in (J, r, J_A):
            rows[0, :4] = 0.0
        B[0, :2] = 0.0
    dense = np.zeros((V, n, 2, n, 3))
    dense[:, np.arange(n), :, np.arange(n)] = B.transpose(1, 0, 2, 3)
    corners = dense.reshape(V, 2 * n, 3 * n)[..., : 3 * n * free]
    every = np.concatenate([J, corners, r[..., None]], axis=2)
    of_all = Rows(J, B if free else None, r)
    expected = np.einsum("vri,vrj->ij", every, every)
    size = np.sqrt(np.maximum(np.diagonal(expected), 1e-300))
    stack = images_of(V, n)
    assert of_all.squares(stack)[0] / size / size[:, None] == pytest.approx(expected / size / size[:, None], abs=1e-12)
    assert of_all.times(J_A) / size == pytest.approx(J_A.transpose(0, 2, 1) @ every / size, abs=1e-9)
    columns, slots = np.arange(len(size) - 1)[None], {("x", "board"): slice(0, len(size) - 1)}
    with_A, without = Sums.zeros(V, slots), Sums.zeros(V, slots)
    places = stack.places(columns, len(size))
    with_A.add(stack, places, of_all, J_A)
    of_A, R, together = with_A.few_rows()
    sums = together.T @ together + np.einsum("vri,vrj->ij", of_A, of_A)
    assert sums / size / size[:, None] == pytest.approx(expected / size / size[:, None], abs=1e-12)
    assert R.transpose(0, 2, 1) @ of_A / size == pytest.approx(J_A.transpose(0, 2, 1) @ every / size, abs=1e-9)
    assert R.transpose(0, 2, 1) @ R == pytest.approx(J_A.transpose(0, 2, 1) @ J_A, abs=1e-9)
    without.add(stack, places, of_all, None)
    none, _, alone = without.few_rows()
    assert not none.any()
    assert alone.T @ alone / size / size[:, None] == pytest.approx(expected / size / size[:, None], abs=1e-12)


def images_of(V: int, n: int) -> Stack:
    """Images of one target, each at an instant of its own."""
    none, camera = np.zeros((V, n, 2)), Camera(2, 2, "pinhole", np.eye(3), np.zeros(0))
    return Stack(
        ("board",), "camera", np.zeros(V, int), np.arange(V), np.zeros((1, n, 3)), none, none[..., 0] > 0, camera
    )
