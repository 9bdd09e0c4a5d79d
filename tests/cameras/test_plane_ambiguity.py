"""The choice between a plane's two poses: single images are wrong in a quarter of the cases, tracks are not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from rendered import PINHOLE, pose, projected
from rwhec_factors import se3

from gtsam_rwhec.cameras.plane_ambiguity import LEAST_IMAGES, MOST_OF_AN_IMAGE, Choice, choose_over_time
from gtsam_rwhec.cameras.target_poses import PlanePoses, plane_poses
from gtsam_rwhec.cameras.targets import Tag

TAG = Tag("tag", "tag36h11", 0, 0.1)
SIGMA_PX = 0.2
SURE = 3.0


@dataclass(frozen=True, eq=False)
class Track:
    """A far tag, 15 pixels large, before a camera that a robot moves: candidates, the robot's poses, and the truth."""

    stamps_ns: np.ndarray
    poses: PlanePoses
    A: np.ndarray
    B: np.ndarray

    def choice(self, *, with_carrier: bool = True) -> Choice:
        found = self.poses
        return choose_over_time(
            self.stamps_ns, found.T, found.squared_px, found.covariance, SIGMA_PX, self.A if with_carrier else None
        )

    def wrong(self, which: np.ndarray) -> np.ndarray:
        """Where the other candidate is better by more than 5 degrees."""
        turned = np.swapaxes(self.B[:, None, :3, :3], -1, -2) @ np.nan_to_num(self.poses.T[:, :, :3, :3])
        off = np.degrees(np.linalg.norm(se3.so3_logmap(turned.reshape(-1, 3, 3)), axis=1)).reshape(-1, 2)
        each = np.arange(len(which))
        return off[each, which] - off[each, 1 - which] > 5.0


def track(
    seed: int, *, n: int = 100, seconds: float = 0.2, far_m: float = 2.0, tilt_deg: float = 20.0, axes: int = 3
) -> Track:
    """With random extrinsics; the camera turns about all axes, turns about the line of sight, or only shifts."""
    generator = np.random.default_rng(seed)
    t = np.arange(n) * seconds
    phase, rate = generator.uniform(0, 2 * np.pi, 6), generator.uniform(0.5, 1.2, 6)
    wave = np.sin(rate * t[:, None] + phase)
    tilt = np.radians(tilt_deg) * (wave[:, :2] if axes == 3 else np.full((n, 2), 0.7))
    B = np.tile(np.eye(4), (n, 1, 1))
    B[:, :3, 3] = [0.0, 0.0, far_m] + 0.2 * wave[:, 3:]
    turn = np.zeros((n, 6))
    turn[:, 2] = wave[:, 2] if axes else 0.0
    tilted = se3.expmap(np.column_stack([tilt, np.zeros((n, 4))]))
    B[:, :3, :3] = (se3.expmap(turn) @ tilted)[:, :3, :3] @ pose((0, 0, 0), (0, 0, 0))[:3, :3]
    X, Y = se3.expmap(generator.normal(size=(2, 6)))
    corners = TAG.corners()
    pixels = [projected(PINHOLE, corners, T) + generator.normal(scale=SIGMA_PX, size=(4, 2)) for T in B]
    poses = plane_poses(PINHOLE, [corners] * n, pixels, corner_px=SIGMA_PX)
    return Track(np.rint(t * 1e9).astype(np.int64), poses, Y @ B @ np.linalg.inv(X), B)


TRACKS = [track(seed) for seed in range(5)]


