"""Poses in every form that users give, brought to one shape; quaternions against GTSAM's."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gtsam_rwhec.errors import PoseError
from gtsam_rwhec.geometry.poses import (
    ROTATION_TOLERANCE,
    as_transforms,
    checked_rows,
    one_transform,
    rows_to_transforms,
)
from gtsam_rwhec.geometry.quaternions import conjugate, dual_parts, left, of_rotations, right, to_rotations
from gtsam_rwhec.simulate.simulated_noise import random_poses

TRANSFORMS = random_poses(5, 2.0, np.random.default_rng(1))


def poses3(transforms: np.ndarray) -> list[gtsam.Pose3]:
    return [gtsam.Pose3(T) for T in transforms]


def rows_of_seven(transforms: np.ndarray, order: str) -> np.ndarray:
    """GTSAM's own quaternions, beside the translations."""
    wxyz = np.array([gtsam.Rot3(T[:3, :3]).toQuaternion().coeffs()[[3, 0, 1, 2]] for T in transforms])
    quaternions = wxyz if order == "wxyz" else wxyz[:, [1, 2, 3, 0]]
    return np.concatenate([quaternions, transforms[:, :3, 3]], axis=1)


@pytest.mark.parametrize(
    ("given_poses", "order"),
    [
        (TRANSFORMS, None),
        (TRANSFORMS.tolist(), None),
        (list(TRANSFORMS), None),
        (np.asfortranarray(TRANSFORMS), None),
        (poses3(TRANSFORMS), None),
        (tuple(poses3(TRANSFORMS)), None),
        (rows_of_seven(TRANSFORMS, "wxyz"), "wxyz"),
        (rows_of_seven(TRANSFORMS, "xyzw"), "xyzw"),
        (rows_of_seven(TRANSFORMS, "wxyz").tolist(), "wxyz"),
        (-rows_of_seven(TRANSFORMS, "xyzw") * [1, 1, 1, 1, -1, -1, -1], "xyzw"),
    ],
)
def test_every_form_gives_the_same_matrices(given_poses: Any, order: Any) -> None:
    np.testing.assert_allclose(as_transforms(given_poses, order, "A"), TRANSFORMS, rtol=0.0, atol=4e-16 * 8)


@pytest.mark.parametrize("pose", [TRANSFORMS[0], TRANSFORMS[:1], gtsam.Pose3(TRANSFORMS[0]), TRANSFORMS[0].tolist()])
def test_one_pose_may_stand_alone(pose: Any) -> None:
    np.testing.assert_allclose(as_transforms(pose, None, "A"), TRANSFORMS[:1], atol=1e-15)
    np.testing.assert_allclose(one_transform(pose, "X"), TRANSFORMS[0], atol=1e-15)


def test_matrices_are_not_copied() -> None:
    assert as_transforms(TRANSFORMS, None, "A") is TRANSFORMS


def test_single_precision_and_integers_are_read() -> None:
    assert as_transforms(np.eye(4, dtype=int)[None], None, "A").dtype == np.float64
    # Single precision is off by more than rounding in double, and by less than the tolerance: projected, and said.
    rows, projected, _ = checked_rows(as_transforms(TRANSFORMS.astype(np.float32), None, "A"), 0, "A")
    assert projected == len(TRANSFORMS)
    R = rows_to_transforms(rows)[:, :3, :3]
    assert np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < 1e-15 * 4


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.3 * ROTATION_TOLERANCE))
def test_rotations_slightly_off_are_projected_to_the_nearest(seed: int, size: float) -> None:
    generator = np.random.default_rng(seed)
    T = random_poses(3, 1.0, generator)
    noisy = T.copy()
    noisy[:, :3, :3] += size * generator.uniform(-0.5, 0.5, (3, 3, 3))
    rows, projected, _ = checked_rows(noisy, 0, "A")
    U, _, Vt = np.linalg.svd(noisy[:, :3, :3])  # the nearest in the Frobenius norm
    np.testing.assert_allclose(rows_to_transforms(rows)[:, :3, :3], U @ Vt, rtol=0.0, atol=1e-13)
    np.testing.assert_array_equal(rows_to_transforms(rows)[:, :3, 3], T[:, :3, 3])
    assert projected == 3 or size < 1e-12


