"""Exact pictures of flat targets, drawn with OpenCV's projection and not with the library's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import AprilGrid, Bundle, Checkerboard, CircleGrid, Tag, TagGrid, Target
from gtsam_rwhec.detect.tags import dictionary

#: Rays a pixel along each axis, and the pictures' pixels along a tag's module.
SAMPLES, PER_MODULE = 4, 16

K_LONG, K_SHORT, K_FISH = (
    [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    for fx, fy, cx, cy in ((300.0, 302.0, 157.0, 121.5), (260.0, 258.0, 157.0, 121.5), (150.0, 149.0, 161.0, 118.5))
)
PINHOLE = Camera.of(320, 240, "", K_LONG, (), "test")
BARREL = Camera.of(320, 240, "plumb_bob", K_SHORT, (-0.28, 0.09, 8e-4, -5e-4), "test")
#: Without distortion, so that its rays have a closed form.
OMNI = Camera.of(320, 240, "unified", [[310.0, 0.0, 161.0], [0.0, 308.0, 118.5], [0.0, 0.0, 1.0]], (1.1,), "test")
FISHEYE = Camera.of(320, 240, "equidistant", K_FISH, (-0.02, 6e-3, -4e-3, 8e-4), "test")


@dataclass(frozen=True, eq=False)
class Print:
    """A printed pattern, gray values 0 to 1, with the frame's origin in its middle; metres per pixel."""

    picture: np.ndarray
    pixel_m: float


def pose(rotation_deg: tuple[float, float, float], t_m: tuple[float, float, float]) -> np.ndarray:
    """T_camera_target; a target that is not turned faces the camera. The target's y is up, the camera's y is down."""
    return se3.pose(cv2.Rodrigues(np.radians(np.array(rotation_deg)))[0] @ np.diag([1.0, -1.0, -1.0]), t_m)


def tag_modules(family: str, number: int, border_bits: int = 1) -> np.ndarray:
    """(n, n) of 0 and 1: a tag with its black border."""
    side = int(dictionary(family).markerSize) + 2 * border_bits
    return cv2.aruco.generateImageMarker(dictionary(family), number, side, borderBits=border_bits) / 255.0


def printed(target: Target, *, quarter_turns: int = 0, legacy: bool = False) -> Print:
    """A target with a white margin; `quarter_turns` turns the tags of an AprilGrid where they are.

    `legacy` gives a ChArUco board the pattern of OpenCV before 4.6.
    """
    if isinstance(target, Tag):
        modules = tag_modules(target.family, target.id)
        return Print(_enlarged(np.pad(modules, 1, constant_values=1.0)), target.size_m / len(modules) / PER_MODULE)
    if isinstance(target, AprilGrid):
        return _aprilgrid(target, quarter_turns)
    if isinstance(target, Checkerboard):
        rows, columns = np.indices((target.rows + 1, target.columns + 1))
        squares = np.pad(((rows + columns) % 2).astype(float), 1, constant_values=1.0)
        return Print(_enlarged(squares, 40), target.square_m / 40)
    if isinstance(target, CircleGrid):
        return circles(target)
    if isinstance(target, TagGrid):
        return tag_grid(target)
    assert not isinstance(target, Bundle), "its tags are printed each: see `bundle`"
    made = cv2.aruco.CharucoBoard(
        (target.columns, target.rows), target.square_m, target.marker_m, dictionary(target.family),
        np.array(target.ids, dtype=np.int32),
    )  # fmt: skip
    made.setLegacyPattern(legacy)
    picture = made.generateImage((target.columns * 80, target.rows * 80), marginSize=0) / 255.0
    return Print(np.pad(picture, 40, constant_values=1.0), target.square_m / 80)


