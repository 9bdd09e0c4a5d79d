"""Checkerboards: all of a workcell's boards, and rendered ones, are read with no corner wrong."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import PINHOLE, pose, printed, projected, render
from scipy.special import ndtr

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.detect.checkerboards import find_checkerboard, fitted_corners
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.files.yaml_lines import read_yaml

CHESS = Checkerboard("chess", 5, 4, 0.03)
WORKCELL = Checkerboard("board", columns=3, rows=4, square_m=0.05)
WITHOUT_A_BOARD = ("0001", "0020", "0140", "0150", "0160")
LARGE = Camera.of(640, 480, "", [[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]], (), "test")


def corners_of(image: np.ndarray, board: Checkerboard = CHESS) -> np.ndarray:
    found = find_checkerboard(image, board)
    assert found is not None
    assert found.rejection is None
    return found.corners_px


@pytest.fixture(scope="module")
def workcell_camera(workcell_camera2: Path) -> Camera:
    fields = read_yaml(workcell_camera2 / "intrinsic_pars_file.yaml").data
    K = np.array([[fields["fx"], 0.0, fields["cx"]], [0.0, fields["fy"], fields["cy"]], [0.0, 0.0, 1.0]])
    return Camera.of(fields["img_width"], fields["img_height"], "none", K, np.zeros(0), "camera2")


def test_all_boards_of_a_workcell_are_read_right(workcell_camera2: Path, workcell_camera: Camera) -> None:
    """Each board's pose follows from the hand's pose and two extrinsics that OpenCV finds: a wrong one would show."""
    detector, T, hand, corners = Detector(workcell_camera, [WORKCELL]), [], [], []
    for path in sorted((workcell_camera2 / "image").glob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        (frame,) = detector([image])
        if path.stem in WITHOUT_A_BOARD:
            assert frame.detections == ()
            continue
        (detection,) = frame.detections
        assert detection.rejection is None, path.name
        T.append(detection.T[0])
        corners.append(detection.corners_px)
        hand.append(np.loadtxt(workcell_camera2 / "pose" / f"{path.stem}.csv"))
    assert len(T) == 34
    # The hand carries the board: T_camera_base T_base_hand T_hand_board = T_camera_board.
    seen, moved = np.array(T), np.array(hand)
    off = np.linalg.norm(reprojected(workcell_camera, seen, moved) - np.array(corners), axis=2)
    assert off.max() < 1.0


@pytest.mark.parametrize(("columns", "rows"), [(3, 3), (4, 4), (3, 5)])
def test_a_workcells_board_is_not_read_as_one_of_another_size(
    workcell_camera2: Path, workcell_camera: Camera, columns: int, rows: int
) -> None:
    # In 0224 OpenCV continues the board into what is behind it, which alternates as a row of squares would.
    for name in ("0224", "0115"):
        image = cv2.imread(str(workcell_camera2 / "image" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        found = find_checkerboard(image, Checkerboard("board", columns, rows, 0.05), workcell_camera)
        assert found is None or found.rejection is not None


def reprojected(camera: Camera, B: np.ndarray, A: np.ndarray) -> np.ndarray:
    """Corners (n, 12, 2) that the joint solution of Y B = A X predicts (Shah 2013, by the Kronecker product)."""
    n = len(A)
    M = sum(np.kron(b[:3, :3], a[:3, :3]) for a, b in zip(A, B, strict=True))
    U, _, Vt = np.linalg.svd(M)
    R_X, R_Y = (_rotation(v.reshape(3, 3, order="F")) for v in (Vt[0], U[:, 0]))
    # R_A t_X - t_Y = R_Y t_B - t_A
    left = np.concatenate([A[:, :3, :3], np.broadcast_to(-np.eye(3), (n, 3, 3))], axis=2).reshape(-1, 6)
    t = np.linalg.lstsq(left, (B[:, :3, 3] @ R_Y.T - A[:, :3, 3]).ravel(), rcond=None)[0]
    X, Y = np.eye(4), np.eye(4)
    X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3] = R_X, t[:3], R_Y, t[3:]
    predicted = np.linalg.inv(Y) @ A @ X
    return np.array([projected(camera, WORKCELL.corners(), T) for T in predicted])


def _rotation(M: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(M * np.sign(np.linalg.det(M)))
    return U @ Vt


@pytest.mark.parametrize("turn", [-170.0, -100.0, -35.0, 10.0, 80.0, 155.0])
def test_a_turned_checkerboard_keeps_its_frame(turn: float) -> None:
    T = pose((20.0, -15.0, turn), (0.01, -0.01, 0.33))
    image = render(PINHOLE, [(printed(CHESS), T)])
    corners = corners_of(image)
    assert np.abs(corners - projected(PINHOLE, CHESS.corners(), T)).max() < 0.15
    np.testing.assert_allclose(corners_of(cv2.rotate(image, cv2.ROTATE_180)), [319, 239] - corners, atol=0.05)


def test_an_outer_edge_is_not_taken_for_corners() -> None:
    # OpenCV takes the fifth row of corners for one of its 5 x 4 in a picture or two of a hundred.
    generator, picture = np.random.default_rng(1), printed(CHESS)
    for seed in range(16):
        T = pose(
            (*generator.uniform(-25, 25, 2), generator.uniform(-180, 180)), (*generator.uniform(-0.01, 0.01, 2), 0.3)
        )
        corners = corners_of(render(PINHOLE, [(picture, T)], blur_px=0.5, seed=seed))
        assert np.abs(corners - projected(PINHOLE, CHESS.corners(), T)).max() < 0.2


@pytest.mark.parametrize("blur_px", [0.5, 1.5])
def test_oblique_boards_partly_in_shade_are_read(blur_px: float) -> None:
    along = np.add.outer(np.arange(480.0), np.arange(640.0)) - 560.0
    shade = 1.0 - 0.6 / (1.0 + np.exp(along / 20.0))  # with a half-shadow
    for tilt, turn in ((62.0, 30.0), (-60.0, 100.0), (50.0, -150.0)):
        T = pose((tilt, 5.0, turn), (0.0, 0.0, 0.3))
        bright = render(LARGE, [(printed(CHESS), T)], blur_px=blur_px, noise=0.0)
        noise = np.random.default_rng(0).normal(scale=4.0, size=bright.shape)
        image = np.clip(bright * shade + noise, 0, 255).astype(np.uint8)
        corners = corners_of(image)
        assert np.abs(corners - projected(LARGE, CHESS.corners(), T)).max() < 0.6


@pytest.mark.parametrize("other", [Checkerboard("larger", 6, 5, 0.025), Checkerboard("smaller", 4, 3, 0.03)])
def test_a_checkerboard_of_another_size_is_not_found(other: Checkerboard) -> None:
    image = render(PINHOLE, [(printed(other), pose((5.0, 5.0, 5.0), (0.0, 0.0, 0.3)))])
    found = find_checkerboard(image, CHESS)
    assert found is None or found.rejection is not None


def test_a_part_of_a_checkerboard_is_not_found() -> None:
    T = pose((10.0, -15.0, 5.0), (0.0, 0.0, 0.3))
    image = render(PINHOLE, [(printed(CHESS), T)], covered=np.s_[:, 160:])
    assert find_checkerboard(image, CHESS) is None


def test_flat_images_and_tiny_ones_have_no_board() -> None:
    for shape in ((480, 640), (5, 5), (1, 1), (40, 2)):
        assert find_checkerboard(np.full(shape, 128, np.uint8), CHESS) is None
    noise = np.random.default_rng(0).integers(0, 256, (480, 640)).astype(np.uint8)
    found = find_checkerboard(noise, CHESS)
    assert found is None or found.rejection in set(Rejection)


def test_of_two_boards_of_one_size_none_counts() -> None:
    scene = [(printed(Checkerboard("c", 5, 4, 0.014)), pose((0.0, 10.0, 10.0), (x, 0.0, 0.3))) for x in (-0.08, 0.08)]
    both = find_checkerboard(render(PINHOLE, scene, blur_px=0.5), CHESS)
    assert both is not None
    assert both.rejection is Rejection.SEEN_TWICE
    assert len(corners_of(render(PINHOLE, scene[:1], blur_px=0.5))) == 20


def test_a_board_with_a_column_more_than_stated_is_refused_for_that() -> None:
    for other in (Checkerboard("wider", 6, 4, 0.025), Checkerboard("higher", 5, 5, 0.025)):
        image = render(PINHOLE, [(printed(other), pose((15.0, 5.0, 25.0), (0.0, 0.0, 0.3)))])
        found = find_checkerboard(image, CHESS)
        assert found is not None
        assert found.rejection is Rejection.OTHER_SIZE


@pytest.mark.parametrize("x", [-0.11, 0.1, 0.12])
def test_a_board_that_the_image_cuts_is_not_read(x: float) -> None:
    image = render(PINHOLE, [(printed(CHESS), pose((0.0, 25.0, 5.0), (x, 0.0, 0.28)))])
    found = find_checkerboard(image, CHESS, PINHOLE)
    assert found is None or found.rejection is not None


ROWS, COLUMNS, STEP_PX = 3, 4, 24.0
#: Pixels of squares, of a board that is turned and sheared.
J = STEP_PX * np.array([[0.96, -0.2], [0.25, 0.7]])
FIRST = np.array([40.3, 32.7])
OFF_PX = np.array([0.8, -0.6])


def on_image(squares: np.ndarray) -> np.ndarray:
    return squares @ J.T + FIRST


def board(blur_px: float, gamma: float = 1.0) -> np.ndarray:
    """Gray values 0 to 255 of a blurred board that has no end: products of two square waves."""
    y, x = np.indices((150, 180)).astype(float)
    squares = (np.stack([x, y], axis=-1) - FIRST) @ np.linalg.inv(J).T
    sigma = blur_px * np.linalg.norm(np.linalg.inv(J), axis=1)
    waves = []
    for i in range(2):
        edges = np.arange(-8, 16)
        signs = (-1.0) ** edges
        waves.append(1.0 + (2.0 * ndtr((squares[..., i, None] - edges) / sigma[i]) * signs).sum(axis=-1))
    light = 0.5 + 0.4 * (waves[0] - waves[0].mean().round()) * (waves[1] - waves[1].mean().round())
    return 255.0 * np.clip(light, 0.0, 1.0) ** gamma


TRUTH = on_image(np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).astype(float))


@pytest.mark.parametrize("gamma", [0.5, 1.0, 1.5])
@pytest.mark.parametrize("blur_px", [0.6, 1.5])
def test_corners_are_sharp_from_a_plane_that_is_a_pixel_off(blur_px: float, gamma: float) -> None:
    image = board(blur_px, gamma)
    noise = np.random.default_rng(0).normal(scale=2.0, size=image.shape)
    gray = np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
    fitted = fitted_corners(gray, lambda squares: on_image(squares) + OFF_PX, ROWS, COLUMNS)
    assert fitted.good.all()
    assert np.sqrt(((fitted.corners_px - TRUTH) ** 2).mean()) < 0.03
    if gamma == 1.0:
        assert np.abs(fitted.blur_px - blur_px).max() < 0.15


def test_a_shadows_edge_does_not_move_corners() -> None:
    image = board(1.0)
    along = np.indices(image.shape)[1] - TRUTH[1, 1, 0] - 6.0
    gray = np.rint(image * (1.0 - 0.5 * ndtr(along / 3.0))).astype(np.uint8)
    fitted = fitted_corners(gray, on_image, ROWS, COLUMNS)
    off = np.linalg.norm(fitted.corners_px - TRUTH, axis=-1)
    assert fitted.good.all()
    assert off[fitted.sharp].max() < 0.25
    assert np.median(off) < 0.02
    assert fitted.sharp.mean() > 0.8


def test_where_no_squares_meet_nothing_is_good() -> None:
    y, x = np.indices((150, 180))
    for image in (np.full((150, 180), 128), 40 + 200 * (x > 70), 255 * ((x // 3 + y // 3) % 2), 255 * (x % 2)):
        fitted = fitted_corners(image.astype(np.uint8), on_image, ROWS, COLUMNS)
        assert not fitted.good.any()
        assert np.isfinite(fitted.corners_px).all()


def test_a_board_outside_the_image_is_not_good() -> None:
    fitted = fitted_corners(board(1.0).astype(np.uint8), lambda squares: on_image(squares) + 1e4, ROWS, COLUMNS)
    assert not fitted.good.any()
