"""Poses of the carriers from which something is seen: drawn around the present one, and kept where all limits hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from gtsam_rwhec.capture.plan_cell import Cell, in_front, nearest_m
from gtsam_rwhec.capture.plan_information import by_corners, by_frames, predicted
from gtsam_rwhec.capture.plan_options import PlanOptions
from gtsam_rwhec.geometry.poses import Array, as_transforms, one_transform
from gtsam_rwhec.problem.measurements import Pair

#: Poses are drawn in batches of so many, until there are enough candidates, and at most so many batches.
BATCH, MOST_BATCHES = 2000, 10
#: Without limits of distance, targets are so many times as near or as far as they were.
AROUND = 1.7
#: A target is surely seen if its corners stay in the image although the frames are off by so many of their deviations.
SURELY = 4.0
#: One radian counts as so many metres in the length of a tour.
METRES_A_RADIAN = 0.3


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses that may be measured, and why others may not."""

    A: Array  #: (N, 4, 4): T_sensorcarrier_targetcarrier
    seen: dict[Pair, Array]  #: (N,): How probably the sensor sees the target; 0 where it is not expected
    joints: Array | None  #: (N, n): of the arm
    #: Of the poses that were drawn: how many there were, a sensor sees a target at, are in the box and within the turn,
    #: and the arm reaches.
    drawn: int
    visible: int
    within: int
    reached: int

    @property
    def certainty(self) -> Array:
        """How probably all that is expected is seen, (N,)."""
        return np.asarray(np.prod([np.where(of > 0.0, of, 1.0) for of in self.seen.values()], axis=0))

    @property
    def number_seen(self) -> np.ndarray:
        """How many targets are expected, (N,)."""
        return np.asarray(np.sum([of > 0.0 for of in self.seen.values()], axis=0))

    def selected(self, at: Sequence[int] | np.ndarray) -> Candidates:
        """Some of them."""
        seen = {pair: where[at] for pair, where in self.seen.items()}
        joints = None if self.joints is None else self.joints[at]
        return Candidates(self.A[at], seen, joints, self.drawn, self.visible, self.within, self.reached)

    def before(self, others: Candidates) -> Candidates:
        """These, and then the others; with the others' counts."""
        seen = {pair: np.concatenate([where, others.seen[pair]]) for pair, where in self.seen.items()}
        own = [one.joints for one in (self, others) if one.joints is not None]
        joints = np.concatenate(own) if own else None
        return replace(others, A=np.concatenate([self.A, others.A]), seen=seen, joints=joints)


def present_pose(cell: Cell, options: PlanOptions) -> Array:
    """A where the robot stands: as stated, as last measured, or with the first target before the first sensor."""
    if options.present is not None:
        return one_transform(options.present, "PlanOptions.present")
    if len(cell.measured):
        return np.asarray(cell.measured[-1])
    for target, sensor in cell.pairs:
        if sensor in cell.kit.cameras:
            B = in_front(cell.kit.cameras[sensor], cell.kit.boards[target])
            return np.asarray(cell.Y[sensor] @ B @ se3.inverse(cell.X[target]))
    return np.eye(4)


def stated_pose(numbers: Sequence[float], where: str, *, is_inverse: bool) -> Array:
    """A pose of x, y, z (m) and a quaternion with x first, or its inverse; a PoseError for what is none."""
    pose = as_transforms(np.array([[*numbers[3:], *numbers[:3]]]), "xyzw", where)[0]
    return se3.inverse(pose) if is_inverse else pose


def moving_pose(A: Array, options: PlanOptions) -> Array:
    """The pose of the carrier that the robot moves in the other one's frame, of A (..., 4, 4)."""
    return se3.inverse(A) if options.moves == "sensors" else A


