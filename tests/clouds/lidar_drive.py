"""A vehicle with LiDARs among boxes on a flat ground: sweeps whose points have times, and the true poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

from gtsam_rwhec.clouds import Cloud
from gtsam_rwhec.simulate import Drive, SimulatedOdometry, drive

#: T_vehicle_sensor: one looks ahead, one back and down.
MOUNTS = {
    "front": se3.pose(np.eye(3), np.array([1.5, 0.0, 1.8])),
    "rear": se3.pose(Rotation.from_euler("zyx", [170, 5, -8], degrees=True).as_matrix(), np.array([-1.8, 0.3, 2.0])),
}
#: Of roll and pitch.
SWAYS_RAD_PER_S = np.array([0.9, 0.7])
BEAMS, STEPS, TURN_S, NOISE_M, REACH_M = 16, 240, 0.1, 0.015, 40.0


@dataclass(frozen=True)
class Boxes:
    """Centres (n, 2), half sides and heights (n, 3), and yaws (n,) of boxes that stand on the ground z = 0."""

    centres: np.ndarray
    sizes: np.ndarray
    yaws: np.ndarray


def yard(driven: Drive, seed: int) -> Boxes:
    """Boxes some metres apart, and none on the way."""
    rng = np.random.default_rng(seed)
    way = driven.T_world_vehicle[:, :2, 3]
    axes = [np.arange(low, high, 9.0) for low, high in zip(way.min(axis=0) - 40.0, way.max(axis=0) + 40.0, strict=True)]
    centres = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    centres = centres + rng.uniform(-3.0, 3.0, centres.shape)
    centres = centres[np.linalg.norm(centres[:, None] - way[None], axis=2).min(axis=1) > 4.5]
    sizes = np.column_stack([rng.uniform(0.3, 2.5, (len(centres), 2)), rng.uniform(1.5, 8.0, len(centres))])
    return Boxes(centres, sizes, rng.uniform(0.0, np.pi, len(centres)))


def sweep(
    boxes: Boxes,
    T: np.ndarray,
    twist: np.ndarray,
    rng: np.random.Generator,
    aside_rad: float = np.pi,
    bias_m: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of one turn that begins at T_world_sensor, and the seconds (n,) after its beginning.

    It sees up to an angle to both sides, and measures all ranges too far by a bias.
    """
    azimuths = np.linspace(-np.pi, np.pi, STEPS, endpoint=False)
    seen_at = np.flatnonzero(np.abs(azimuths) <= aside_rad)
    elevations, steps = np.meshgrid(np.radians(np.linspace(-15.0, 15.0, BEAMS)), seen_at, indexing="ij")
    up, steps = elevations.ravel(), steps.ravel()
    around, times = azimuths[steps], steps / STEPS * TURN_S
    rays = np.column_stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    poses = T @ se3.expmap(np.outer(times, twist))
    starts, seen = poses[:, :3, 3], np.einsum("nij,nj->ni", poses[:, :3, :3], rays)
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.where(seen[:, 2] < 0.0, -starts[:, 2] / seen[:, 2], np.inf)
        for centre, size, yaw in zip(boxes.centres, boxes.sizes, boxes.yaws, strict=True):
            if np.linalg.norm(centre - T[:2, 3]) > REACH_M:
                continue
            turn = Rotation.from_euler("z", -yaw).as_matrix()
            half = size * (1.0, 1.0, 0.5)
            inside, along = (starts - [*centre, half[2]]) @ turn.T, seen @ turn.T
            one, other = (-half - inside) / along, (half - inside) / along
            near, far = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
            ranges = np.where((near < far) & (near > 0.0) & (near < ranges), near, ranges)
    hit = ranges < REACH_M
    measured = ranges[hit] + bias_m + rng.normal(0.0, NOISE_M, int(hit.sum()))
    return measured[:, None] * rays[hit], times[hit]


def driven(seconds: float, seed: int, sway: float = 0.0) -> Drive:
    """A drive on the ground whose sensors are `MOUNTS`; with a sway, rad, it pitches and rolls so much, slowly."""
    made = drive({name: SimulatedOdometry(T) for name, T in MOUNTS.items()}, "planar", seconds=seconds, seed=seed)
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 2)
    turns = sway * np.sin(1e-9 * made.stamps_ns[:, None] * SWAYS_RAD_PER_S + phases)
    made.T_world_vehicle[:] = made.T_world_vehicle @ se3.expmap(np.pad(turns, ((0, 0), (0, 4))))
    return made


def sweeps(
    of: Drive, boxes: Boxes, sensor: str, seed: int, *, aside_rad: float = np.pi, bias_m: float = 0.0
) -> Iterator[Cloud]:
    """The sweeps of a sensor, one for each pose of the drive but the last."""
    rng = np.random.default_rng(seed)
    poses = of.T_world_vehicle @ MOUNTS[sensor]
    twists = se3.logmap(se3.inverse(poses[:-1]) @ poses[1:]) / TURN_S
    for T, twist, stamp in zip(poses, twists, of.stamps_ns.tolist(), strict=False):
        points, times = sweep(boxes, T, twist, rng, aside_rad, bias_m)
        yield Cloud.of(points, times_s=times, stamp_ns=stamp)
