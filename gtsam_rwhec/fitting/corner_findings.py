"""What is doubtful in a refinement from corners, in words with the figures: noise, clocks, intrinsics, optimiser."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtrc

from gtsam_rwhec.fitting.corner_checks import few_corners, findings_of_rays
from gtsam_rwhec.fitting.corner_noise import CARRIER, CORNER_PX
from gtsam_rwhec.fitting.corners_refined import CornersRefined, RefinedIntrinsics
from gtsam_rwhec.fitting.fit_options import CornerOptions
from gtsam_rwhec.fitting.stated_intrinsics import CONTRADICTED, HELD, PARTS, PINHOLE, chance_of, deviations_of

#: Larger noise than any arm or tracker has: rad, m; than any detector has: pixels.
CARRIER_RAD, CARRIER_M, DETECTOR_PX = np.radians(1.0), 0.01, 2.0
#: A noise above this share of its bound is at it.
AT_BOUND = 0.99
#: An optimum is reached where one more step moves it by less than this, in deviations.
LAST_STEP = 0.1
#: Over a longer time than this, s, the carriers' velocity is not constant.
CONSTANT_S = 0.02
#: Distortion that was not stated is reported if chance gives it with less than this probability, and it moves a corner
#: by more pixels than this.
NO_LENS, BEND_PX = 1e-4, 1.0
#: A coefficient is reported if it differs from 0 by so many deviations; at most so many are reported.
TOLD, MOST_TERMS = 3.0, 2
#: More corners than this share left out are many.
MANY = 0.2

CAUSES = "poses of other images, a wrong size of a target, A of a wrong frame, direction or unit, or intrinsics far off"


def is_doubtful(refined: CornersRefined) -> bool:
    """Whether the answer is not to be used: larger noise than any detector, arm or tracker has, or no optimum."""
    noise = refined.noise
    return not (
        noise.corner_px <= DETECTOR_PX
        and noise.carrier_rad <= CARRIER_RAD
        and noise.carrier_m <= CARRIER_M
        and refined.last_step <= LAST_STEP
    )


def findings_of(refined: CornersRefined, options: CornerOptions) -> tuple[str, ...]:
    """What is doubtful, one sentence or two each, the gravest first; empty where nothing is."""
    return (
        *_of_carriers(refined, options),
        *_of_corners(refined),
        *_of_convergence(refined, options),
        *findings_of_rays(refined),
        *_of_clocks(refined),
        *_of_boards(refined),
        *_of_intrinsics(refined, options),
    )


def _of_convergence(refined: CornersRefined, options: CornerOptions) -> Iterator[str]:
    if not refined.last_step <= LAST_STEP:
        yield (
            f"The optimiser has not converged: one more step would move the answer by {refined.last_step:.2g} of its "
            f"deviations. Give more than max_iterations={options.max_iterations}, or a better start."
        )


def _of_carriers(refined: CornersRefined, options: CornerOptions) -> Iterator[str]:
    """Of A's noise, where it was estimated."""
    if options.carrier_noise != "estimate":
        return
    rad, m = refined.noise.carrier_rad, refined.noise.carrier_m
    at_bound = [
        words
        for words, value in ((f"{CARRIER[1]:g} rad", rad), (f"{CARRIER[1]:g} m", m))
        if value >= AT_BOUND * CARRIER[1]
    ]
    size = f"{np.degrees(rad):.2g} degrees and {1e3 * m:.2g} mm"
    if at_bound:
        yield (
            f"The noise of A is at its bound ({' and '.join(at_bound)}), so it is larger still: the images contradict "
            f"A. Do not use this answer. Likely causes: {CAUSES}."
        )
    elif rad > CARRIER_RAD or m > CARRIER_M:
        yield (
            f"The noise of A is estimated as {size}, more than an arm or tracker has: doubt this answer. Likely "
            f"causes: {CAUSES}."
        )


def _of_corners(refined: CornersRefined) -> Iterator[str]:
    px, few = refined.noise.corner_px, few_corners(refined.graph.model)
    if few:
        yield (
            f"There are {few}, which therefore rest on their priors, and on corners that are taken to be right to "
            f"{px:.2g} pixels, as stated (corner_px) or worse: take more images."
        )
    if px > DETECTOR_PX:
        bound = " (its bound)" if px >= AT_BOUND * CORNER_PX[1] else ""
        yield (
            f"Corners are off by {px:.2g} pixels{bound}, more than a detector's noise: doubt this answer. Likely "
            f"causes: noise of A that is not in the model, {CAUSES}."
        )
    for stack in refined.graph.model.stacks:
        for (target, sensor), at in stack.pairs:
            left_out, seen = int(refined.left_out[target, sensor].sum()), int(stack.known[at].sum())
            if left_out > MANY * seen:
                yield (
                    f"{left_out} of {seen} corners of {target} by {sensor} disagree with the others and are left out: "
                    "look at those images (left_out)."
                )