def drawn_candidates(cell: Cell, options: PlanOptions, covariance: Array, rng: np.random.Generator) -> Candidates:
    """Candidates about the present pose, as many as the options ask for, if there are as many.

    ``covariance`` (d, d) is that of the unknowns: what they leave open must not take a target out of an image.
    """
    present, pairs = present_pose(cell, options), cell.pairs
    found: list[Candidates] = []
    drawn = visible = within = reached = 0
    for _ in range(MOST_BATCHES if pairs else 0):
        if options.arm is not None and len(options.arm.names) < 6:  # other poses it cannot have
            low, high = options.arm.limits
            A = moving_pose(options.arm.hand(low + (high - low) * rng.random((BATCH, len(low))))[0], options)
        else:
            A = np.concatenate([_drawn(cell, options, pair, present, BATCH // len(pairs), rng) for pair in pairs])
        drawn += len(A)
        margins = seen_at(cell, options, A, covariance)
        seen = {pair: probability(margin) for pair, margin in margins.items()}
        keep = np.max([*margins.values()], axis=0) >= SURELY
        visible += int(keep.sum())
        keep &= is_within(options, A, present)
        within += int(keep.sum())
        joints = None
        at = np.flatnonzero(keep)
        if options.arm is not None and len(at):
            at = at[: options.candidates]
            can, joints = options.arm.reached(moving_pose(A[at], options))
            at, joints = at[can], joints[can]
        reached += len(at)
        found.append(Candidates(A[at], {pair: where[at] for pair, where in seen.items()}, joints, 0, 0, 0, 0))
        if reached >= options.candidates:
            break
    A = np.concatenate([np.zeros((0, 4, 4)), *(one.A for one in found)])
    seen = {pair: np.concatenate([one.seen[pair] for one in found]) for pair in pairs}
    tried = [one.joints for one in found if one.joints is not None]
    every = Candidates(A, seen, np.concatenate(tried) if tried else None, drawn, visible, within, reached)
    chosen = rng.permutation(len(A))[: options.candidates]
    return every.selected(chosen)


def _limits_m(cell: Cell, options: PlanOptions, pair: Pair, present: Array) -> tuple[float, float]:
    """The nearest and the farthest distance at which a target is drawn."""
    now = float(np.linalg.norm(predicted(cell, pair, present[None])[0, :3, 3]))
    if not cell.has_corners(pair):
        return cell.views[pair.sensor].distances
    camera, board = cell.kit.cameras[pair.sensor], cell.kit.boards[pair.target]
    nearest, farthest = nearest_m(camera, board), camera.focal_px * spacing_m(board) / options.spacing_px
    near, far = options.near_m or nearest, options.far_m or farthest
    if options.near_m is None and options.far_m is None and near < now < far:
        near, far = max(near, now / AROUND), min(far, now * AROUND)
    return near, max(near, far)


def spacing_m(board: Array) -> float:
    """The typical distance from a corner to its neighbour."""
    return float(np.median(np.asarray(cKDTree(board).query(board, k=2)[0])[:, 1]))


def _drawn(cell: Cell, options: PlanOptions, pair: Pair, present: Array, count: int, rng: np.random.Generator) -> Array:
    """A (n, 4, 4) at which a target is before a sensor: anywhere in its image, near and far, tilted and turned."""
    near, far = _limits_m(cell, options, pair, present)
    distance = near * (far / near) ** rng.random(count)
    if pair.sensor in cell.kit.cameras:
        camera = cell.kit.cameras[pair.sensor]
        share = rng.uniform(options.border, 1.0 - options.border, (count, 2))
        share[::2] = 0.5 + 0.3 * (share[::2] - 0.5)  # where frames are known roughly, only the middle is sure
        ray = np.column_stack([camera.undistort(share * [camera.width, camera.height]), np.ones(count)])
        ray = np.where(np.isfinite(ray), ray, [0.0, 0.0, 1.0])
    else:
        view = cell.views[pair.sensor]
        ray = view.axis + np.tan(view.angle) * rng.uniform(-1.0, 1.0, (count, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    # The board faces the camera along the ray, then is tilted about any axis across it, and turned about its normal.
    axis = np.cross([0.0, 0.0, 1.0], ray)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    turn = Rotation.from_rotvec(np.arctan2(sine, ray[:, 2:]) * axis / np.maximum(sine, 1e-12))
    tilt = np.radians(options.tilt_deg) * np.sqrt(rng.uniform(0.0, 1.0, count))
    about, roll = rng.uniform(-np.pi, np.pi, (2, count))
    tilted = Rotation.from_rotvec(tilt[:, None] * np.column_stack([np.cos(about), np.sin(about), np.zeros(count)]))
    rolled = Rotation.from_rotvec(roll[:, None] * [0.0, 0.0, 1.0])
    R = (turn * tilted).as_matrix() @ np.diag([1.0, -1.0, -1.0]) @ rolled.as_matrix()
    B = se3.pose(R, distance[:, None] * ray)
    return np.asarray(cell.Y[pair.sensor] @ B @ se3.inverse(cell.X[pair.target]))


def is_within(options: PlanOptions, A: Array, present: Array) -> np.ndarray:
    """Which poses (N,) are in the box, and not turned too far."""
    cosine = 0.5 * (np.einsum("nij,ij->n", A[:, :3, :3], present[:3, :3]) - 1.0)
    keep = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) <= options.turn_deg + 1e-9
    if options.box_m is not None:
        place = moving_pose(A, options)[:, :3, 3]
        keep &= ((place >= options.box_m[0]) & (place <= options.box_m[1])).all(axis=1)
    return np.asarray(keep)


def seen_at(cell: Cell, options: PlanOptions, A: Array, covariance: Array) -> dict[Pair, Array]:
    """By pair: how surely the sensor sees the whole target at poses A (N, 4, 4), in deviations of the frames.

    It is -1 where corners are not in the image, behind the camera or too near to each other, or the target is tilted
    too much, too near or too far; else a corner leaves the image if the frames are off by so many deviations.
    """
    seen = {}
    for pair in cell.pairs:
        B = predicted(cell, pair, A)
        distance = np.linalg.norm(B[:, :3, 3], axis=1)
        if not cell.has_corners(pair):
            view = cell.views[pair.sensor]
            near, far = view.distances
            cosine = B[:, :3, 3] @ view.axis / distance
            keep = (cosine >= np.cos(view.angle)) & (distance >= 0.99 * near) & (distance <= 1.01 * far)
            keep &= _tilts_deg(B) <= options.tilt_deg + 1e-6
            seen[pair] = np.where(keep, np.inf, -1.0)
            continue
        board, camera = cell.kit.boards[pair.target], cell.kit.cameras[pair.sensor]
        if np.abs(board[:, 2]).max() <= 1e-3 * np.abs(board).max():
            keep = _tilts_deg(B) <= options.tilt_deg + 1e-6
        else:
            keep = np.ones(len(A), dtype=bool)
        if options.near_m is not None:
            keep &= distance >= options.near_m
        if options.far_m is not None:
            keep &= distance <= options.far_m
        points = board / cell.scale[pair.target]
        at = np.flatnonzero(keep)
        pixels = camera.project(points @ B[at, :3, :3].transpose(0, 2, 1) + B[at, None, :3, 3])
        size = np.array([camera.width, camera.height])
        inside = (pixels >= options.border * size - 0.5) & (pixels <= (1.0 - options.border) * size - 0.5)
        neighbour = np.asarray(cKDTree(board).query(board, k=2)[1])[:, 1]
        apart = np.linalg.norm(pixels - pixels[:, neighbour], axis=2)
        with np.errstate(invalid="ignore"):
            at = at[inside.all(axis=(1, 2)) & (apart.min(axis=1) >= options.spacing_px)]
        seen[pair] = np.full(len(A), -1.0)
        if len(at):
            seen[pair][at] = _margins(cell, pair, A[at], covariance, size)
    return seen


def probability(margin: Array) -> Array:
    """How probably a target is seen, by the margin of its worst corner; 0 where the frames do not say so."""
    return np.where(margin >= SURELY, 1.0, np.where(margin >= 0.0, ndtr(margin), 0.0))


def _tilts_deg(B: Array) -> Array:
    """The angle between a target's normal and the line of sight, of poses T_sensor_target."""
    cosine = -np.einsum("ni,ni->n", B[:, :3, 2], B[:, :3, 3]) / np.linalg.norm(B[:, :3, 3], axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _margins(cell: Cell, pair: Pair, A: Array, covariance: Array, size: Array) -> Array:
    """By how many of the frames' deviations the outermost corners are inside the image, (N,)."""
    board = cell.kit.boards[pair.target]
    outer = np.unique([pick(board @ way) for way in _WAYS for pick in (np.argmin, np.argmax)])
    pixels, by_B, *_ = by_corners(cell, pair, A, board[outer])
    J = by_frames(cell, pair, predicted(cell, pair, A), by_B)
    variance = np.einsum("nij,nij->ni", J @ covariance, J)
    deviation = np.sqrt(np.maximum(variance, 1e-12)).reshape(pixels.shape)
    inside = np.minimum(pixels + 0.5, size - 0.5 - pixels)
    return np.asarray((inside / deviation).min(axis=(1, 2)))


_WAYS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]])


def tour(T: Array, present: Array) -> list[int]:
    """A short way from the present pose of what moves through poses T (N, 4, 4): nearest neighbour, then 2-opt."""
    every = np.concatenate([present[None], T])
    turn = 0.5 * (np.einsum("nij,mij->nm", every[:, :3, :3], every[:, :3, :3]) - 1.0)
    step = np.linalg.norm(every[:, None, :3, 3] - every[:, :3, 3], axis=2)
    step += METRES_A_RADIAN * np.arccos(np.clip(turn, -1.0, 1.0))
    way, left = [0], set(range(1, len(every)))
    while left:
        way.append(min(left, key=lambda i: (step[way[-1], i], i)))
        left.remove(way[-1])
    is_shorter = True
    while is_shorter:
        is_shorter = False
        for i in range(1, len(way) - 1):
            for j in range(i + 1, len(way)):
                end = 0.0 if j + 1 == len(way) else step[way[i], way[j + 1]] - step[way[j], way[j + 1]]
                if step[way[i - 1], way[j]] - step[way[i - 1], way[i]] + end < -1e-12:
                    way[i : j + 1] = way[i : j + 1][::-1]
                    is_shorter = True
    return [i - 1 for i in way[1:]]
