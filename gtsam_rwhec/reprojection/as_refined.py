"""A refinement from corners in the form of every refinement: poses, joint covariance, GTSAM graph; and in numbers.

What the poses' noise model found beyond independent errors of A widens the covariance. Errors that vary with the
configuration of the arm, and their constant part, go through the linear answer of the corners (`systematic`). Errors
that are alike in neighbours in time make N images worth W: the covariance grows by N / W.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.refined import PairNoise, Refined
from gtsam_rwhec.refinement.refining import movements
from gtsam_rwhec.refinement.reprojection_found import SIZE, BoardShape, Intrinsics, Reprojection
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind
from gtsam_rwhec.reprojection.corner_views import SHAPE
from gtsam_rwhec.reprojection.intrinsics import Stated
from gtsam_rwhec.reprojection.projection_uncertainty import by_region
from gtsam_rwhec.reprojection.refined import CornersRefined

#: The numbers of a board's shape.
SHAPE_NAMES = (SIZE, "warp_x", "warp_y")
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
    corners : CornersRefined
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
    graph = corners.graph
    keys = {name: key for keys in (graph.x, graph.y) for name, key in keys.items()}
    keys |= {f"intrinsics:{name}": graph.k[graph.model.camera_of[name]] for name in corners.Y}
    keys |= {f"shape:{name}": key for name, key in graph.b.items()}
    keys |= {f"time_offset:{name}": key for name, key in graph.t.items()}
    keys |= {f"corners:{name}": key for name, key in graph.p.items()}
    refined = replace(
        base,
        X=corners.X,
        Y=corners.Y,
        scale=_scale(base, corners),
        scale_mode=_scale_mode(base, corners),
        time_offsets_s=base.time_offsets_s | corners.time_offsets_s,
        graph=graph.graph,
        values=graph.values(corners.point),
        keys=keys,
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
            z = corners.graph.model.depths(stack, corners.point)[stack.known]
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
        camera, mean = refined.camera, corners.graph.model.camera_priors[camera_of[name]][0]
        found[name] = Intrinsics(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            shared_with=tuple(other for other in camera_of if other != name and camera_of[other] == camera_of[name]),
            names=refined.names,
            values=tuple(corners.point.cameras[camera_of[name]].tolist()),
            standard_deviations=refined.standard_deviations,
            stated=tuple(mean.tolist()),
            stated_deviations=tuple(refined.stated_deviations.tolist()),
            stated_as=stated[name],
            widened=refined.widened,
            innovation_deviations=refined.innovation.deviations,
            held_by_prior=refined.held_by_prior,
            rms_px=refined.rms_px,
        )
    return found


def _joint(base: Refined, corners: CornersRefined) -> JointCovariance:
    """The covariance of frames, scales, offsets, intrinsics and shapes, in GTSAM's order of the unknowns.

    Sensors that share a camera have its rows each: the covariance is singular there, as it is. Places of single corners
    are left out: they are unknowns of the graph, and of no interest beside a board's.
    """
    parts: list[tuple[Unknown, slice, float | Array]] = []
    for name, (letter, owner) in corners.names.items():
        rows = corners.slots[letter, owner]
        if letter in "xy":
            parts.append((Unknown(UnknownKind.FRAME, owner), rows, 1.0))
        elif letter == "b":
            free = corners.graph.model.free_shape(owner)
            first = rows.start
            if free[0] == 0:  # the size: scale = stated / true = 1 / (1 + s)
                by_s = -1.0 / (1.0 + corners.shapes[owner][0]) ** 2
                parts.append((Unknown(UnknownKind.SCALE, owner), slice(first, first + 1), by_s))
                first += 1
            if first < rows.stop:
                parts.append((Unknown(UnknownKind.SHAPE, owner), slice(first, rows.stop), 1.0))
        elif letter == "k":
            parts.append((Unknown(UnknownKind.INTRINSICS, name.partition(":")[2]), rows, 1.0))
        elif letter == "t":
            parts.append((Unknown(UnknownKind.TIME_OFFSET, owner), rows, 1.0))
    slots: dict[Unknown, slice] = {}
    index: list[int] = []
    factors: list[Array] = []
    end = 0
    for unknown, rows, factor in parts:
        width = rows.stop - rows.start
        slots[unknown] = slice(end, end + width)
        index += range(rows.start, rows.stop)
        factors.append(np.full(width, factor))
        end += width
    scaling = np.concatenate(factors)
    finite = corners.joint[np.ix_(index, index)] * np.outer(scaling, scaling)
    length = float(base.joint.unit[base.joint.slots[Unknown(UnknownKind.FRAME, next(iter(corners.X)))]][3])
    unit = np.ones(end)
    for unknown, rows in slots.items():
        if unknown.kind is UnknownKind.FRAME:
            unit[rows.start + 3 : rows.stop] = length
    return JointCovariance(slots, finite, np.zeros((end, 0)), unit)


def _scale(base: Refined, corners: CornersRefined) -> float | dict[str, float]:
    """Stated / true lengths: those that are free here, else as before."""
    model = corners.graph.model
    free = {
        name: 1.0 / (1.0 + float(shape[0])) for name, shape in corners.shapes.items() if 0 in model.free_shape(name)
    }
    if isinstance(base.scale, float):
        return dict.fromkeys(corners.X, base.scale) | free if free else base.scale
    return base.scale | free


def _scale_mode(base: Refined, corners: CornersRefined) -> ScaleMode:
    return "known" if isinstance(_scale(base, corners), float) else "per_target"
