"""Intrinsics by refinement from corners against ``cv2.calibrateCamera`` alone on the same corners.

    python benchmarks/corner_intrinsics.py [--runs 200] [--workers 1] [--only WORDS]

One fixed camera and a board on the hand (`tests/fitting/simulated_cells.py`): 20 images, or few of them with small
tilts. Stated intrinsics are drawn from the nominal prior. Ours starts at them, and knows A, or estimates its noise (1
mrad and 0.5 mm; or 30 mrad and 30 mm, of which nothing is to be had), with the nominal prior or with none ("unknown").
OpenCV's has a pose of its own for each image, the same four coefficients, and the better of two starts.

Errors of fx, fy, cx, cy are pixels; those of the coefficients are pixels at the image's corner. Ratios are of the roots
of the mean squares, ours over OpenCV's. They are met where the mean difference of the squares, run by run, is not above
zero outside of its 99 % interval; with A known, where it is below zero outside of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import bars
import cv2
import numpy as np
import simulated_cells

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.distortion import coefficient_jacobian
from gtsam_rwhec.fitting.fit_options import Stated
from gtsam_rwhec.fitting.stated_intrinsics import PINHOLE


@dataclass(frozen=True)
class Kind:
    """How cells are made, and what is told of them."""

    told: Stated
    carrier: tuple[float, float] = (0.0, 0.0)
    geometry: dict[str, Any] = field(default_factory=lambda: {"images": 20})

    @property
    def knows_the_arm(self) -> bool:
        """Whether A is exact."""
        return self.carrier == (0.0, 0.0)


WEAK = {"images": 8, "tilt": 0.15}
KINDS = {
    "nominal prior, A known": Kind("nominal"),
    "nominal prior, A's noise estimated": Kind("nominal", (1e-3, 5e-4)),
    "nominal prior, A of no use": Kind("nominal", (0.03, 0.03)),
    "no prior, A known": Kind("unknown"),
    "no prior, A's noise estimated": Kind("unknown", (1e-3, 5e-4)),
    "no prior, A of no use": Kind("unknown", (0.03, 0.03)),
    "8 images, small tilts, nominal prior, A known": Kind("nominal", geometry=WEAK),
    "8 images, small tilts, nominal prior, A's noise estimated": Kind("nominal", (1e-3, 5e-4), WEAK),
}


def one(name: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors of all parameters, in pixels: ours and OpenCV's."""
    kind = KINDS[name]
    given = simulated_cells.cell(seed, cameras=1, stated="nominal", carrier=kind.carrier, **kind.geometry)
    X, Y = given.near(np.random.default_rng(seed))
    options = rw.CornerOptions(stated=kind.told, carrier_noise="exact" if kind.knows_the_arm else "estimate")
    ours = (rw.refine_corners(given.observations, X, Y, options).intrinsics["cam_0"].camera).parameters
    return in_pixels(ours), in_pixels(by_opencv(given.observations))


def by_opencv(observations: rw.Observations) -> np.ndarray:
    """``cv2.calibrateCamera``'s parameters from the camera's corners: the better of its answers from two starts.

    They are the stated intrinsics and the truth. From the stated ones alone it stays in some cells where an image has a
    flat board's other pose, with errors ten times as large, which would say nothing of the others.
    """
    view, stated = observations.views["board", "cam_0"], observations.cameras["cam_0"]
    points = [observations.corners["board"].astype(np.float32)] * len(view.pixels)
    pixels, size = list(view.pixels.astype(np.float32)), (stated.width, stated.height)
    answers = []
    for start in (stated, simulated_cells.CAMERA):
        flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
        rms, K, D, _, _ = cv2.calibrateCamera(
            points, pixels, size, start.K.copy(), np.pad(start.D, (0, 1)), flags=flags
        )
        answers.append((rms, np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], D.ravel()[:4]])))
    return min(answers, key=lambda answer: answer[0])[1]


def in_pixels(parameters: np.ndarray) -> np.ndarray:
    """Errors of fx, fy, cx, cy, and of the coefficients as they move the image's corner."""
    camera = simulated_cells.CAMERA
    error: np.ndarray = parameters - camera.parameters
    f = camera.K[[0, 1], [0, 1]]
    corner = 0.5 * np.array([camera.width, camera.height]) / f
    moves = np.linalg.norm(coefficient_jacobian(camera.model, camera.D, corner) * f[:, None], axis=0)
    return error * np.concatenate([np.ones(PINHOLE), moves])


def row(what: str, ours: np.ndarray, theirs: np.ndarray, kind: Kind) -> bars.Row:
    """The ratio, with its bar, of squared errors run by run."""
    worse = ours - theirs
    half = 2.58 * worse.std() / np.sqrt(len(worse))
    sizes = np.sqrt([ours.mean(), theirs.mean()])
    figure = f"{sizes[0] / sizes[1]:.2f} ({sizes[0]:.3g} px, {sizes[1]:.3g} px)"
    met = worse.mean() < -half if kind.knows_the_arm else worse.mean() <= half
    return bars.Row(what, figure, "< 1" if kind.knows_the_arm else "<= 1", bool(met))


def rows(runs: int, workers: int, seed: int, only: str) -> list[bars.Row]:
    """The errors of all kinds."""
    table = []
    for name, found in bars.runs_of_kinds(one, KINDS, runs, workers, seed, only):
        ours, theirs = (np.array(each) ** 2 for each in zip(*found, strict=True))
        for what, columns in (("f and c", slice(None, PINHOLE)), ("coefficients", slice(PINHOLE, None))):
            sums = ours[:, columns].sum(axis=1), theirs[:, columns].sum(axis=1)
            table.append(row(f"{name}: {what}", *sums, KINDS[name]))
    return table


if __name__ == "__main__":
    bars.run_script("intrinsics' errors over OpenCV's", rows, runs=200, workers=1, seed=0, only="")
