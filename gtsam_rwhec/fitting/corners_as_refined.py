"""A refinement from corners in the form of every refinement: poses, joint covariance, GTSAM graph; and in numbers.

What the poses' noise model found beyond independent errors of A widens the covariance. Errors that vary with the
configuration of the arm, and their constant part, go through the linear answer of the corners (`systematic`). Errors
that are alike in neighbours in time make N images worth W: the covariance grows by N / W.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from gtsam_rwhec.fitting.corner_noise import Reduced
from gtsam_rwhec.fitting.corner_residuals import SHAPE
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.fit_options import CarrierNoise, CornerOptions, Stated
from gtsam_rwhec.fitting.held_out import HeldOut
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.fitting.projection_uncertainty import as_regions, by_region
from gtsam_rwhec.fitting.refined import FactorGraph, PairNoise, Refined
from gtsam_rwhec.fitting.refinement_from_poses import movements
from gtsam_rwhec.fitting.reprojection_record import (
    SIZE,
    WARPS,
    BoardShape,
    Consequence,
    Intrinsics,
    Reprojection,
    SensorReprojection,
    TriedModel,
)
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array

#: The numbers of a board's shape.
SHAPE_NAMES = (SIZE, *WARPS.values())
assert len(SHAPE_NAMES) == SHAPE


def as_refined(
    base: Refined,
    corners: CornersRefined,
    reprojection: Reprojection,
    intrinsics: Mapping[str, Intrinsics],
    more: Array | None = None,
) -> Refined:
    """The poses, covariances and graph of a refinement from corners, in the place of those from poses.

    Parameters
    ----------
    base : Refined
        The refinement from the same images' poses.
    reprojection, intrinsics
        The same in numbers.
    more : (d, d) array, optional
        Covariance of `corners`' unknowns beyond its own.
    """
    if more is not None:
        corners = replace(corners, joint=corners.joint + more)
        reprojection = replace(reprojection, boards=boards_of(corners))
    joint = _joint(base, corners)
    freedom = min((value for (letter, _), value in corners.freedom.items() if letter in "xy"), default=np.inf)
    cost = float(corners.graph.graph.error(corners.graph.values(corners.point)))
    graph, scale = corners.graph, _scale(base, corners)
    keys = {name: graph.keys[at] for name, at in corners.names.items()}
    refined = replace(
        base,
        X=corners.X,
        Y=corners.Y,
        scale=scale,
        scale_mode="known" if isinstance(scale, float) else "per_target",
        time_offsets_s=base.time_offsets_s | corners.time_offsets_s,
        factor_graph=partial(FactorGraph, graph.graph, graph.values(corners.point), keys),
        noise_source="estimated",
        noise={
            pair: PairNoise(noise.rotation_rad, noise.translation_m, (freedom, freedom))
            for pair, noise in base.noise.items()
        },
        cost=cost,
        initial_cost=cost,
        iterations=corners.iterations,
        moved=movements(base.solution, corners.X, corners.Y),
        joint=joint,
        reprojection=reprojection,
        intrinsics=dict(intrinsics),
    )
    return replace(refined, intrinsics={name: _projected(refined, corners, name) for name in refined.intrinsics})


def _projected(refined: Refined, corners: CornersRefined, sensor: str) -> Intrinsics:
    """A sensor's intrinsics with how sure projections are at the depth where it saw its corners."""
    intrinsics, seen = refined.intrinsics[sensor], []
    for stack in corners.graph.model.stacks:
        if stack.sensor == sensor:
            z = corners.graph.model.seen(stack, corners.point).z[stack.known]
            x = intrinsics.camera.undistort(stack.pixels[stack.known])
            seen.append(z[:, None] * np.concatenate([x, np.ones((len(x), 1))], axis=1))
    points = np.concatenate(seen)
    points = points[np.isfinite(points).all(axis=1)]
    distance_m = float(np.median(points[:, 2]))
    regions = by_region(intrinsics.camera, refined.covariance(f"intrinsics:{sensor}"), points, distance_m)
    deviations = tuple(np.sqrt(np.diagonal(refined.covariance(f"intrinsics:{sensor}"))).tolist())
    return replace(intrinsics, standard_deviations=deviations, projection_px=regions, projection_m=distance_m)


