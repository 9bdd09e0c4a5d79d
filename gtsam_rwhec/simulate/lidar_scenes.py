"""A spinning LiDAR of few beams in a room with a board that a camera sees too: simulated clouds, and their truth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator
from rwhec_factors.se3 import expmap, inverse, pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.geometry.poses import Array

#: The axes of a camera that looks along a LiDAR's x: R_lidar_camera.
LOOKING = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
#: Half the sides of the room, metres, and the height of its middle over the LiDAR.
ROOM_M = (4.5, 4.0, 1.4)
ROOM_UP_M = 0.4
#: Surfaces in one footprint that are nearer to one another than this, metres, count as one.
ONE_SURFACE_M = 0.15
#: A pulse that hits two surfaces returns the one with at least this share of it, and else something between the two.
CLEAR_SHARE = 0.7


@dataclass(frozen=True)
class SimulatedLidar:
    """A LiDAR that spins about its z axis; the defaults are those of a sensor with 16 beams."""

    elevations_rad: Array = field(default_factory=lambda: np.radians(np.arange(-15.0, 16.0, 2.0)))  #: (beams,)
    step_rad: float = float(np.radians(0.2))  #: Between two pulses of a beam
    noise_m: float = 0.015  #: Standard deviation of a range
    bias_m: float = 0.0  #: Standard deviation of what a beam measures too far, always
    divergence_rad: float = 0.003  #: Full angle of a beam
    turn_s: float = 0.1  #: Time of one turn


@dataclass(frozen=True)
class LidarPlaces:
    """A board of ``size_m`` (width, height) in places before a camera and a LiDAR.

    ``clouds`` are the LiDAR's; ``T_camera_board`` (N, 4, 4) and ``covariances`` (N, 6, 6) are the camera's noisy poses.
    The truth: ``T_camera_lidar`` (4, 4) and ``T_lidar_board`` (N, 4, 4). Metres.
    """

    clouds: list[Cloud]
    size_m: tuple[float, float]
    T_camera_board: Array
    covariances: Array
    T_camera_lidar: Array
    T_lidar_board: Array


def lidar_cloud(
    lidar: SimulatedLidar,
    T_lidar_board: Array,
    size_m: tuple[float, float],
    rng: Generator,
    *,
    biases_m: Array | None = None,
    twist: Array | None = None,
    T_lidar_room: Array | None = None,
) -> Cloud:
    """One turn of the LiDAR in a room with a board on a stand.

    Parameters
    ----------
    lidar : SimulatedLidar
    T_lidar_board : (4, 4)
        The board's z looks at the LiDAR; metres.
    size_m : (width, height)
        Along the board's x and y.
    biases_m : (beams,), optional
        What each beam measures too far.
    twist : (6,), optional
        The LiDAR's motion in its own frame, rad/s and m/s; poses are those at the start of the turn.
    T_lidar_room : (4, 4), optional
        The room's middle, z up. Left out: the LiDAR stands in it upright.
    """
    azimuths = np.arange(-np.pi, np.pi, lidar.step_rad)
    beams, steps = np.meshgrid(np.arange(len(lidar.elevations_rad)), np.arange(len(azimuths)), indexing="ij")
    rings, times = beams.ravel(), (steps.ravel() / len(azimuths)) * lidar.turn_s
    polar = np.stack([azimuths[steps.ravel()], lidar.elevations_rad[rings]], axis=1)
    # 13 rays in the footprint: its middle, and two circles
    turns = np.arange(6) * np.pi / 3.0
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    spots = 0.5 * lidar.divergence_rad * np.concatenate([np.zeros((1, 2)), 0.5 * circle, 0.9 * circle])
    rays = polar[:, None] + spots
    flat = np.cos(rays[..., 1])
    directions = np.stack([flat * np.cos(rays[..., 0]), flat * np.sin(rays[..., 0]), np.sin(rays[..., 1])], axis=-1)
    moved = expmap(np.outer(times, np.zeros(6) if twist is None else twist))
    origins = moved[:, None, :3, 3]
    seen = directions @ moved[:, :3, :3].transpose(0, 2, 1)
    stand = T_lidar_board.copy()
    stand[:3, :3] = Rotation.from_euler("z", np.arctan2(T_lidar_board[1, 2], T_lidar_board[0, 2])).as_matrix() @ (
        np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    )
    stand[:3, 3] -= 0.12 * stand[:3, 2] + (0.0, 0.0, 0.75)
    ranges = np.minimum(_rectangle(origins, seen, T_lidar_board, size_m), _rectangle(origins, seen, stand, (0.04, 1.5)))
    ranges = np.minimum(ranges, _room(origins, seen, T_lidar_room))
    near = ranges.min(axis=1, keepdims=True)
    is_near = ranges < near + ONE_SURFACE_M
    share = is_near.mean(axis=1)
    far = np.where(is_near, 0.0, ranges).sum(axis=1) / np.maximum((~is_near).sum(axis=1), 1)
    close = np.where(is_near, ranges, 0.0).sum(axis=1) / is_near.sum(axis=1)
    measured = np.where(
        share >= CLEAR_SHARE, close, np.where(share <= 1.0 - CLEAR_SHARE, far, share * close + (1.0 - share) * far)
    )
    measured = measured + rng.normal(0.0, lidar.noise_m, len(measured))
    if biases_m is not None:
        measured += biases_m[rings]
    return Cloud.of(measured[:, None] * directions[:, 0], rings=rings, times_s=times)


def _rectangle(origins: Array, rays: Array, T: Array, size_m: tuple[float, float]) -> Array:
    """Ranges (N, rays) to a rectangle; infinite beside it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = ((T[:3, 3] - origins) @ T[:3, 2]) / (rays @ T[:3, 2])
        at = (origins + ranges[..., None] * rays - T[:3, 3]) @ T[:3, :2]
        hits = (np.abs(at) <= 0.5 * np.asarray(size_m)).all(axis=-1) & (ranges > 0.0)
    return np.where(hits, ranges, np.inf)