def _of_clocks(refined: CornersRefined) -> Iterator[str]:
    model = refined.graph.model
    for name, offset_s in refined.time_offsets_s.items():
        deviation = float(np.sqrt(refined.covariance(f"time_offset:{name}")[0, 0]))
        if deviation > HELD * model.offset_priors[name]:
            moves = any(stack.twist is not None and stack.twist.any() for stack in model.stacks if stack.sensor == name)
            why = "move alike" if moves else "stand still"
            yield (
                f"The images do not tell the time offset of {name}, since the carriers {why} in all of them: it is "
                f"{round(offset_s, 9) + 0.0:+.2g} s, with a deviation of {deviation:.2g} s. Leave {name} out of "
                "CornerOptions.time_offsets, or take images in motion that speeds up, slows down and turns back."
            )
        elif abs(offset_s) > CONSTANT_S:
            yield (
                f"The images of {name} were taken {1e3 * offset_s:+.3g} ms from the times of their A, and the "
                "carriers' velocity was taken as constant over that time. Give A at the new times, and refine again."
            )


def _of_boards(refined: CornersRefined) -> Iterator[str]:
    for name, deviation in refined.graph.model.corner_priors.items():
        off = refined.point.corners[name]
        posterior = refined.covariance(f"corners:{name}")
        if chance_of(off.ravel(), np.eye(off.size) / deviation, posterior) < CONTRADICTED:
            length = np.linalg.norm(off, axis=1)
            worst = int(np.argmax(length))
            yield (
                f"The corners of {name} are farther from their places than corners_m={deviation:g} explains (corner "
                f"{worst} by {1e3 * length[worst]:.2g} mm): check the board's sizes and the order of its corners, or "
                "give a larger corners_m."
            )


def _of_intrinsics(refined: CornersRefined, options: CornerOptions) -> Iterator[str]:
    """By camera: sensors that share one are named together."""
    sensors: dict[str, list[str]] = {}
    for sensor, camera in refined.graph.model.camera_of.items():
        sensors.setdefault(camera, []).append(sensor)
    for names in sensors.values():
        intrinsics, of = refined.intrinsics[names[0]], ", ".join(names)
        if options.stated_of(options.camera_of(names[0])) == "exact":
            yield f"The intrinsics of {of} are held as stated (exact): how far off they are is in no deviation."
            continue
        lens = lens_that_was_left_out(refined, names)
        if lens:
            yield f"The stated intrinsics of {of} have no distortion, and the images show one: {lens}."
        contradicted = [part for part in intrinsics.innovation.contradicted if not (lens and part == "distortion")]
        if contradicted:
            parts = " and ".join(_off(intrinsics, part) for part in contradicted)
            yield (
                f"The images contradict the stated intrinsics of {of}: {parts}. The estimated ones are used, and the "
                f"stated ones' deviations were widened {intrinsics.widened:.3g} times. Check which calibration they "
                "are from, of which resolution, and the targets' sizes."
            )
        if intrinsics.held_by_prior:
            yield (
                f"The images do not tell {', '.join(intrinsics.held_by_prior)} of {of}: they stay about as stated. If "
                "they matter, take images with the target at the borders, tilted, near and far."
            )


def _off(intrinsics: RefinedIntrinsics, part: str) -> str:
    """How far off a part of the stated intrinsics is: the focal length is off by 1.2 % (8.1 deviations)."""
    off, f = intrinsics.innovation.off[PARTS[part]], intrinsics.camera.focal_px
    size = {
        "focal length": f"{100 * off.mean() / f:+.2g} %",
        "centre": f"({', '.join(f'{value:+.3g}' for value in off)}) pixels",
        "distortion": ", ".join(
            f"{name} {value:+.2g}" for name, value in zip(intrinsics.names[PINHOLE:], off, strict=False)
        ),
    }[part]
    deviations = deviations_of(intrinsics.innovation.probabilities[part])
    return f"the {part} is off by {size} ({deviations:.2g} deviations)"


def lens_that_was_left_out(refined: CornersRefined, sensors: list[str]) -> str:
    """The distortion found for sensors that share a camera stated without distortion; empty if there is none."""
    model, intrinsics = refined.graph.model, refined.intrinsics[sensors[0]]
    mean = model.camera_priors[model.camera_of[sensors[0]]].mean
    D = intrinsics.camera.D
    if intrinsics.camera.model != "radtan" or mean[PINHOLE:].any():
        return ""
    covariance = intrinsics.covariance[PINHOLE:, PINHOLE:]
    if chdtrc(len(D), D @ np.linalg.solve(covariance, D)) > NO_LENS:
        return ""
    camera = intrinsics.camera
    pixels = np.concatenate([stack.pixels[stack.known] for stack in model.stacks if stack.sensor in sensors])
    straight = camera.undistort(pixels) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    bend_px = float(np.nanmax(np.linalg.norm(straight - pixels, axis=1), initial=0.0))
    if bend_px < BEND_PX:
        return ""
    deviations = np.sqrt(np.diagonal(covariance))
    told = np.argsort(-np.abs(D) / deviations)  # those that chance explains least, first
    named = [at for at in told if abs(D[at]) > TOLD * deviations[at]] or told[:MOST_TERMS].tolist()
    terms = [f"{intrinsics.names[PINHOLE + at]} = {D[at]:.3g} +- {deviations[at]:.1g}" for at in named[:MOST_TERMS]]
    return (
        f"a distortion that moves corners by up to {bend_px:.2g} pixels fits ({', '.join(terms)}); the estimated "
        "distortion is used"
    )