def boards_of(corners: CornersRefined) -> dict[str, BoardShape]:
    """What is free of each board, with its deviations."""
    found = {}
    for name in corners.X:
        free = corners.graph.model.free_shape(name)
        board = BoardShape((), (), ())
        if len(free):
            board = BoardShape(
                tuple(SHAPE_NAMES[i] for i in free),
                tuple(corners.shapes[name][free].tolist()),
                tuple(np.sqrt(np.diagonal(corners.covariance(f"shape:{name}"))).tolist()),
            )
        if name in corners.point.corners:
            deviations = np.sqrt(np.diagonal(corners.covariance(f"corners:{name}"))).reshape(-1, 3)
            off = corners.point.corners[name]
            board = replace(board, corners_off_m=_in_rows(off), corners_deviations_m=_in_rows(deviations))
        if board.names or board.corners_off_m:
            found[name] = board
    return found


def _in_rows(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, values.tolist()))


def intrinsics_of(corners: CornersRefined, stated: Mapping[str, Stated]) -> dict[str, Intrinsics]:
    """Each sensor's intrinsics in numbers, without the projection's uncertainty; `stated` says where they are from."""
    found = {}
    camera_of = corners.graph.model.camera_of
    for name, refined in corners.intrinsics.items():
        camera, mean = refined.camera, corners.graph.model.camera_priors[camera_of[name]].mean
        found[name] = Intrinsics(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            shared_with=tuple(other for other in camera_of if other != name and camera_of[other] == camera_of[name]),
            names=refined.names,
            values=tuple(corners.point.cameras[camera_of[name]].tolist()),
            standard_deviations=refined.standard_deviations,
            stated=tuple(mean.tolist()),
            stated_deviations=tuple(refined.prior.deviation.tolist()),
            stated_as=stated[name],
            widened=refined.widened,
            innovation_deviations=refined.innovation.deviations,
            held_by_prior=refined.held_by_prior,
            rms_px=refined.rms_px,
            not_free=refined.not_free,
        )
    return found


def _joint(base: Refined, corners: CornersRefined) -> JointCovariance:
    """The covariance of frames, scales, offsets, intrinsics and shapes, in GTSAM's order of the unknowns.

    Sensors that share a camera have its rows each: the covariance is singular there, as it is. Places of single corners
    are left out: they are unknowns of the graph, and of no interest beside a board's.
    """
    kinds = {"x": UnknownKind.FRAME, "y": UnknownKind.FRAME, "k": UnknownKind.INTRINSICS, "b": UnknownKind.SHAPE}
    kinds["t"] = UnknownKind.TIME_OFFSET
    slots: dict[Unknown, slice] = {}
    index: list[int] = []
    factors: list[float] = []

    def add(unknown: Unknown, rows: list[int], factor: float = 1.0) -> None:
        if rows:
            slots[unknown] = slice(len(index), len(index) + len(rows))
            index.extend(rows)
            factors.extend([factor] * len(rows))

    for name, (letter, owner) in corners.names.items():
        at = corners.slots[letter, owner]
        rows = list(range(at.start, at.stop))
        if letter == "b" and 0 in corners.graph.model.free_shape(owner):  # scale = stated / true = 1 / (1 + s)
            add(Unknown(UnknownKind.SCALE, owner), rows[:1], -1.0 / (1.0 + corners.shapes[owner][0]) ** 2)
            rows = rows[1:]
        if letter in kinds:
            add(Unknown(kinds[letter], name.partition(":")[2] if letter == "k" else owner), rows)
    finite = corners.joint[np.ix_(index, index)] * np.outer(factors, factors)
    length = float(base.joint.unit[base.joint.slots[Unknown(UnknownKind.FRAME, next(iter(corners.X)))]][3])
    unit = np.ones(len(index))
    for unknown, where in slots.items():
        if unknown.kind is UnknownKind.FRAME:
            unit[where.start + 3 : where.stop] = length
    return JointCovariance(slots, finite, np.zeros((len(index), 0)), unit)


def _scale(base: Refined, corners: CornersRefined) -> float | dict[str, float]:
    """Stated / true lengths: those that are free here, else as before."""
    model = corners.graph.model
    free = {
        name: 1.0 / (1.0 + float(shape[0])) for name, shape in corners.shapes.items() if 0 in model.free_shape(name)
    }
    if isinstance(base.scale, float):
        return dict.fromkeys(corners.X, base.scale) | free if free else base.scale
    return base.scale | free