def wrong_and_sure(*, with_carrier: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of all images: whether the first candidate is wrong, whether the chosen one is, and whether it is sure."""
    alone = np.concatenate([it.wrong(np.zeros(100, dtype=int)) for it in TRACKS])
    choices = [it.choice(with_carrier=with_carrier) for it in TRACKS]
    wrong = np.concatenate([it.wrong(choice.which) for it, choice in zip(TRACKS, choices, strict=True)])
    return alone, wrong, np.concatenate([choice.margin > SURE for choice in choices])


def test_images_alone_are_wrong_often_and_tracks_are_not() -> None:
    alone, wrong, sure = wrong_and_sure(with_carrier=True)
    assert alone.mean() > 0.2
    assert wrong.mean() < 0.01
    assert sure.mean() > 0.8
    assert not wrong[sure].any()


def test_carriers_link_images_that_are_far_apart_in_time() -> None:
    for seed in range(3):
        it = track(seed, seconds=10.0)
        assert it.wrong(np.zeros(100, dtype=int)).mean() > 0.15
        choice = it.choice()
        assert it.wrong(choice.which).mean() < 0.02
        assert not it.wrong(choice.which)[choice.margin > SURE].any()
        # Without them there is nothing but each image.
        assert it.choice(with_carrier=False).which.tolist() == [0] * 100


def test_without_carriers_neighbouring_images_help() -> None:
    alone, wrong, sure = wrong_and_sure(with_carrier=False)
    assert wrong.mean() < 0.35 * alone.mean()
    assert wrong[sure].mean() < 0.05


@pytest.mark.parametrize("n", [2, 5, LEAST_IMAGES - 1])
def test_few_images_are_chosen_by_the_chain(n: int) -> None:
    it = track(1, n=n)
    choice = it.choice()
    assert choice.which.shape == choice.margin.shape == (n,)
    assert (choice.margin >= 0.0).all()


def test_few_choices_in_short_tracks_are_sure_and_wrong() -> None:
    wrong_and_sure, sure = 0, 0
    for seed in range(8):
        it = track(seed, n=20)
        choice = it.choice()
        wrong_and_sure += int(it.wrong(choice.which)[choice.margin > SURE].sum())
        sure += int((choice.margin > SURE).sum())
    assert sure > 100
    assert wrong_and_sure <= 0.02 * sure


def test_a_far_tag_in_one_image_is_ambiguous_and_a_near_tag_is_not() -> None:
    it = TRACKS[0]
    for k in range(0, 100, 7):
        part = PlanePoses(*(getattr(it.poses, name)[k : k + 1] for name in vars(it.poses)))
        choice = replace(it, stamps_ns=it.stamps_ns[:1], poses=part, A=it.A[k : k + 1]).choice()
        expected = 0.5 * np.ptp(part.squared_px) / SIGMA_PX**2
        assert choice.which.tolist() == [0]
        assert choice.margin[0] == pytest.approx(expected)
    T = pose((35.0, 20.0, 0.0), (0.02, 0.0, 0.3))
    near = plane_poses(PINHOLE, [TAG.corners()], [projected(PINHOLE, TAG.corners(), T)], corner_px=SIGMA_PX)
    choice = choose_over_time(np.zeros(1, dtype=np.int64), near.T, near.squared_px, near.covariance, SIGMA_PX)
    assert choice.margin[0] > SURE


def test_tags_that_turn_about_one_axis_or_not_at_all() -> None:
    # Extrinsics stay undetermined then; choices may be ambiguous, but sure ones are right.
    for seed in range(4):
        for axes in (1, 0):
            it = track(seed, axes=axes)
            choice = it.choice()
            assert not it.wrong(choice.which)[choice.margin > SURE].any()


def test_a_poster_with_the_same_tag_does_not_change_the_other_choices() -> None:
    it = TRACKS[1]
    T, B = it.poses.T.copy(), it.B
    generator = np.random.default_rng(0)
    strangers = generator.permutation(100)[:15]
    T[strangers] = se3.expmap(generator.normal(size=(30, 6))).reshape(15, 2, 4, 4)
    choice = replace(it, poses=replace(it.poses, T=T), B=B).choice()
    others = np.setdiff1d(np.arange(100), strangers)
    assert it.wrong(choice.which)[others].mean() < 0.02


def test_a_late_clock_and_a_shaky_arm_do_no_harm() -> None:
    it = TRACKS[2]
    generator = np.random.default_rng(0)
    shaken = it.A @ se3.expmap(generator.normal(size=(100, 6)) * np.repeat([np.radians(0.5), 0.002], 3))
    late = replace(it, A=np.concatenate([shaken[1:], shaken[-1:]]))  # by 0.2 s
    for other in (replace(it, A=shaken), late):
        choice = other.choice()
        assert it.wrong(choice.which)[choice.margin > SURE].mean() < 0.02


def test_carrier_poses_may_be_missing() -> None:
    it = TRACKS[3]
    A = it.A.copy()
    A[20:45] = np.nan
    choice = replace(it, A=A).choice()
    assert not np.isnan(choice.margin).any()
    known = np.isfinite(A[:, 0, 0])
    assert it.wrong(choice.which)[known].mean() < 0.02
    nothing = replace(it, A=np.full_like(A, np.nan)).choice()
    without = it.choice(with_carrier=False)
    np.testing.assert_array_equal(nothing.which, without.which)
    np.testing.assert_allclose(nothing.margin, without.margin)


def test_a_missing_candidate_is_not_chosen() -> None:
    it = TRACKS[4]
    for gone in (0, 1):
        T, squared = it.poses.T.copy(), it.poses.squared_px.copy()
        covariance = it.poses.covariance.copy()
        T[::3, gone], squared[::3, gone], covariance[::3, gone] = np.nan, np.nan, np.nan
        poses = replace(it.poses, T=T, squared_px=squared, covariance=covariance)
        for with_carrier in (True, False):
            choice = replace(it, poses=poses).choice(with_carrier=with_carrier)
            assert (choice.which[::3] == 1 - gone).all()
            assert np.isinf(choice.margin[::3]).all()


def test_two_candidates_that_are_one_pose_are_sure() -> None:
    it = TRACKS[0]
    T = it.poses.T.copy()
    T[5, 1] = T[5, 0]
    assert np.isinf(replace(it, poses=replace(it.poses, T=T)).choice().margin[5])


def test_no_single_image_decides_against_all_others() -> None:
    it = TRACKS[0]
    squared = it.poses.squared_px.copy()
    right = it.choice().which
    k = int(np.argmax(it.choice().margin))
    squared[k] = np.where(np.arange(2) == right[k], 10.0 * MOST_OF_AN_IMAGE, 0.0)
    choice = replace(it, poses=replace(it.poses, squared_px=squared)).choice()
    assert (choice.which != right).sum() <= 1


def test_no_images_give_no_choices() -> None:
    choice = choose_over_time(
        np.zeros(0, dtype=np.int64), np.zeros((0, 2, 4, 4)), np.zeros((0, 2)), np.zeros((0, 2, 6, 6)), 0.1
    )
    assert choice.which.shape == choice.margin.shape == (0,)
