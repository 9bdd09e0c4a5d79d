"""Images of a printed target under a lens, light, blur and noise, with the truth; by OpenCV's projection alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from rendered_prints import Array, Picture, Print
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera

Gray = npt.NDArray[np.uint8]

#: Rays a pixel along each axis.
SAMPLES = 4
#: The inverse of the distortion is found at every second pixel: between them it is linear to 1e-3 pixels.
COARSE = 2
WIDTH, HEIGHT = 720, 540
#: The greatest tilt of a target from the line of sight, degrees.
MOST_TILT_DEG = 70.0
#: Poses are drawn anew up to this often until the target is whole in the image; then it is cut.
TRIES = 30


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera and T_camera_target, with the tilt from the line of sight."""

    camera: Camera
    T: Array
    tilt_deg: float


@dataclass(frozen=True)
class Light:
    """What happens between paper and gray values."""

    #: black, white: Of ink and of paper, of full scale.
    black: float
    white: float
    vignetting: float  #: The share of light that the image's corners lose
    blur_px: float  #: Standard deviation
    motion_px: tuple[float, float]  #: The way of the image during the exposure
    gamma: float  #: Gray values are light to this power
    noise: float  #: Standard deviation, of 255


def random_camera(rng: np.random.Generator) -> Camera:
    """A lens between wide and long, with the distortion that goes with it."""
    focal = np.exp(rng.uniform(np.log(450.0), np.log(1400.0)))
    K = [
        [focal, 0.0, WIDTH / 2 + rng.uniform(-15, 15)],
        [0.0, focal * rng.uniform(0.995, 1.005), HEIGHT / 2],
        [0, 0, 1],
    ]
    wide = (450.0 / focal) ** 2
    k1 = rng.uniform(-0.25, 0.08) * wide
    D = [k1, -0.3 * k1 * wide, *rng.uniform(-5e-4, 5e-4, 2)]
    return Camera.of(WIDTH, HEIGHT, "plumb_bob", K, D, "rendered")


def random_pose(
    rng: np.random.Generator, camera: Camera, outline: Array, element_m: float, sides_px: tuple[float, float]
) -> Pose:
    """A target whose elements' shorter sides are about as long; whole in the image if that comes out.

    Parameters
    ----------
    outline : (n, 3)
        Points of the target that must be in the image, metres.
    element_m : float
        A square's side, or what else must be large enough.
    sides_px : pair of float
        The range of shorter projected sides.
    """
    focal = float(camera.K[0, 0])
    for _ in range(TRIES):
        tilt = np.radians(rng.uniform(0.0, MOST_TILT_DEG))
        towards, turn = rng.uniform(0.0, 2.0 * np.pi, 2)
        side_px = np.exp(rng.uniform(*np.log(sides_px)))
        pixel = rng.uniform((0.15 * WIDTH, 0.15 * HEIGHT), (0.85 * WIDTH, 0.85 * HEIGHT))
        ray = np.append((pixel - camera.K[:2, 2]) / np.diagonal(camera.K)[:2], 1.0)
        ray /= np.linalg.norm(ray)
        to_ray = np.cross([0.0, 0.0, 1.0], ray)
        T = se3.pose(
            _turned(to_ray / max(np.linalg.norm(to_ray), 1e-12) * np.arccos(np.clip(ray[2], -1, 1)))
            @ _turned(tilt * np.array([np.cos(towards), np.sin(towards), 0.0]))
            @ np.diag([1.0, -1.0, -1.0])
            @ _turned([0.0, 0.0, turn]),
            ray * focal * element_m * np.cos(tilt) / side_px,
        )
        pose = Pose(camera, T, float(np.degrees(tilt)))
        if is_whole(pose, outline):
            break
    return pose


def is_whole(pose: Pose, outline: Array) -> bool:
    """Whether an outline (n, 3) is in the image."""
    if ((outline @ pose.T[:3, :3].T + pose.T[:3, 3])[:, 2] < 1e-3).any():
        return False
    pixels = projected(pose.camera, outline, pose.T)
    return bool(((pixels >= 1.0) & (pixels <= np.array([WIDTH, HEIGHT]) - 2.0)).all())


def random_light(rng: np.random.Generator) -> Light:
    """Of any camera that somebody has set up with some care."""
    black, white = rng.uniform(0.02, 0.12), rng.uniform(0.5, 0.95)
    way = rng.uniform(0.0, 1.5) * (rng.random() < 0.3)
    angle = rng.uniform(0.0, np.pi)
    return Light(
        black, white, rng.uniform(0.0, 0.4), rng.uniform(0.3, 1.5),
        (float(way * np.cos(angle)), float(way * np.sin(angle))), float(np.exp(rng.uniform(-0.7, 0.2))),
        rng.uniform(0.5, 4.0),
    )  # fmt: skip