def numbers_of(
    observations: Observations,
    corners: CornersRefined,
    options: CornerOptions,
    held_out: Mapping[str, HeldOut] | None = None,
    tried: tuple[TriedModel, ...] = (),
) -> Reprojection:
    """Errors of all corners and by sensor, noise, boards, and what errors of what is kept would do.

    Parameters
    ----------
    observations, options
        What was refined from, and how.
    held_out : dict of str to HeldOut, optional
        Errors in images that were left out, by sensor.
    tried : tuple of TriedModel
        Models that were compared.
    """
    there = held_out or {}
    sensors = {name: _of_sensor(name, observations, corners, there.get(name)) for name in corners.Y}
    squares = sum(one.corners * one.rms_px**2 for one in sensors.values())
    given = isinstance(options.carrier_noise, CarrierNoise)
    return Reprojection(
        rms_px=float(np.sqrt(squares / max(sum(one.corners for one in sensors.values()), 1))),
        corner_px=corners.noise.corner_px,
        common_px=corners.noise.common_px,
        carrier_poses="exact" if corners.noise.carrier is None else "given" if given else "estimated",
        carrier_rotation_rad=corners.noise.carrier_rad,
        carrier_translation_m=corners.noise.carrier_m,
        sensors=sensors,
        boards=boards_of(corners),
        tried=tried,
        consequences=consequences_of(corners),
    )


def _of_sensor(
    name: str, observations: Observations, corners: CornersRefined, held_out: HeldOut | None
) -> SensorReprojection:
    views = {pair: view for pair, view in observations.views.items() if pair[1] == name}
    left_out = sum(int(corners.left_out[pair].sum()) for pair in views)
    found = SensorReprojection(
        images=sum(len(view.A) for view in views.values()),
        corners=sum(int(view.known.sum()) for view in views.values()) - left_out,
        left_out=left_out,
        rms_px=corners.intrinsics[name].rms_px,
    )
    if held_out is None:
        return found
    return replace(
        found,
        held_out_px=held_out.rms_px,
        held_out_mm=held_out.rms_mm,
        regions_px=as_regions(held_out.regions_px),
        expected_px=held_out.expected_px,
    )


#: What is asked: pixels of the centre, a share of the focal length, radians of A's rotation about each axis.
CENTRE_PX, FOCAL_SHARE, CARRIER_RAD = 1.0, 1e-3, np.radians(0.1)


#: The cause of A's, in words: how they begin.
OF_CARRIERS = f"{np.degrees(CARRIER_RAD):.1f} degrees of A's noise about each axis"


def consequences_of(refined: CornersRefined) -> tuple[Consequence, ...]:
    """What one pixel of c, one part in a thousand of f and 0.1 degrees of A's noise would do to each frame."""
    slots = refined.slots
    information = np.linalg.inv(refined.joint)
    poses = {name: at for (letter, name), at in slots.items() if letter in "xy"}
    rest = np.concatenate([np.arange(at.start, at.stop) for (letter, _), at in slots.items() if letter != "k"])
    result = []
    for (letter, name), at in slots.items():
        if letter != "k":
            continue
        focal = refined.intrinsics[name].camera.K[[0, 1], [0, 1]]
        steps: dict[str, tuple[int | slice, float | Array]] = {
            f"{CENTRE_PX:g} pixel of {name}'s cx": (2, CENTRE_PX),
            f"{CENTRE_PX:g} pixel of {name}'s cy": (3, CENTRE_PX),
            f"{FOCAL_SHARE:.1%} of {name}'s focal length": (slice(0, 2), FOCAL_SHARE * focal),
        }
        for cause, (which, size) in steps.items():
            dk = np.zeros(at.stop - at.start)
            dk[which] = size
            moved = np.zeros(len(information))
            moved[rest] = -np.linalg.solve(information[np.ix_(rest, rest)], information[rest, at] @ dk)
            for frame, rows in poses.items():
                angle, distance = np.linalg.norm(moved[rows].reshape(2, 3), axis=1).tolist()
                result.append(Consequence(frame, cause, math.degrees(angle), 1e3 * distance))
    # Rotations of A leave the origin of one of the two carriers where it is.
    about = {"targetcarrier": "target carrier", "sensorcarrier": "sensor carrier"}[refined.graph.model.about]
    cause = f"{OF_CARRIERS} (one standard deviation; A turns about the origin of the {about})"
    covariance = _of_carrier_noise(refined)
    for frame, rows in poses.items():
        block = covariance[rows, rows]
        worst = [float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in (block[:3, :3], block[3:, 3:])]
        result.append(Consequence(frame, cause, math.degrees(worst[0]), 1e3 * worst[1]))
    return tuple(result)


def _of_carrier_noise(refined: CornersRefined) -> Array:
    """The covariance of all unknowns from errors of A about each axis, where A is taken as exact."""
    model = refined.graph.model
    reduced = Reduced.of(model, replace(refined.point, A=model.A))
    s2 = refined.noise.corner_px**2
    inverse = np.linalg.inv(reduced.G / s2 + reduced.prior)
    C = reduced.C[:, :3] / s2 * CARRIER_RAD
    flat = C.reshape(-1, C.shape[2])
    covariance: Array = inverse @ (flat.T @ flat) @ inverse
    return covariance
