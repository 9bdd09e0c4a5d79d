"""Detections, the reasons of rejected detections, and tags of no target."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import PINHOLE, pose, printed, projected, render
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import AprilGrid, Charuco, Checkerboard, Tag, Target
from gtsam_rwhec.detect.detections import DetectionOptions, Rejection
from gtsam_rwhec.detect.detector import Detection, Detector, ImageDetections, grazing_rad
from gtsam_rwhec.errors import OptionError

TAG = Tag("tag", "tag36h11", 7, 0.08)
BOARD = Charuco("board", "aruco_4x4_50", 6, 4, 0.03, 0.0225)
GRID = AprilGrid("grid", "tag36h11", 2, 2, 0.04, 0.3, first_id=20)
NEAR = pose((20.0, -15.0, 10.0), (0.01, 0.0, 0.35))


def seen_in(
    image: np.ndarray, *targets: Target, camera: Camera = PINHOLE, options: DetectionOptions | None = None
) -> ImageDetections:
    (seen,) = Detector(camera, targets, options)([image])
    return seen


def only(seen: ImageDetections) -> Detection:
    (detection,) = seen.detections
    return detection


def picture(*scene: tuple[Target, np.ndarray], **how: object) -> np.ndarray:
    return render(PINHOLE, [(printed(target), T) for target, T in scene], **how)  # type: ignore[arg-type]


def test_a_tag_with_its_pose() -> None:
    detection = only(seen_in(picture((TAG, NEAR)), TAG))
    assert (detection.target, detection.rejection) == ("tag", None)
    assert detection.indices.tolist() == [0, 1, 2, 3]
    truth = projected(PINHOLE, TAG.corners(), NEAR)
    np.testing.assert_allclose(detection.corners_px, truth, atol=0.15)
    error = se3.logmap((np.linalg.inv(NEAR) @ detection.T[0])[None])[0]
    assert np.linalg.norm(error[:3]) < np.radians(1.0)
    assert np.linalg.norm(error[3:]) < 0.001
    assert detection.side_px == pytest.approx(np.linalg.norm(truth - np.roll(truth, 1, axis=0), axis=1).min(), abs=0.3)
    assert detection.blur_px == pytest.approx(0.75, abs=0.2)  # 0.7, and the pixels' own
    assert detection.reprojection_px[0] < 0.1


@pytest.mark.parametrize("target", [BOARD, GRID, Checkerboard("chess", 5, 4, 0.03)], ids=lambda target: target.name)
def test_boards_with_their_poses(target: Target) -> None:
    detection = only(seen_in(picture((target, NEAR)), target))
    assert (detection.target, detection.rejection) == (target.name, None)
    error = se3.logmap((np.linalg.inv(NEAR) @ detection.T[0])[None])[0]
    assert np.linalg.norm(error[:3]) < np.radians(0.5)
    assert np.linalg.norm(error[3:]) < 0.001
    assert np.isnan(detection.blur_px)
    assert detection.side_px == pytest.approx(np.ptp(detection.corners_px, axis=0).min())


def the_reason(image: np.ndarray, target: Target, **changes: float) -> Rejection | None:
    # The same image is used with other options: nothing else is wrong with it.
    camera = PINHOLE
    generous = {"min_side_px": 1.0, "min_corners": 1, "max_blur_px": 50.0, "max_grazing_deg": 90.0}
    assert only(seen_in(image, target, camera=camera, options=DetectionOptions(**generous))).rejection is None
    return only(seen_in(image, target, camera=camera, options=DetectionOptions(**(generous | changes)))).rejection


def test_small() -> None:
    far = picture((TAG, pose((20.0, -15.0, 10.0), (0.01, 0.0, 1.2))), blur_px=0.5)
    assert the_reason(far, TAG, min_side_px=24.0) == Rejection.SMALL
    far_board = picture((BOARD, pose((20.0, -15.0, 10.0), (0.01, 0.0, 0.5))), blur_px=0.5)
    assert the_reason(far_board, BOARD, min_side_px=70.0) == Rejection.SMALL


def test_blurred() -> None:
    big = Tag("tag", "tag36h11", 7, 0.2)
    assert the_reason(picture((big, NEAR), blur_px=4.0), big, max_blur_px=3.0) == Rejection.BLURRED
    assert the_reason(picture((big, NEAR), blur_px=2.0), big, max_blur_px=3.0) is None


def test_grazing() -> None:
    slanted = picture((TAG, pose((62.0, 0.0, 0.0), (0.0, 0.0, 0.25))))
    assert the_reason(slanted, TAG, max_grazing_deg=50.0) == Rejection.GRAZING
    assert the_reason(slanted, TAG, max_grazing_deg=70.0) is None


def test_too_few_corners() -> None:
    image = picture((BOARD, NEAR), covered=np.s_[:, 185:])
    count = len(only(seen_in(image, BOARD)).indices)
    assert 6 <= count <= 10
    assert the_reason(image, BOARD, min_corners=count + 1) == Rejection.FEW_CORNERS
    assert the_reason(image, BOARD, min_corners=count) is None


def test_corners_on_a_line_have_no_pose() -> None:
    # Below them a hand; turned a little, so that their bounding box has two sides.
    flat = pose((0.0, 0.0, 3.0), (0.0, 0.0, 0.3))
    rows = projected(PINHOLE, BOARD.corners(), flat).reshape(3, 5, 2)
    image = picture((BOARD, flat), covered=np.s_[int(rows[1, :, 1].mean()) - 2 :, :])
    detection = only(seen_in(image, BOARD, options=DetectionOptions(min_corners=4, min_side_px=1.0)))
    assert set(detection.indices.tolist()) <= {0, 1, 2, 3, 4}
    assert len(detection.indices) >= 4
    assert detection.rejection == Rejection.NO_POSE
    assert np.isnan(detection.T).all()


def test_a_lens_that_folds_back_before_a_corner() -> None:
    folded = Camera.of(320, 240, "plumb_bob", PINHOLE.K, (-1.0, 0.0, 0.0, 0.0), "test")
    assert folded.reach_px == pytest.approx(300.0 * np.sqrt(1.0 / 3.0) * 2.0 / 3.0)
    for target, aside in ((GRID, -0.105), (Checkerboard("chess", 5, 4, 0.03), -0.09)):
        near, far = (picture((target, pose((10.0, 10.0, 0.0), (x, 0.02, 0.35)))) for x in (0.0, aside))
        assert only(seen_in(near, target)).rejection is None
        assert only(seen_in(far, target)).rejection is None
        assert only(seen_in(far, target, camera=folded)).rejection == Rejection.NO_RAY


def test_reprojection_error() -> None:
    image = picture((BOARD, NEAR))
    other = Camera.of(320, 240, "", [[300.0, 0.0, 157.0], [0.0, 420.0, 121.5], [0.0, 0.0, 1.0]], (), "test")
    assert only(seen_in(image, BOARD, camera=other)).rejection == Rejection.REPROJECTION
    assert only(seen_in(image, BOARD)).rejection is None


def test_the_same_id_twice() -> None:
    twin = pose((10.0, 10.0, 0.0), (-0.12, 0.05, 0.4))
    seen = seen_in(picture((TAG, NEAR), (TAG, twin)), TAG, Tag("other", "tag36h11", 8, 0.08))
    assert [(d.target, d.rejection) for d in seen.detections] == [("tag", Rejection.SEEN_TWICE)] * 2
    assert only(seen_in(picture((TAG, NEAR)), TAG)).rejection is None


def test_edges_not_found() -> None:
    # Somebody's finger on one side of the tag: the code is still read, the border's edge is not there.
    truth = projected(PINHOLE, TAG.corners(), pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.2)))
    left, top, right, bottom = (*truth.min(axis=0), *truth.max(axis=0))
    covered = (slice(int(top) - 20, int(bottom) + 20), slice(0, int(left) + 6))
    image = picture((TAG, pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.2)))).copy()
    image[covered] = np.clip(image[covered], 0, 24)  # black as the border: it goes on without an edge
    image[:, : int(left) - 12] = 120
    reasons = {d.rejection for d in seen_in(image, TAG).detections}
    assert reasons <= {Rejection.NO_EDGES, Rejection.REPROJECTION}
    assert right > left


def test_strangers_are_counted() -> None:
    strange = [
        (Tag("a", "tag36h11", 300, 0.05), pose((0.0, 0.0, 0.0), (-0.12, -0.08, 0.4))),
        (Tag("b", "tag36h11", 300, 0.05), pose((0.0, 0.0, 0.0), (0.12, -0.08, 0.4))),
        (Tag("c", "tag36h11", 4, 0.05), pose((0.0, 0.0, 0.0), (-0.12, 0.08, 0.4))),
        (Tag("d", "aruco_4x4_50", 9, 0.05), pose((0.0, 0.0, 0.0), (0.12, 0.09, 0.4))),
    ]
    seen = seen_in(picture((TAG, pose((0.0, 20.0, 0.0), (0.0, 0.0, 0.4))), *strange), TAG)
    assert [d.target for d in seen.detections] == ["tag"]
    assert seen.strangers == {("tag36h11", 300): 2, ("tag36h11", 4): 1}  # of its family
    with_board = seen_in(picture(*strange), TAG, BOARD)
    assert with_board.strangers == {("tag36h11", 300): 2, ("tag36h11", 4): 1}
    assert [d.target for d in with_board.detections if not d.rejection] == []


def test_two_targets_of_one_family() -> None:
    other = Tag("other", "tag36h11", 8, 0.05)
    beside = pose((-20.0, 15.0, 30.0), (-0.1, -0.04, 0.4))
    seen = seen_in(picture((TAG, NEAR), (other, beside)), TAG, other)
    found = {d.target: d for d in seen.detections}
    assert set(found) == {"tag", "other"}
    np.testing.assert_allclose(found["tag"].T[0][:3, 3], NEAR[:3, 3], atol=0.002)
    np.testing.assert_allclose(found["other"].T[0][:3, 3], beside[:3, 3], atol=0.003)
    assert seen.strangers == {}


def test_a_tag_and_a_board_of_one_family_share_no_id() -> None:
    tag = Tag("tag", "aruco_4x4_50", 30, 0.05)
    left, right = pose((0.0, 0.0, 0.0), (-0.09, 0.0, 0.45)), pose((20.0, 0.0, 0.0), (0.12, 0.0, 0.4))
    seen = seen_in(picture((BOARD, left), (tag, right)), BOARD, tag)
    assert sorted(d.target for d in seen.detections if not d.rejection) == ["board", "tag"]
    assert seen.strangers == {}


def test_a_grids_tags_are_no_single_tags() -> None:
    # A double border is another kind of tag: the tag 20 with a single one is not the grid's.
    single = Tag("single", "tag36h11", 20, 0.05)
    image = picture(
        (GRID, pose((0.0, 0.0, 0.0), (-0.06, 0.0, 0.35))), (single, pose((0, 0, 0), (0.1, 0.0, 0.4))), blur_px=0.9
    )
    seen = seen_in(image, GRID, single)
    assert sorted((d.target, d.rejection) for d in seen.detections) == [("grid", None), ("single", None)]
    grid = next(d for d in seen.detections if d.target == "grid")
    assert len(grid.indices) >= 12


def test_an_empty_image_and_no_images() -> None:
    every = [TAG, BOARD, GRID, Checkerboard("chess", 5, 4, 0.03)]
    for image in (np.zeros((240, 320), np.uint8), np.full((240, 320), 255, np.uint8), picture()):
        assert seen_in(image, *every) == ImageDetections((), {})
    assert Detector(PINHOLE, every)([]) == []
    assert seen_in(picture((TAG, NEAR))) == ImageDetections((), {})


def test_many_images_together_give_what_each_gives_alone() -> None:
    other = Tag("other", "tag36h11", 8, 0.05)
    images = [
        picture((TAG, NEAR)),
        picture(),
        picture((other, pose((0.0, 30.0, 0.0), (0.13, 0.0, 0.3))), (BOARD, pose((0.0, 0.0, 0.0), (-0.05, 0.0, 0.35)))),
        picture((TAG, NEAR), (other, pose((0.0, 30.0, 0.0), (-0.1, 0.0, 0.3))), blur_px=1.5),
    ]
    detector = Detector(PINHOLE, [TAG, other, BOARD])
    together = detector(images)
    assert [len(seen.detections) for seen in together] == [1, 0, 2, 2]
    for image, seen in zip(images, together, strict=True):
        (alone,) = detector([image])
        assert alone.strangers == seen.strangers
        for a, b in zip(alone.detections, seen.detections, strict=True):
            assert (a.target, a.rejection) == (b.target, b.rejection)
            np.testing.assert_allclose(a.corners_px, b.corners_px, atol=1e-9)
            np.testing.assert_allclose(a.T, b.T, atol=1e-6)


def test_grazing_is_the_angle_of_the_line_of_sight() -> None:
    assert grazing_rad(pose((0.0, 0.0, 33.0), (0.0, 0.0, 1.0))) == pytest.approx(0.0, abs=1e-7)
    assert grazing_rad(pose((70.0, 0.0, 0.0), (0.0, 0.0, 2.0))) == pytest.approx(np.radians(70.0))
    assert grazing_rad(pose((0.0, 0.0, 0.0), (1.0, 0.0, 1.0))) == pytest.approx(np.radians(45.0))
    assert grazing_rad(pose((180.0, 0.0, 0.0), (0.0, 0.0, 1.0))) == pytest.approx(np.pi)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"min_side_px": 0.0}, "min_side_px=0.0; give a positive number"),
        ({"max_blur_px": -1.0}, "max_blur_px"),
        ({"corner_px": np.nan}, "corner_px=nan"),
        ({"max_reprojection_px": np.inf}, "max_reprojection_px=inf"),
        ({"min_corners": True}, "min_corners=True"),
        ({"ambiguity_margin": "3"}, "ambiguity_margin='3'"),
        ({"max_grazing_deg": 91.0}, "at most 90"),
    ],
)
def test_wrong_options_are_refused(changes: dict[str, float], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        DetectionOptions(**changes)