def tag_grid(grid: TagGrid) -> Print:
    """A grid of tags with white gaps and margins."""
    side = PER_MODULE * (int(dictionary(grid.family).markerSize) + 2)
    gap = round(grid.gap_m / grid.tag_m * side)
    picture = np.ones((grid.rows * (side + gap) + gap, grid.columns * (side + gap) + gap))
    for k, number in enumerate(grid.ids):
        y, x = (gap + (side + gap) * place for place in divmod(k, grid.columns))
        picture[y : y + side, x : x + side] = _enlarged(tag_modules(grid.family, number))
    return Print(np.pad(picture, 20, constant_values=1.0), grid.tag_m / side)


def bundle(made: Bundle, T: np.ndarray) -> list[tuple[Print, np.ndarray]]:
    """A bundle's tags with their poses in the camera: those that face it, the furthest first."""
    scene = []
    for tag in made.tags:
        corners = tag.corners()
        across, up = corners[1] - corners[0], corners[0] - corners[3]
        axes = np.stack([across, up, np.cross(across, up) / tag.size_m], axis=1) / tag.size_m
        T_tag = se3.pose(axes, corners.mean(axis=0))
        at = T @ T_tag
        if at[:3, 2] @ at[:3, 3] < 0.0:
            scene.append((printed(Tag("tag", made.family, tag.id, tag.size_m)), at))
    return sorted(scene, key=lambda drawn: -float(drawn[1][2, 3]))


def circles(grid: CircleGrid, *, light: bool = False, at: tuple[int, int] | None = None) -> Print:
    """A grid of circles, dark or light, whose larger one is at its corner or `at` another row and column."""
    steps = grid.steps()
    radii = np.full((grid.rows, grid.columns), 16.0)
    if grid.larger_dot:
        radii[at or (-1 if "lower" in grid.corner else 0, -1 if "right" in grid.corner else 0)] = 26.0
    width, height = (64 * (steps.reshape(-1, 2).max(axis=0) + 1)).astype(int)
    picture = np.ones((height + 64, width + 64))
    y, x = np.indices((64, 64)) - 31.5
    for (column, row), radius in zip(steps.reshape(-1, 2).astype(int), radii.ravel(), strict=True):
        cell = np.clip(np.hypot(x, y) - radius + 0.5, 0.0, 1.0)
        picture[32 + 64 * row :, 32 + 64 * column :][:64, :64] = cell
    return Print(1.0 - picture if light else picture, grid.spacing_m / 64)


def _enlarged(modules: np.ndarray, by: int = PER_MODULE) -> np.ndarray:
    return np.kron(modules, np.ones((by, by)))


def _aprilgrid(grid: AprilGrid, quarter_turns: int) -> Print:
    side = 8 * (int(dictionary(grid.family).markerSize) + 4)
    gap = round(grid.spacing * side)
    pitch = side + gap
    picture = np.ones((grid.rows * pitch + gap, grid.columns * pitch + gap))
    for k, number in enumerate(grid.ids):
        row, column = grid.rows - 1 - k // grid.columns, k % grid.columns
        tag = np.rot90(_enlarged(tag_modules(grid.family, number, 2), 8), quarter_turns)
        picture[gap + row * pitch :, gap + column * pitch :][:side, :side] = tag
    for row in range(grid.rows + 1):  # Kalibr's small black squares between the tags' corners
        for column in range(grid.columns + 1):
            picture[row * pitch :, column * pitch :][:gap, :gap] = 0.0
    return Print(np.pad(picture, 10, constant_values=1.0), grid.tag_m / side)