def projected(camera: Camera, points: Array, T: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) of a target, by OpenCV."""
    flat = np.ascontiguousarray(points, dtype=float).reshape(-1, 1, 3)
    pixels = cv2.projectPoints(flat, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K, camera.D)[0]
    return np.asarray(pixels, dtype=float).reshape(*np.shape(points)[:-1], 2)


def _turned(vector: npt.ArrayLike) -> Array:
    return np.asarray(cv2.Rodrigues(np.asarray(vector, dtype=float))[0], dtype=float)


def pixel_m(pose: Pose, around: Array) -> float:
    """Metres of a picture's pixel: a ray's distance where the target is most foreshortened.

    Larger pixels blur, smaller ones are stepped over: edges would then be at the rays and not at their places.
    """
    nudge = 1e-4 * np.abs(around).max()
    at = projected(pose.camera, around, pose.T)
    along = [(projected(pose.camera, around + nudge * axis, pose.T) - at) / nudge for axis in np.eye(3)[:2]]
    least = np.linalg.svd(np.stack(along, axis=-1), compute_uv=False)[:, -1].min()
    return float(1.0 / (SAMPLES * least))


def laid_over(image: Picture, pose: Pose, what: Print, light: Light) -> None:
    """Draw a print over an image of light (height, width), 0 to 1."""
    height, width = what.picture.shape
    half = 0.5 * what.pixel_m * np.array([width, height])
    share = np.linspace(-1.0, 1.0, 21)
    edge = np.concatenate([np.column_stack([share, s + 0 * share]) for s in (-1, 1)])
    edge = np.concatenate([edge, edge[:, ::-1]]) * half
    around = projected(pose.camera, np.column_stack([edge, np.zeros(len(edge))]), pose.T)
    low = np.maximum(np.floor(around.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(around.max(axis=0)).astype(int) + 3, [WIDTH, HEIGHT])
    if (high <= low).any():
        return
    size = COARSE * (-(-(high - low) // COARSE) + 2)  # with a coarse pixel more on each side
    first = low - COARSE
    steps = [first[i] + COARSE * np.arange(size[i] // COARSE) + 0.5 * (COARSE - 1) for i in range(2)]
    x = _undistorted(pose.camera, np.stack(np.meshgrid(*steps), axis=-1))
    x = cv2.resize(x, size.tolist(), interpolation=cv2.INTER_LINEAR)
    on_plane = what.pixel_m * np.array([[1.0, 0.0, 0.5 - 0.5 * width], [0.0, -1.0, 0.5 * height - 0.5]])
    back = np.linalg.inv(pose.T[:3, :2] @ on_plane + np.outer(pose.T[:3, 3], [0.0, 0.0, 1.0]))
    places = x @ back[:, :2].T + back[:, 2]
    depth = np.where(places[..., 2] > 0.0, places[..., 2], np.nan)
    places = np.nan_to_num(places[..., :2] / depth[..., None], nan=-9.0)
    fine = cv2.resize(
        np.clip(places, -9.0, 1e4).astype(np.float32), (SAMPLES * size).tolist(), interpolation=cv2.INTER_LINEAR
    )
    inside = slice(COARSE * SAMPLES, None)
    fine = fine[inside, inside][: SAMPLES * (high - low)[1], : SAMPLES * (high - low)[0]]
    seen = cv2.remap(what.picture, np.ascontiguousarray(fine), None, cv2.INTER_LINEAR, borderValue=-1e6)
    there = (seen >= 0.0).astype(np.float32)
    shape = tuple(int(n) for n in high - low)
    ink = cv2.resize(np.where(seen >= 0.0, seen, 0.0), shape, interpolation=cv2.INTER_AREA)
    share_there = cv2.resize(there, shape, interpolation=cv2.INTER_AREA)
    here = image[low[1] : high[1], low[0] : high[0]]
    here[:] = (1.0 - share_there) * here + light.black * share_there + (light.white - light.black) * ink


def _undistorted(camera: Camera, pixels: Array) -> Array:
    """Normalised coordinates (..., 2), by a fixed point."""
    x0 = (pixels - camera.K[:2, 2]) / np.diagonal(camera.K)[:2]
    x, (k1, k2, p1, p2) = x0, camera.D[:4]
    for _ in range(12):
        r2, ab = (x * x).sum(axis=-1), x.prod(axis=-1)
        off = np.stack(
            [2.0 * p1 * ab + p2 * (r2 + 2.0 * x[..., 0] ** 2), p1 * (r2 + 2.0 * x[..., 1] ** 2) + 2.0 * p2 * ab],
            axis=-1,
        )
        x = (x0 - off) / (1.0 + k1 * r2 + k2 * r2 * r2)[..., None]
    return x


def shade(rng: np.random.Generator, hull: Array) -> Picture:
    """Light (height, width) beside a shadow whose edge crosses a target's outline (n, 2), pixels."""
    share = rng.dirichlet(np.ones(len(hull)))
    angle = rng.uniform(0.0, 2.0 * np.pi)
    y, x = np.indices((HEIGHT, WIDTH))
    along = (np.stack([x, y], axis=-1) - share @ hull) @ [np.cos(angle), np.sin(angle)]
    half_shadow = np.exp(rng.uniform(np.log(1.0), np.log(25.0)))
    lost = rng.uniform(0.2, 0.65)
    return np.asarray(1.0 - lost / (1.0 + np.exp(-np.clip(along / half_shadow, -50, 50))), dtype=np.float32)


