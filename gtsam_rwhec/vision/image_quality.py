"""How sharp and how bright an image is, and the same image made brighter, smaller or larger, with its camera."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.images import Gray

#: Gray values from which a pixel is saturated.
SATURATED = 253
#: An image is smoothed by the first standard deviation (pixels) against its noise, and blurred by the second, to see
#: how much that changes its edges; with the second pair where they are wider than `WIDE_PX`.
AGAIN_PX, WIDE_PX = ((0.7, 1.5), (2.0, 4.0)), 1.8
#: The strongest edges that are looked at, as a share of the pixels, and their gradient at least (gray values a pixel).
EDGES, LEAST_GRADIENT = 0.003, 2.0
#: Edges are looked at by this number of directions, each where it has this number of them.
DIRECTIONS, FEWEST_EDGES = 8, 40
#: A brightened image goes from black to white between these percentiles of its gray values.
DARKEST, BRIGHTEST = 0.5, 99.7


def edge_blur_px(gray: Gray) -> float:
    """The standard deviation of the blur across an image's strongest edges, pixels; nan without any.

    Of a step that is blurred by s, a blur by s0 more lowers the gradient in its middle by R = sqrt(1 + s0^2 / s^2)
    (Zhuo and Sim 2011, equation 5). Wide edges are measured again with a larger s0, which noise disturbs less.
    """
    blur_px = _edge_blur_px(gray, *AGAIN_PX[0])
    return _edge_blur_px(gray, *AGAIN_PX[1]) if blur_px > WIDE_PX else blur_px


def motion_blur_px(gray: Gray) -> tuple[float, float]:
    """The blur of edges by their direction, where it is widest and where it is narrowest (pixels); nan without both.

    The standard deviation as in `edge_blur_px`, of edges by their direction: what moves blurs the edges across its way,
    and leaves those along it sharp. A lens that is out of focus blurs all alike.
    """
    smooth = cv2.GaussianBlur(np.asarray(gray, dtype=np.float32), (0, 0), AGAIN_PX[0][0])
    again = cv2.GaussianBlur(smooth, (0, 0), AGAIN_PX[0][1])
    x, y = _slopes(np.asarray(smooth))
    first, second = np.asarray(cv2.magnitude(x, y)), _gradient(np.asarray(again))
    peak = (first >= cv2.dilate(first, np.ones((3, 3), np.uint8))) & (first >= LEAST_GRADIENT)
    direction = np.rint(np.arctan2(y, x) % np.pi / np.pi * DIRECTIONS).astype(int) % DIRECTIONS
    found = []
    for number in range(DIRECTIONS):
        of_these = peak & (direction == number)
        if of_these.sum() < FEWEST_EDGES:
            continue
        some = of_these & (first >= np.median(first[of_these]))
        ratio = max(float(np.median(first[some] / np.maximum(second[some], 1e-6))), 1.01)
        found.append(float(np.sqrt(max(AGAIN_PX[0][1] ** 2 / (ratio**2 - 1.0) - AGAIN_PX[0][0] ** 2, 0.0))))
    return (max(found), min(found)) if len(found) > 1 else (float("nan"), float("nan"))


def _edge_blur_px(gray: Gray, first_px: float, again_px: float) -> float:
    smooth = cv2.GaussianBlur(np.asarray(gray, dtype=np.float32), (0, 0), first_px)
    again = cv2.GaussianBlur(smooth, (0, 0), again_px)
    first, second = (_gradient(np.asarray(values, dtype=np.float32)) for values in (smooth, again))
    peak = (first >= cv2.dilate(first, np.ones((3, 3), np.uint8))) & (first >= LEAST_GRADIENT)
    strong = np.sort(first[peak])[-max(20, round(EDGES * gray.size)) :]
    if len(strong) < 20:
        return float("nan")
    some = peak & (first >= strong[0])
    ratio = max(float(np.median(first[some] / np.maximum(second[some], 1e-6))), 1.01)
    # What the gradients were first smoothed by is taken off again.
    return float(np.sqrt(max(again_px**2 / (ratio**2 - 1.0) - first_px**2, 0.0)))


def saturated_share(gray: Gray) -> float:
    """The share of the pixels that are saturated."""
    return float((gray >= SATURATED).mean())


def brightest_value(gray: Gray) -> float:
    """The gray value that 99.7 % of the pixels are below."""
    return float(np.percentile(gray[::2, ::2], BRIGHTEST))


def brightened(gray: Gray) -> Gray:
    """The image with its gray values stretched from black to white, after a little blur against its noise."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    low, high = np.percentile(smooth[::2, ::2], (DARKEST, BRIGHTEST))
    light: Gray = np.clip(np.rint(255.0 * (smooth - low) / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    return light


def folded(gray: Gray, level: float) -> Gray:
    """How far gray values are from a level, eight times as far: what is darker and what is lighter become light.

    A black square on ground that is nearly as dark gets a light margin where the level is the square's own.
    """
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    apart: Gray = np.clip(8.0 * np.abs(smooth - level), 0.0, 255.0).astype(np.uint8)
    return apart


def resized(gray: Gray, camera: Camera, scale: float) -> tuple[Gray, Camera]:
    """An image of another number of pixels, and its camera."""
    height, width = (max(1, round(scale * n)) for n in gray.shape)
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    K = camera.K.copy()
    for row, factor in enumerate((width / camera.width, height / camera.height)):  # pixel centres are at whole numbers
        K[row, :2] *= factor
        K[row, 2] = factor * (K[row, 2] + 0.5) - 0.5
    smaller = np.asarray(cv2.resize(gray, (width, height), interpolation=way), dtype=np.uint8)
    return smaller, replace(camera, width=width, height=height, K=K)


def _gradient(values: Array) -> Array:
    return np.asarray(cv2.magnitude(*_slopes(values)))


def _slopes(values: Array) -> tuple[Array, Array]:
    x, y = (cv2.Sobel(values, cv2.CV_32F, *order, ksize=3, scale=0.125) for order in ((1, 0), (0, 1)))
    return np.asarray(x), np.asarray(y)