def projected(camera: Camera, points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of points (n, 3) of a target, by OpenCV, which has no unified model in its main modules."""
    turn = cv2.Rodrigues(T[:3, :3])[0]
    if camera.model == "unified":
        seen = points @ T[:3, :3].T + T[:3, 3]
        seen[:, 2] += camera.D[0] * np.linalg.norm(seen, axis=1)
        return seen[:, :2] / seen[:, 2:] @ camera.K[:2, :2] + camera.K[:2, 2]
    if camera.model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], turn, T[:3, 3], camera.K, camera.D)
    else:
        pixels, _ = cv2.projectPoints(points, turn, T[:3, 3], camera.K, camera.D)
    return pixels[:, 0]


@cache
def _rays(camera: Camera) -> np.ndarray:
    """(height * S, width * S, 2) normalised coordinates of S x S points in each pixel."""
    u, v = np.meshgrid(*((np.arange(n * SAMPLES) + 0.5) / SAMPLES - 0.5 for n in (camera.width, camera.height)))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    if camera.model == "equidistant":
        x = cv2.fisheye.undistortPoints(pixels, camera.K, camera.D)[:, 0]
    else:
        x0 = (pixels[:, 0] - camera.K[:2, 2]) / np.diagonal(camera.K)[:2]
        x = x0.copy()
        if camera.model == "unified":  # the far crossing of the line from (0, 0, -xi) with the unit sphere
            xi, r2 = camera.D[0], (x * x).sum(axis=1)
            far = (xi + np.sqrt(np.maximum(1.0 + (1.0 - xi * xi) * r2, 0.0))) / (1.0 + r2)
            x *= (far / np.maximum(far - xi, 1e-9))[:, None]
        for _ in range(20 if camera.model == "radtan" else 0):
            k1, k2, p1, p2 = camera.D[:4]
            r2, ab = (x * x).sum(axis=1), x.prod(axis=1)
            off = np.column_stack(
                [2 * p1 * ab + p2 * (r2 + 2 * x[:, 0] ** 2), p1 * (r2 + 2 * x[:, 1] ** 2) + 2 * p2 * ab]
            )
            x = (x0 - off) / (1.0 + k1 * r2 + k2 * r2 * r2)[:, None]
    return x.reshape(*u.shape, 2)


def render(
    camera: Camera,
    scene: list[tuple[Print, np.ndarray]],
    *,
    blur_px: float = 0.7,
    noise: float = 2.0,
    seed: int = 0,
    covered: tuple[slice, slice] | None = None,
) -> np.ndarray:
    """(height, width) uint8; the later ones of (what is printed, T_camera_target) lie over the earlier ones.

    `covered` rows and columns are gray: somebody's hand.
    """
    image = np.full((camera.height * SAMPLES, camera.width * SAMPLES), 0.45, dtype=np.float32)
    for what, T in scene:
        height, width = what.picture.shape
        # Of the picture's pixels on the plane, z = 1.
        on_plane = what.pixel_m * np.array([[1.0, 0.0, 0.5 - 0.5 * width], [0.0, -1.0, 0.5 * height - 0.5]])
        H = T[:3, :2] @ on_plane + np.outer(T[:3, 3], [0.0, 0.0, 1.0])
        picture = what.picture.astype(np.float32)
        if camera.model == "pinhole":
            S = np.array([[SAMPLES, 0.0, 0.5 * SAMPLES - 0.5], [0.0, SAMPLES, 0.5 * SAMPLES - 0.5], [0.0, 0.0, 1.0]])
            drawn = cv2.warpPerspective(
                picture, S @ camera.K @ H, image.shape[::-1], flags=cv2.INTER_LINEAR, borderValue=-1e6
            )
        else:
            x = _rays(camera)
            back = np.linalg.inv(H)
            places = x @ back[:, :2].T + back[:, 2]
            with np.errstate(divide="ignore", invalid="ignore"):
                places = np.nan_to_num((places[..., :2] / places[..., 2:]), nan=-9.0, posinf=-9.0, neginf=-9.0)
            places = np.clip(places, -9.0, 1e4).astype(np.float32)
            drawn = cv2.remap(picture, places, None, cv2.INTER_LINEAR, borderValue=-1e6)
        on_it = drawn >= 0.0
        image[on_it] = 0.08 + 0.8 * drawn[on_it]
    image = image.reshape(camera.height, SAMPLES, camera.width, SAMPLES).mean(axis=(1, 3))
    if covered is not None:
        image[covered] = 0.45
    if blur_px > 0.0:
        image = cv2.GaussianBlur(image, (0, 0), blur_px)
    noisy = 255.0 * image + noise * np.random.default_rng(seed).normal(size=image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
