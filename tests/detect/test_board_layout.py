"""Tags of boards are where the board says, or do not count; another layout is found out, and never read."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rendered import BARREL, PINHOLE, Print, bundle, pose, printed, projected, render

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.target_poses import plane_poses
from gtsam_rwhec.cameras.targets import AprilGrid, Bundle, BundleTag, Charuco, Tag, TagGrid, Target
from gtsam_rwhec.detect.board_layout import tag_places, tags_of_board
from gtsam_rwhec.detect.detections import Detection, DetectionOptions, Rejection, layouts_over_track
from gtsam_rwhec.detect.detector import LEGACY, Detector
from gtsam_rwhec.detect.tags import dictionary

CHARUCO = Charuco("board", "aruco_5x5_100", 7, 5, 0.03, 0.0225, first_id=3)
EVEN = Charuco("even", "aruco_5x5_100", 7, 6, 0.03, 0.0225)
GRID = TagGrid("grid", "aruco_4x4_50", 4, 3, 0.03, 0.008)
APRIL = AprilGrid("april", "tag36h11", 4, 3, 0.04, 0.3, first_id=5)
BOX = Bundle(
    "box",
    "tag36h11",
    (
        BundleTag(1, 0.05, (0.0, 0.0, 0.035)),
        BundleTag(2, 0.05, (0.035, 0.0, 0.0), (0.70710678, 0.0, 0.70710678, 0.0)),
        BundleTag(3, 0.05, (0.0, 0.035, 0.0), (0.70710678, -0.70710678, 0.0, 0.0)),
    ),
)
VIEW = pose((25.0, -20.0, 15.0), (0.005, 0.0, 0.32))


def detected(target: Target, picture: Print, T: np.ndarray = VIEW, camera: Camera = PINHOLE) -> list[Detection]:
    (seen,) = Detector(camera, [target])([render(camera, [(picture, T)], blur_px=0.6)])
    return list(seen.detections)


def in_image(target: Charuco | AprilGrid | TagGrid, T: np.ndarray = VIEW) -> np.ndarray:
    """Where the camera sees the tags (n, 4, 2) of a board."""
    return projected(PINHOLE, tag_places(target).reshape(-1, 3), T).reshape(-1, 4, 2)


@pytest.mark.parametrize("target", [CHARUCO, EVEN, GRID, APRIL], ids=lambda target: target.name)
def test_a_boards_corners_come_from_those_of_its_tags_that_are_seen(target: Target) -> None:
    image = render(BARREL, [(printed(target), VIEW)], blur_px=0.6, covered=np.s_[:, 200:])
    ((detection,),) = (seen.detections for seen in Detector(BARREL, [target])([image]))
    assert detection.rejection is None
    assert 6 <= len(detection.indices) < len(target.corners())
    off = detection.corners_px - projected(BARREL, target.corners(), VIEW)[detection.indices]
    assert np.abs(off).max() < 0.3


@pytest.mark.parametrize("legacy", [False, True])
def test_the_pattern_of_before_4_6_is_found_out(legacy: bool) -> None:
    (detection,) = detected(EVEN, printed(EVEN, legacy=legacy))
    assert (detection.rejection, detection.note) == (None, LEGACY if legacy else "")
    off = detection.corners_px - projected(PINHOLE, EVEN.corners(), VIEW)[detection.indices]
    assert np.abs(off).max() < 0.3
    made = cv2.aruco.CharucoBoard((7, 6), 0.03, 0.0225, dictionary("aruco_5x5_100"))
    made.setLegacyPattern(legacy)
    places = np.array(made.getObjPoints()) * [1.0, -1.0, -1.0] + [-0.105, 0.09, 0.0]
    np.testing.assert_allclose(tag_places(EVEN, legacy), places, atol=1e-7)


@pytest.mark.parametrize(
    ("stated", "truth", "cure"),
    [
        (replace(CHARUCO, columns=5, rows=7), CHARUCO, "write squares: [7, 5]"),
        (replace(EVEN, columns=6, rows=7), EVEN, "write squares: [7, 6]"),
        (replace(CHARUCO, first_id=2), CHARUCO, "write first_id: 3"),
        (replace(CHARUCO, columns=8, rows=5), CHARUCO, "count the squares: the markers fit 7 columns"),
        (replace(GRID, columns=3, rows=4), GRID, "write tags: [4, 3]"),
        (replace(GRID, ids=(), first_id=2), replace(GRID, ids=(), first_id=1), "write first_id: 1"),
        (GRID, replace(GRID, ids=(8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3)),
         "write tags: [4, 3], ids: [8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3]"),
        (GRID, replace(GRID, ids=(3, 2, 1, 0, 7, 6, 5, 4, 11, 10, 9, 8)),
         "write tags: [4, 3], ids: [3, 2, 1, 0, 7, 6, 5, 4, 11, 10, 9, 8]"),
        (replace(APRIL, columns=3, rows=4), APRIL, "write tags: [4, 3]"),
        (replace(APRIL, first_id=4), APRIL, "write first_id: 5"),
    ],
)  # fmt: skip
def test_another_layout_is_refused_with_the_one_that_fits(
    stated: Charuco | AprilGrid | TagGrid, truth: Charuco | AprilGrid | TagGrid, cure: str
) -> None:
    (detection,) = detected(stated, printed(truth))
    assert detection.rejection == Rejection.LAYOUT
    assert detection.note.startswith(cure)


def test_an_aprilgrid_that_counts_from_the_top_is_a_tag_grid() -> None:
    seen = in_image(TagGrid("top", "tag36h11", 4, 3, 0.04, 0.012, first_id=5))
    tags = tags_of_board(APRIL, np.arange(5, 17), seen, PINHOLE)
    assert tags.contradicted
    assert tags.note.startswith("write type: tag_grid, tag_m: 0.04, gap_m: 0.012, tags: [4, 3], ids: [5, 6, 7, 8, 9")


@pytest.mark.parametrize("target", [CHARUCO, GRID, APRIL], ids=lambda target: target.name)
def test_never_a_wrong_corner_where_part_of_another_layout_is_seen(target: Charuco | AprilGrid | TagGrid) -> None:
    # Any three tags in two rows contradict; of fewer, no corner counts that is not the same in both.
    exchanged = replace(target, columns=target.rows, rows=target.columns)
    seen, ids = in_image(target), np.array(target.ids)
    generator = np.random.default_rng(1)
    for count in (2, 3, 5):
        for _ in range(10):
            some = np.sort(generator.permutation(len(ids))[:count])
            tags = tags_of_board(exchanged, ids[some], seen[some], PINHOLE)
            alike = tag_places(exchanged)[some] - tag_places(target)[some]
            if np.ptp(alike.reshape(-1, 3), axis=0).max() < 1e-6:
                assert not tags.contradicted
            elif not tags.contradicted:  # two tags fit many homographies; not with the camera's K
                places = tag_places(exchanged)[some].reshape(-1, 3)
                poses = plane_poses(PINHOLE, [places], [seen[some].reshape(-1, 2)], corner_px=0.1)
                assert count == 2
                assert poses.reprojection_px[0, 0] > DetectionOptions().max_reprojection_px


@pytest.mark.parametrize("target", [CHARUCO, EVEN, GRID, APRIL], ids=lambda target: target.name)
def test_a_tag_that_is_read_elsewhere_is_left_out(target: Charuco | AprilGrid | TagGrid) -> None:
    ids, seen = np.array(target.ids), in_image(target)
    elsewhere = seen[0] + [60.0, 40.0]
    read = np.append(ids, ids[4])
    tags = tags_of_board(target, read, np.concatenate([seen, [elsewhere]]), PINHOLE)
    assert not tags.contradicted
    assert tags.ids.tolist() == ids.tolist()  # the one at its place counts, of the two with one id
    swapped = ids.copy()
    swapped[[1, 2]] = ids[[2, 1]]
    tags = tags_of_board(target, swapped, seen, PINHOLE)
    assert tags.ids.tolist() == [ids[0], *ids[3:]]
    two = tags_of_board(target, ids[[0, 4]], np.stack([seen[0], seen[0] + [0.0, 90.0]]), PINHOLE)
    assert two.contradicted  # which one is right nobody knows


def test_a_tag_seen_twice_at_one_place_is_not_used() -> None:
    seen = in_image(APRIL)
    tags = tags_of_board(APRIL, np.append(APRIL.ids, 6), np.concatenate([seen, seen[1:2] + 2.0]), PINHOLE)
    assert tags.ids.tolist() == [5, *range(7, 17)]


@pytest.mark.parametrize("camera", [PINHOLE, BARREL], ids=["pinhole", "barrel"])
def test_a_bundle_of_several_planes(camera: Camera) -> None:
    T = pose((35.0, 35.0, 10.0), (0.0, 0.0, 0.25))
    image = render(camera, bundle(BOX, T), blur_px=0.6)
    ((detection,),) = (seen.detections for seen in Detector(camera, [BOX])([image]))
    assert (detection.rejection, len(detection.indices)) == (None, 12)
    off = detection.corners_px - projected(camera, BOX.corners(), T)[detection.indices]
    assert np.abs(off).max() < 0.15
    np.testing.assert_allclose(detection.T[0], T, atol=2e-3)
    np.testing.assert_allclose(detection.T[1], detection.T[0], atol=1e-6)  # there is one pose only


def test_a_bundle_with_a_tag_at_another_place() -> None:
    T = pose((35.0, 35.0, 10.0), (0.0, 0.0, 0.25))
    seen = projected(PINHOLE, BOX.corners(), T).reshape(-1, 4, 2)
    moved = seen.copy()
    moved[1] += [30.0, 0.0]
    assert tags_of_board(BOX, np.array([1, 2, 3]), moved, PINHOLE).ids.tolist() == [1, 3]
    assert tags_of_board(BOX, np.array([2, 1]), moved[[1, 0]], PINHOLE).contradicted
    assert tags_of_board(BOX, np.array([2, 1]), seen[[1, 0]], PINHOLE).ids.tolist() == [2, 1]


def test_a_bundle_in_one_plane_has_both_poses() -> None:
    flat = Bundle("flat", "tag36h11", tuple(BundleTag(i, 0.04, (0.06 * i, 0.0, 0.05)) for i in range(3)))
    T = pose((20.0, 10.0, 5.0), (-0.06, 0.0, 0.3))
    seen = Detector(PINHOLE, [flat])([render(PINHOLE, bundle(flat, T), blur_px=0.6)])
    (detection,) = seen[0].detections
    assert detection.rejection is None
    assert np.isfinite(detection.T).all()
    np.testing.assert_allclose(detection.T[0], T, atol=6e-3)


def test_a_layout_that_some_images_contradict_counts_in_none() -> None:
    exchanged = replace(GRID, columns=3, rows=4)
    upright = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.3))
    whole = render(PINHOLE, [(printed(GRID), upright)], blur_px=0.6)
    covered = whole.copy()
    tags = in_image(GRID, upright)
    covered[int(tags[4, :, 1].min()) - 2 :] = covered[:, int(tags[3, :, 0].min()) - 2 :] = 115
    # Of three tags of the first row no image alone tells anything.
    seen = Detector(PINHOLE, [exchanged])([whole, covered, whole])
    track = [detection for of_image in seen for detection in of_image.detections]
    assert [detection.rejection for detection in track] == [Rejection.LAYOUT, None, Rejection.LAYOUT]
    judged = layouts_over_track(track)
    assert {(d.rejection, d.note) for d in judged} == {(Rejection.LAYOUT, "write tags: [4, 3]")}
    assert layouts_over_track(track[1:2]) == track[1:2]


def test_a_mirrored_image_is_told_by_its_tags() -> None:
    tag = Tag("tag", "tag36h11", 7, 0.1)
    image = np.ascontiguousarray(render(PINHOLE, [(printed(tag), VIEW)])[:, ::-1])
    (seen,) = Detector(PINHOLE, [tag])([image])
    assert seen.detections == ()
    assert seen.strangers == {("mirrored tag36h11", 7): 1}