def test_exact_rotations_are_left_as_they_are() -> None:
    rows, projected, _ = checked_rows(TRANSFORMS, 0, "A")
    assert projected == 0
    np.testing.assert_array_equal(rows_to_transforms(rows), TRANSFORMS)


@pytest.mark.parametrize("off", [1.01 * ROTATION_TOLERANCE, 0.1, 5.0])
def test_rotations_further_off_are_refused_with_the_size(off: float) -> None:
    bad = TRANSFORMS.copy()
    bad[3, :3, :3] *= np.sqrt(1.0 + off)  # R'R = (1 + off) I
    with pytest.raises(PoseError, match=rf"measurement 3 is off by {off:.3g}"):
        checked_rows(bad, 0, "A")
    almost = TRANSFORMS.copy()
    almost[3, :3, :3] *= np.sqrt(1.0 + 0.99 * ROTATION_TOLERANCE)
    assert checked_rows(almost, 0, "A").projected == 1


@given(st.integers(0, 2**32 - 1), st.sampled_from(["wxyz", "xyzw"]))
def test_quaternion_rows_agree_with_gtsam(seed: int, order: Any) -> None:
    T = random_poses(4, 3.0, np.random.default_rng(seed))
    np.testing.assert_allclose(as_transforms(rows_of_seven(T, order), order, "A"), T, rtol=0.0, atol=4e-15)


def test_quaternions_are_normalised() -> None:
    rows = rows_of_seven(TRANSFORMS, "wxyz")
    rows[:, :4] *= 1.0 + 1e-7
    np.testing.assert_allclose(as_transforms(rows, "wxyz", "A"), TRANSFORMS, rtol=0.0, atol=4e-15)


def test_the_wrong_order_gives_other_poses() -> None:
    rows = rows_of_seven(TRANSFORMS, "wxyz")
    assert np.abs(as_transforms(rows, "xyzw", "A") - TRANSFORMS).max() > 0.1


def product(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Hamilton's product, xyzw, written out."""
    return np.append(q[3] * p[:3] + p[3] * q[:3] + np.cross(q[:3], p[:3]), q[3] * p[3] - q[:3] @ p[:3])


def test_quaternions_are_gtsams_up_to_sign() -> None:
    half_turns = [np.diag(d) for d in ([1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0])]
    R = np.concatenate([random_poses(50, 1.0, np.random.default_rng(0))[:, :3, :3], half_turns])
    q = of_rotations(R)
    expected = np.array([gtsam.Rot3(one).toQuaternion().coeffs() for one in R])
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", q, expected)), 1.0, atol=1e-15)
    np.testing.assert_allclose(to_rotations(2.0 * q), R, atol=1e-14)
    np.testing.assert_allclose(to_rotations(q[3]), R[3], atol=1e-14)


def test_left_and_right_are_the_product() -> None:
    q, p = np.random.default_rng(2).normal(size=(2, 4))
    assert left(q) @ p == pytest.approx(product(q, p))
    assert right(p) @ q == pytest.approx(product(q, p))
    assert left(np.array([q, p]))[1] == pytest.approx(left(p))
    assert right(np.array([q, p]))[0] == pytest.approx(right(q))
    assert product(q, conjugate(q)) == pytest.approx([0, 0, 0, q @ q])
    assert dual_parts(q[None], p[None, :3])[0] == pytest.approx(0.5 * product(np.append(p[:3], 0.0), q))


def test_a_product_turns_after_the_other() -> None:
    R, S = random_poses(2, 1.0, np.random.default_rng(1))[:, :3, :3]
    q, p = of_rotations(np.array([R, S]))
    np.testing.assert_allclose(to_rotations(left(q) @ p), R @ S, atol=1e-14)
