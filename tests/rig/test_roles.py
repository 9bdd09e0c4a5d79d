"""Eye-in-hand or eye-to-hand: what solving both ways tells, and where it cannot tell."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3

from gtsam_rwhec.cameras.targets import CORNERS, Checkerboard, CircleGrid, Tag, Target
from gtsam_rwhec.detect.detector import Detection
from gtsam_rwhec.rig.carrier_roles import Seen, evidence_of_roles

TAG = Tag("tag", "tag36h11", 0, 0.1)


def poses(rng: np.random.Generator, number: int, turn_rad: float = 1.0, move_m: float = 0.5) -> np.ndarray:
    return se3.expmap(
        np.concatenate([turn_rad * rng.normal(size=(number, 3)), move_m * rng.normal(size=(number, 3))], 1)
    )


def detection(T: np.ndarray) -> Detection:
    both = np.stack([T, np.full((4, 4), np.nan)])
    covariance = np.tile(1e-6 * np.eye(6), (2, 1, 1))
    return Detection(
        "tag", np.zeros((4, 2)), np.arange(4), both, np.array([0.1, np.nan]), np.zeros(2), covariance, 50.0, 1.0
    )


def seen(
    T: np.ndarray, on_child: bool, rng: np.random.Generator, target: Target = TAG, size: float = 1.0
) -> list[Seen]:
    """What a camera on the child or on the parent of poses T sees of a target on the other, `size` times too large."""
    X, Y = poses(rng, 2)
    B = se3.inverse(X) @ (se3.inverse(T) if on_child else T) @ Y
    B = B @ se3.expmap(1e-3 * rng.normal(size=(len(T), 6)))
    B[:, :3, 3] *= size
    return [Seen("camera", target, detection(b), t) for b, t in zip(B, T, strict=True)]


@pytest.mark.parametrize("on_child", [True, False])
def test_both_roles_are_told_apart_with_the_scale(on_child: bool) -> None:
    rng = np.random.default_rng(3)
    found = evidence_of_roles(seen(poses(rng, 10), on_child, rng, size=1.6))
    assert found.role == ("child" if on_child else "parent")
    assert found.sizes == {"tag": pytest.approx(1.0 / 1.6, rel=0.02)}
    assert "over 10 measurements" in found.in_words("base", "hand")


@pytest.mark.parametrize(
    "board", [Checkerboard("board", 4, 4, 0.1), CircleGrid("grid", 7, 5, 0.1), CircleGrid("dot", 7, 5, 0.1, CORNERS[0])]
)
def test_boards_that_look_the_same_turned(board: Checkerboard | CircleGrid) -> None:
    rng = np.random.default_rng(4)
    found = evidence_of_roles(seen(poses(rng, 12), False, rng, board))
    assert found.role == "parent"


def test_what_tells_nothing() -> None:
    rng = np.random.default_rng(5)
    still = np.tile(poses(rng, 1), (10, 1, 1))
    assert evidence_of_roles(seen(still, True, rng)).role is None
    assert evidence_of_roles(seen(poses(rng, 5), True, rng)).role is None  # too few
    assert evidence_of_roles([]).role is None
    nonsense = [Seen("camera", TAG, detection(T), A) for T, A in zip(poses(rng, 12), poses(rng, 12), strict=True)]
    assert evidence_of_roles(nonsense).role is None
    assert evidence_of_roles(nonsense).sizes == {}


def test_moving_without_turning_tells_nothing() -> None:
    rng = np.random.default_rng(6)
    found = evidence_of_roles(seen(poses(rng, 12, turn_rad=0.0), True, rng))
    assert found.role is None


def test_rotations_that_fit_without_the_positions_tell_nothing() -> None:
    """Quaternions in another order turn all rotations alike, and the positions say so."""
    rng = np.random.default_rng(6)
    T = poses(rng, 16)
    measured = seen(T, False, rng)
    other = T.copy()
    other[:, :3, 3] = rng.permutation(T[:, :3, 3])
    found = evidence_of_roles(
        [Seen(one.sensor, one.target, one.detection, A) for one, A in zip(measured, other, strict=True)]
    )
    assert found.role is None