def seen_by_camera(rng: np.random.Generator, lit: Picture, light: Light) -> Gray:
    """Gray values of light (height, width), 0 to 1: vignetting, blur, motion, gamma, noise."""
    y, x = np.indices(lit.shape)
    away = np.hypot(x - lit.shape[1] / 2, y - lit.shape[0] / 2) / np.hypot(*lit.shape) * 2.0
    image = (lit * (1.0 - light.vignetting * away**2)).astype(np.float32)
    image = cv2.GaussianBlur(image, (0, 0), light.blur_px)
    if any(light.motion_px):
        size = 9
        grid = np.stack(np.meshgrid(*2 * [np.arange(size) - size // 2]), axis=-1)
        path = np.linspace(-0.5, 0.5, 41)[:, None] * np.array(light.motion_px)
        near = np.clip(1.0 - np.abs(grid[:, :, None] - path), 0.0, 1.0).prod(axis=-1).sum(axis=-1)
        image = cv2.filter2D(image, -1, (near / near.sum()).astype(np.float32), borderType=cv2.BORDER_REPLICATE)
    noisy = 255.0 * np.clip(image, 0.0, 1.0) ** light.gamma + light.noise * rng.normal(size=image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def flat(rng: np.random.Generator) -> Picture:
    return np.full((HEIGHT, WIDTH), rng.uniform(0.05, 0.9), dtype=np.float32)


def gradient(rng: np.random.Generator) -> Picture:
    corners = rng.uniform(0.05, 0.9, (2, 2)).astype(np.float32)
    return np.asarray(cv2.resize(corners, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def textured(rng: np.random.Generator) -> Picture:
    """Noise of some coarseness, as wood, cloth or carpet."""
    size = int(np.exp(rng.uniform(np.log(2), np.log(60))))
    coarse = rng.normal(size=(HEIGHT // size + 2, WIDTH // size + 2)).astype(np.float32)
    noise = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(rng.uniform(0.2, 0.7) + rng.uniform(0.03, 0.2) * noise, 0, 1), dtype=np.float32)


def cluttered(rng: np.random.Generator) -> Picture:
    """Polygons one over the other, as a workshop's things."""
    image = gradient(rng)
    for _ in range(int(rng.integers(10, 60))):
        about = rng.uniform((0, 0), (WIDTH, HEIGHT))
        polygon = about + rng.uniform(-1, 1, (int(rng.integers(3, 6)), 2)) * np.exp(rng.uniform(2.0, 5.0))
        cv2.fillPoly(image, [np.rint(16 * polygon).astype(np.int32)], float(rng.uniform(0.02, 0.95)), cv2.LINE_AA, 4)
    return image


BACKGROUNDS: tuple[Callable[[np.random.Generator], Picture], ...] = (flat, gradient, textured, cluttered)


def cover(rng: np.random.Generator, image: Picture, hull: Array) -> npt.NDArray[np.bool_]:
    """Lay something over a part of a target's outline (n, 2), as a hand or a cable, and say which pixels it hides."""
    size = float(np.ptp(hull, axis=0).max())
    middle, angle = rng.dirichlet(np.ones(len(hull))) @ hull, rng.uniform(0.0, 2.0 * np.pi)
    along, across = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    half = 0.5 * size * np.exp(rng.uniform(np.log(0.05), np.log(0.6)))
    strip = [middle - half * across, middle + 3 * size * along - half * across]
    strip += [middle + 3 * size * along + half * across, middle + half * across]
    mask = np.zeros(image.shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(16 * np.array(strip)).astype(np.int32), 255, cv2.LINE_AA, 4)
    what = BACKGROUNDS[int(rng.integers(len(BACKGROUNDS)))](rng)
    alpha = mask.astype(np.float32) / 255.0
    image[:] = (1.0 - alpha) * image + alpha * what
    return mask > 0