def _room(origins: Array, rays: Array, T_lidar_room: Array | None) -> Array:
    """Ranges (N, rays) to the walls from inside of the room."""
    T = pose(np.eye(3), np.array([0.0, 0.0, ROOM_UP_M])) if T_lidar_room is None else T_lidar_room
    inside, along = (origins - T[:3, 3]) @ T[:3, :3], rays @ T[:3, :3]
    with np.errstate(divide="ignore"):
        ranges: Array = ((np.sign(along) * ROOM_M - inside) / along).min(axis=-1)
    return ranges


def lidar_places(
    count: int,
    seed: int,
    *,
    lidar: SimulatedLidar | None = None,
    size_m: tuple[float, float] = (0.6, 0.85),
    corner_px: float = 0.2,
    focal_px: float = 1000.0,
) -> LidarPlaces:
    """A board in ``count`` places, 1.5 to 3 m away and turned by up to 40 degrees, before a camera and a LiDAR.

    The camera's poses have the errors of a checkerboard's 7 x 10 corners with ``corner_px`` of noise, under a focal
    length of ``focal_px``.
    """
    rng = np.random.default_rng(seed)
    lidar = lidar or SimulatedLidar()
    T_lidar_camera = (
        pose(LOOKING, np.array([0.07, 0.0, -0.15]))
        @ expmap(np.r_[rng.normal(0.0, 0.05, 3), rng.normal(0.0, 0.05, 3)][None])[0]
    )
    biases = rng.normal(0.0, lidar.bias_m, len(lidar.elevations_rad)) if lidar.bias_m else None
    grid = np.stack(np.meshgrid(np.linspace(-0.42, 0.42, 7), np.linspace(-0.42, 0.42, 10)), axis=-1).reshape(-1, 2)
    corners = np.concatenate([grid * size_m, np.zeros((len(grid), 1))], axis=1)
    boards, clouds, seen, covariances = [], [], [], []
    for _ in range(count):
        away, aside = rng.uniform(1.5, 3.0), rng.uniform(-0.35, 0.35)
        middle = away * np.array([np.cos(aside), np.sin(aside), np.sin(rng.uniform(-0.08, 0.08))])
        facing = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        facing = Rotation.from_euler("z", aside).as_matrix() @ facing
        tilt = rng.normal(size=2)
        tilt *= rng.uniform(0.0, np.radians(40.0)) / np.linalg.norm(tilt)
        spin = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
        T = pose(facing @ Rotation.from_rotvec([*tilt, 0.0]).as_matrix() @ spin, middle)
        boards.append(T)
        clouds.append(lidar_cloud(lidar, T, size_m, rng, biases_m=biases))
        truth = inverse(T_lidar_camera[None])[0] @ T
        at = corners @ truth[:3, :3].T + truth[:3, 3]
        by_point = (
            focal_px
            * np.stack(
                [
                    np.stack([1.0 / at[:, 2], 0.0 * at[:, 2], -at[:, 0] / at[:, 2] ** 2], axis=1),
                    np.stack([0.0 * at[:, 2], 1.0 / at[:, 2], -at[:, 1] / at[:, 2] ** 2], axis=1),
                ],
                axis=1,
            )
            @ truth[:3, :3]
        )
        J = np.concatenate([np.cross(corners[:, None], by_point), by_point], axis=2).reshape(-1, 6)
        covariance = corner_px**2 * np.linalg.inv(J.T @ J)
        seen.append(truth @ expmap(rng.multivariate_normal(np.zeros(6), covariance)[None])[0])
        covariances.append(covariance)
    return LidarPlaces(
        clouds, size_m, np.array(seen), np.array(covariances), inverse(T_lidar_camera[None])[0], np.array(boards)
    )
