"""LiDAR and camera: boards that both saw in some places become one calibration problem."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors import se3

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.lidar_boards import (
    BeamBiases,
    BeamMoments,
    LidarBoard,
    LidarBoardOptions,
    find_board,
    turned_like,
)
from gtsam_rwhec.errors import CloudError, CountError, NoiseError
from gtsam_rwhec.geometry.poses import Array, PoseLike, PosesLike, as_transforms, one_transform
from gtsam_rwhec.geometry.real_numbers import real_array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem

#: Two sensors' boards are compared on pairs of places; of more pairs than these, some are drawn.
MOST_PAIRS = 400
#: Errors of a normal and of a middle, which count as one: rad and m; and the most that one place counts.
ROUGH_RAD = float(np.radians(2.0))
ROUGH_M = 0.03
ROUGH_MOST = 9.0
#: Rounds of expectation and maximisation until the size of the beams' biases stays.
BIAS_ROUNDS = 50
#: A beam's bias is named where it is larger than this many of its standard deviations.
SURE = 4.0
#: The standard deviation, rad or m, of the one of a prior's two parts that is exact.
NEXT_TO_NOTHING = 1e-6
#: Points of one board that were measured over a longer time than this, seconds, blur where the board was moved by hand.
LONG_S = 0.02


@dataclass(frozen=True)
class SeenBoards:
    """One board in the clouds of N places.

    Attributes
    ----------
    T_sensor_board : (N, 4, 4)
        As in `LidarBoard`; nan where it was not found.
    covariances : (N, 6, 6)
        Of the right perturbation [omega, v]; nan where it was not found.
    used : (N,) booleans
        Where it was found.
    left_out : dict
        Why not, by place.
    boards : tuple of LidarBoard
        What was found, in the order of the places.
    biases : BeamBiases
        What each beam measures too far, as far as planes tell it: what is common to all beams moves the board, too.
    """

    T_sensor_board: Array
    covariances: Array
    used: np.ndarray
    left_out: Mapping[int, str]
    boards: tuple[LidarBoard, ...]
    biases: BeamBiases

    @property
    def common_m(self) -> float:
        """What all beams on a board measure too far together, by how far each does: the standard deviation, m."""
        beams = float(np.median([len(board.moments.rings) for board in self.boards]))
        squares = self.biases.bias_m**2 - np.diagonal(self.biases.covariance)
        return float(np.sqrt(max(squares.mean(), 0.0) / beams))

    @property
    def findings(self) -> tuple[str, ...]:
        """What a reader should know of these boards, in words."""
        said = []
        if self.left_out:
            which = "; ".join(f"place {place}: {why}" for place, why in self.left_out.items())
            said.append(f"{len(self.left_out)} of {len(self.used)} places have no board: {which}")
        deviations = np.sqrt(np.diagonal(self.biases.covariance))
        wrong = np.flatnonzero(np.abs(self.biases.bias_m) > SURE * deviations)
        if len(wrong):
            sizes = ", ".join(f"{self.biases.rings[k]}: {1e3 * self.biases.bias_m[k]:+.1f} mm" for k in wrong)
            said.append(f"beams that measure too far or too near, which is taken off: {sizes}")
        mixed = sum(board.mixed for board in self.boards)
        if mixed:
            said.append(f"{mixed} points at edges are between the board and what is behind it; they are left out")
        spans = [board.span_s for board in self.boards if board.span_s is not None]
        if spans and max(spans) > LONG_S:
            said.append(
                f"the points of one board were measured over up to {1e3 * max(spans):.0f} ms; stand still in each place"
            )
        return tuple(said)

    def __str__(self) -> str:
        noise = float(np.median([board.noise_m for board in self.boards]))
        head = f"the board in {int(self.used.sum())} of {len(self.used)} clouds, ranges to {1e3 * noise:.1f} mm"
        return "; ".join([head, *self.findings])


def seen_boards(
    clouds: Sequence[Cloud],
    size_m: tuple[float, float],
    *,
    near: PosesLike | None = None,
    within_m: float = 0.5,
    options: LidarBoardOptions | None = None,
) -> SeenBoards:
    """Find one board in the clouds of many places, and with all of them what each beam measures too far.

    Parameters
    ----------
    clouds : sequence of N Cloud
        Of one LiDAR, whose z is the axis about which it spins.
    size_m, within_m, options
        As in ``find_board``.
    near : N poses, optional
        T_sensor_board, roughly: where the camera saw it, by a first guess of the camera's pose.

    Raises
    ------
    CloudError
        No cloud has the board.
    CountError
        There are as many clouds as poses in ``near``.
    """
    options = options or LidarBoardOptions()
    clouds = list(Cloud.each(clouds))
    starts = [None] * len(clouds) if near is None else list(as_transforms(near, None, "near (T_sensor_board)"))
    if len(starts) != len(clouds):
        raise CountError(f"{len(clouds)} clouds and {len(starts)} poses in near; give one for each cloud")
    found: dict[int, LidarBoard] = {}
    left_out: dict[int, str] = {}
    for place, (cloud, start) in enumerate(zip(clouds, starts, strict=True)):
        try:
            found[place] = find_board(cloud, size_m, near=start, within_m=within_m, options=options)
        except CloudError as error:
            left_out[place] = str(error)
    if not found:
        raise CloudError(
            f"no cloud of {len(clouds)} has the board; the first says: {next(iter(left_out.values()), '')}"
        )
    biases = _biases([board.moments for board in found.values()], options.beam_bias_m)
    for place in list(found):
        near_it = found[place].T_sensor_board
        try:
            found[place] = find_board(clouds[place], size_m, near=near_it, within_m=0.1, options=options, biases=biases)
        except CloudError as error:
            left_out[place] = str(error)
            del found[place]
    used = np.isin(np.arange(len(clouds)), list(found))
    T, covariances = np.full((len(clouds), 4, 4), np.nan), np.full((len(clouds), 6, 6), np.nan)
    T[used] = [found[place].T_sensor_board for place in sorted(found)]
    covariances[used] = [found[place].covariance for place in sorted(found)]
    return SeenBoards(T, covariances, used, left_out, tuple(found[place] for place in sorted(found)), biases)


def _biases(moments: Sequence[BeamMoments], bias_m: float) -> BeamBiases:
    """The beams' biases from all planes, with the size that the data give them.

    ``bias_m`` is their standard deviation before the data, and counts as much as five beams do.
    """
    rings = np.unique(np.concatenate([each.rings for each in moments]))
    information, vector = np.zeros((len(rings), len(rings))), np.zeros(len(rings))
    for each in moments:
        at = np.searchsorted(rings, each.rings)
        information[np.ix_(at, at)] += each.information
        vector[at] += each.vector
    variance = bias_m**2
    for _ in range(BIAS_ROUNDS):
        covariance = np.linalg.inv(information + np.eye(len(rings)) / variance)
        mean = covariance @ vector
        variance = (mean @ mean + np.trace(covariance) + 5.0 * bias_m**2) / (len(rings) + 5.0)
    return BeamBiases(rings, mean, covariance)


def lidar_and_camera(
    T_camera_board: PosesLike,
    T_lidar_board: PosesLike,
    size_m: tuple[float, float],
    covariances: ArrayLike,
    *,
    camera_covariances: ArrayLike | None = None,
    T_board_target: PoseLike | None = None,
    placed_m: float = 0.0,
    placed_rad: float = 0.0,
    common_m: float = 0.0,
    target: str = "board",
    sensor: str = "lidar",
) -> Problem:
    """The problem whose unknown Y is T_camera_lidar, from one board in N places; ``calibrate`` does the rest.

    A is the camera's pose of the board, which is the carrier; X, the board's frame in it, is known. So an error of A is
    one of B, and the camera's covariances are added to the LiDAR's.

    Parameters
    ----------
    T_camera_board : N poses
        Of the camera's target on the board, by its corners (z towards the camera); metres.
    T_lidar_board : N poses
        Of the board, origin in its middle, x along its width, z towards the LiDAR: of ``seen_boards``. A place with nan
        is left out. Which of the rectangle's sides is the first is found here, over all places.
    size_m : (width, height)
        The board's sides, metres.
    covariances : (N, 6, 6)
        Of T_lidar_board.
    camera_covariances : (N, 6, 6), optional
        Of T_camera_board, such as those of detections. Left out: ``calibrate`` finds what they add.
    T_board_target : pose, optional
        The camera's target on the board. Left out: the target is in the board's middle, x along the width.
    placed_m, placed_rad : float
        Standard deviations of the target's place on the board: 0.01 m and 0.01 rad are usual. 0: it is exact. Otherwise
        the result has the board's pose too.
    common_m : float
        The standard deviation of what the LiDAR measures too far everywhere, ``SeenBoards.common_m``: it moves all
        boards alike along the line of sight, which no residual shows, and is in the sensor's covariance.
    target, sensor : str
        Names in the problem.

    Raises
    ------
    CountError
        The numbers of poses and covariances differ, or fewer than two places have both poses.
    PoseError, NoiseError, PriorError
        A pose, a covariance or a standard deviation is not valid.
    """
    A, B = as_transforms(T_camera_board, None, "T_camera_board"), as_transforms(T_lidar_board, None, "T_lidar_board")
    C = real_array(covariances)
    camera = np.zeros_like(C) if camera_covariances is None else real_array(camera_covariances)
    if C.shape[1:] != (6, 6) or camera.shape[1:] != (6, 6):
        raise NoiseError(f"covariances have shapes {C.shape} and {camera.shape}; give (N, 6, 6), rotation first")
    if not len(A) == len(B) == len(C) == len(camera):
        raise CountError(
            f"{len(A)} poses of the camera, {len(B)} of the LiDAR, {len(C)} covariances of the LiDAR and {len(camera)} "
            "of the camera; give one of each for a place"
        )
    X = np.eye(4) if T_board_target is None else one_transform(T_board_target, "T_board_target")
    A = A @ se3.inverse(X[None])
    to_board = se3.adjoint(X[None])[0]
    used = np.isfinite(A).all(axis=(1, 2)) & np.isfinite(B).all(axis=(1, 2))
    if used.sum() < 2:
        raise CountError(
            f"{used.sum()} of {len(A)} places have both poses of the board; at least 2 are needed, 10 are good"
        )
    A, B, C = A[used], B[used].copy(), C[used] + to_board @ camera[used] @ to_board.T
    Y = rough_alignment(A, B)
    expected = se3.inverse(Y[None]) @ A
    for k, like in enumerate(expected):
        B[k], C[k] = turned_like(B[k], C[k], like[:3, :3], size_m)
    problem = Problem(sensor_carrier="camera", target_carrier="board_in_camera")
    problem.add(target, sensor, A, B, covariances=C, directional=True)
    if placed_m == 0.0 and placed_rad == 0.0:
        problem.fix(target, np.eye(4))
    else:
        placed_rad, placed_m = max(placed_rad, NEXT_TO_NOTHING), max(placed_m, NEXT_TO_NOTHING)
        problem.add_prior(target, np.eye(4), placed_m, 0.5 / placed_rad**2)
    sight = (B[:, :3, 3] / np.linalg.norm(B[:, :3, 3], axis=1)[:, None]).mean(axis=0)
    if common_m > 0.0:
        problem.alike[Pair(target, sensor)] = common_m * np.r_[np.zeros(3), sight][:, None]
    return problem


def rough_alignment(A: Array, B: Array) -> Array:
    """T_a_b (4, 4) that takes most planes of B (N, 4, 4) to those of A, by their normals (z) and origins alone.

    Each pair of places tells it: two normals, and the way from one origin to the other. The one with the least sum of
    squares over all places counts, no place more than by a limit.
    """
    n_a, n_b, p_a, p_b = A[:, :3, 2], B[:, :3, 2], A[:, :3, 3], B[:, :3, 3]
    pairs = np.array(list(combinations(range(len(A)), 2)))
    if len(pairs) > MOST_PAIRS:
        pairs = pairs[np.random.default_rng(0).choice(len(pairs), MOST_PAIRS, replace=False)]
    best, least = np.eye(4), np.inf
    for i, j in pairs:
        way_a, way_b = p_a[j] - p_a[i], p_b[j] - p_b[i]
        M = np.outer(n_a[i], n_b[i]) + np.outer(n_a[j], n_b[j]) + np.outer(way_a, way_b) / max(way_a @ way_a, 1e-6)
        R = se3.so3_nearest(M[None])[0]
        t = 0.5 * (p_a[i] + p_a[j] - R @ (p_b[i] + p_b[j]))
        squares = ((n_b @ R.T - n_a) ** 2).sum(axis=1) / ROUGH_RAD**2
        squares += ((p_b @ R.T + t - p_a) ** 2).sum(axis=1) / ROUGH_M**2
        cost = float(np.minimum(squares, ROUGH_MOST).sum())
        if cost < least:
            best, least = se3.pose(R, t), cost
    return best
