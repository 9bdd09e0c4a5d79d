"""OpenCV's hand-eye calls with its names, arguments, frames, shapes and constants. OpenCV 5's package lacks them.

Change one line: ``from gtsam_rwhec.methods import opencv as cv2``. OpenCV's methods give OpenCV's answers (from
the same motions between all pairs of poses) in a fraction of its time. Two methods are this library's: DQOpt over the
same pairs, and the certified solution, which needs no pairs.

OpenCV returns a meaningless pose for input that determines no answer; these calls raise an error. Such input has fewer
than three poses, motions about parallel axes or without rotation, or fewer than two motions in Tsai's range of angles.
They also raise an error for an unknown method. They take lists of lists too.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

from gtsam_rwhec.errors import CountError, OptionError, PoseError, UnderdeterminedError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import LARGEST_M, Array, checked_rows
from gtsam_rwhec.geometry.real_numbers import real_array
from gtsam_rwhec.methods.certified import certified_hand_eye, certified_robot_world
from gtsam_rwhec.methods.opencv_methods import (
    PARALLEL,
    Stations,
    andreff,
    daniilidis,
    dqopt,
    horaud,
    li,
    park,
    shah,
    stations_of,
    tsai,
)

#: Two motions about different axes need at least this many poses; OpenCV requires the same.
FEWEST_POSES = 3
#: Second row times third row, entries (1, 2), (2, 0), (0, 1), then (2, 1), (0, 2), (1, 0): their cross product.
_NEXT, _AFTER = [4, 5, 3, 5, 3, 4], [8, 6, 7, 7, 8, 6]
#: Shapes of a 3-vector.
_VECTORS = ((3,), (3, 1), (1, 3))


def checked_poses(R: Any, t: Any, names: tuple[str, str]) -> tuple[Array, Array]:
    """Rotations (N, 3, 3) and translations (N, 3) of the two arguments with these names.

    A rotation is (3, 3), or a rotation vector (3,), (3, 1) or (1, 3) in radians; a list may hold both. A translation is
    (3,), (3, 1) or (1, 3). Raises PoseError for other shapes, entries that are not finite and matrices that are not
    rotations, CountError for different numbers of rotations and translations.
    """
    rotations, translations = _rotations(R, names[0]), _translations(t, names[1])
    if len(rotations) != len(translations):
        raise CountError(
            f"{names[0]} has {len(rotations)} rotations and {names[1]} {len(translations)} translations; "
            "give one of each for every pose"
        )
    if not (are_rotations(rotations) and np.abs(translations).max() <= LARGEST_M):
        checked_rows(se3.pose(rotations, translations), 0, " and ".join(names))
    return rotations, translations


def are_rotations(R: Array) -> bool:
    """Whether all matrices (N, 3, 3) are rotations to about 4e-4; a quick test before ``checked_rows``.

    With |R|^2 = 3 and det R = 1 all singular values are 1: the mean of their squares equals their product's root.
    """
    rows = np.ascontiguousarray(R.reshape(-1, 9).T)
    squares = np.einsum("kn,kn->n", rows, rows)
    cross = rows[_NEXT] * rows[_AFTER]
    determinants = np.einsum("kn,kn->n", rows[:3], cross[:3] - cross[3:])
    worst = np.abs(np.concatenate([squares - 3.0, determinants - 1.0])).max()
    return bool(worst < 1e-7)


def check_counts(first: int, second: int, names: tuple[str, str]) -> None:
    """Raise CountError for unequal numbers of poses, or fewer than three poses."""
    if first != second:
        raise CountError(f"{names[0]} has {first} poses and {names[1]} {second}; give both for every station")
    if first < FEWEST_POSES:
        raise CountError(
            f"{first} poses in {names[0]}; at least {FEWEST_POSES} are needed (two motions about different axes)"
        )


def check_axes(R: tuple[Array, Array], where: tuple[str, str]) -> None:
    """Raise UnderdeterminedError for motions R_j' R_i that determine no method's answer.

    Over all ordered pairs, the sum of I - R_j' R_i is N^2 I - (sum R)'(sum R). No motion turns a vector of its null
    space. The matrix is zero when nothing rotates, and has rank two when all motions rotate about one axis.
    """
    for rotations, name in zip(R, where, strict=True):
        count = len(rotations)
        least, most = least_and_most_turning(np.einsum("nij->ij", rotations), count)
        if most <= PARALLEL * count**2:
            raise UnderdeterminedError(
                f"{name}: no motion rotates, so the rotation and the translation are not determined; add poses that "
                "turn about two different axes"
            )
        if least <= PARALLEL * most:
            raise UnderdeterminedError(
                f"{name}: all motions rotate about one axis, which leaves the translation along it free; add poses "
                "that turn about another axis"
            )


def least_and_most_turning(total: Array, count: int) -> tuple[float, float]:
    """The determinant of N^2 I - S'S over the sum of its 2 x 2 minors, and its trace.

    A small quotient is the smallest eigenvalue. Motions about one axis turn two directions alike, so two eigenvalues
    are never small if the third is large. The sums use plain numbers: a call of NumPy takes longer than the sums.
    """
    (a, b, c), (d, e, f), (g, h, i) = (total.T @ total).tolist()
    square = float(count) ** 2
    a, e, i = square - a, square - e, square - i
    b, c, d, f, g, h = -b, -c, -d, -f, -g, -h
    first, second, third = e * i - f * h, f * g - d * i, d * h - e * g
    minors = first + (a * i - c * g) + (a * e - b * d)
    determinant = a * first + b * second + c * third
    return (determinant / minors if minors > 0.0 else 0.0), a + e + i


def _rotations(values: Any, where: str) -> Array:
    array = _numbers(values, where)
    if array is None:  # matrices and vectors in one list
        return np.concatenate([_rotations([value], f"{where}[{index}]") for index, value in enumerate(values)])
    if array.shape[1:] in _VECTORS:
        return Rotation.from_rotvec(array.reshape(-1, 3)).as_matrix()
    if array.shape[1:] != (3, 3):
        raise PoseError(
            f"{where}: shape {array.shape} is not a list of rotations; give matrices (3, 3) or rotation vectors (3,), "
            "(3, 1), (1, 3), one for every pose"
        )
    return array


def _translations(values: Any, where: str) -> Array:
    array = _numbers(values, where)
    if array is None:
        return np.concatenate([_translations([value], f"{where}[{index}]") for index, value in enumerate(values)])
    if array.shape[1:] not in _VECTORS:
        raise PoseError(
            f"{where}: shape {array.shape} is not a list of translations; give (3,), (3, 1) or (1, 3) for every pose"
        )
    return array.reshape(-1, 3)


def _numbers(values: Any, where: str) -> Array | None:
    """An array of doubles; None where the entries of a list do not fit into one."""
    try:
        array = real_array(values)
    except ValueError as error:
        if isinstance(values, (list, tuple)) and len(values) > 1:
            return None
        raise PoseError(f"{where}: cannot be read as numbers ({error}); give arrays of numbers") from error
    if array.size == 0:
        raise CountError(f"{where}: no poses; at least {FEWEST_POSES} are needed")
    return array


CALIB_HAND_EYE_TSAI = 0
CALIB_HAND_EYE_PARK = 1
CALIB_HAND_EYE_HORAUD = 2
CALIB_HAND_EYE_ANDREFF = 3
CALIB_HAND_EYE_DANIILIDIS = 4
#: Not OpenCV's: the least squares optimum of Dekel et al. (CVPR 2020), over the same pairs.
CALIB_HAND_EYE_DQOPT = 100
#: Not OpenCV's: the library's certified solution, from the poses themselves.
CALIB_HAND_EYE_CERTIFIED = 101

CALIB_ROBOT_WORLD_HAND_EYE_SHAH = 0
CALIB_ROBOT_WORLD_HAND_EYE_LI = 1
#: Not OpenCV's: the library's certified solution.
CALIB_ROBOT_WORLD_HAND_EYE_CERTIFIED = 101

_HAND_EYE: dict[int, Callable[[Stations], tuple[Array, Array]]] = {
    CALIB_HAND_EYE_TSAI: tsai,
    CALIB_HAND_EYE_PARK: park,
    CALIB_HAND_EYE_HORAUD: horaud,
    CALIB_HAND_EYE_ANDREFF: andreff,
    CALIB_HAND_EYE_DANIILIDIS: daniilidis,
    CALIB_HAND_EYE_DQOPT: dqopt,
    CALIB_HAND_EYE_CERTIFIED: certified_hand_eye,
}
_ROBOT_WORLD: dict[int, Callable[[Array, Array, Array, Array], tuple[Array, Array, Array, Array]]] = {
    CALIB_ROBOT_WORLD_HAND_EYE_SHAH: shah,
    CALIB_ROBOT_WORLD_HAND_EYE_LI: li,
    CALIB_ROBOT_WORLD_HAND_EYE_CERTIFIED: certified_robot_world,
}


@one_blas_thread()
def calibrateHandEye(
    R_gripper2base: Any,
    t_gripper2base: Any,
    R_target2cam: Any,
    t_target2cam: Any,
    R_cam2gripper: Array | None = None,
    t_cam2gripper: Array | None = None,
    method: int = CALIB_HAND_EYE_TSAI,
) -> tuple[Array, Array]:
    """Pose of a camera on a gripper, from poses of the gripper and of a fixed target in the camera.

    x2y is OpenCV's name of T_y_x, which takes points of frame x to frame y. For a fixed camera that sees a target on
    the gripper (eye-to-hand), give base2gripper in place of gripper2base; the answer is the camera's pose in the base.

    Parameters
    ----------
    R_gripper2base, R_target2cam : sequence or array of N rotations
        Matrices (3, 3), or rotation vectors (3,), (3, 1), (1, 3) in radians.
    t_gripper2base, t_target2cam : sequence or array of N translations
        (3,), (3, 1) or (1, 3); the answer has the same unit.
    R_cam2gripper, t_cam2gripper : (3, 3) and (3, 1) float64 arrays, optional
        Filled and returned when they have these shapes, as in OpenCV.
    method : int
        One of CALIB_HAND_EYE_TSAI, _PARK, _HORAUD, _ANDREFF, _DANIILIDIS, _DQOPT, _CERTIFIED.

    Returns
    -------
    R_cam2gripper (3, 3), t_cam2gripper (3, 1)

    Raises
    ------
    PoseError
        Other shapes, entries that are not finite, a matrix that is not a rotation.
    CountError
        Fewer than three poses, or different numbers.
    UnderdeterminedError
        Motions about one axis only, or without rotation; Tsai with fewer than two motions of 17 to 116 degrees,
        or with such motions about one axis only; Andreff without translations.
    OptionError
        An unknown method.
    """
    solve = _HAND_EYE.get(method) if isinstance(method, Hashable) else None
    if solve is None:
        raise OptionError(_unknown(method, "CALIB_HAND_EYE"))
    R_G, t_G = checked_poses(R_gripper2base, t_gripper2base, ("R_gripper2base", "t_gripper2base"))
    R_C, t_C = checked_poses(R_target2cam, t_target2cam, ("R_target2cam", "t_target2cam"))
    check_counts(len(R_G), len(R_C), ("R_gripper2base", "R_target2cam"))
    check_axes((R_G, R_C.transpose(0, 2, 1)), ("R_gripper2base", "R_target2cam"))
    R, t = solve(stations_of(R_G, t_G, R_C, t_C))
    return _into(R_cam2gripper, R), _into(t_cam2gripper, t[:, None])


@one_blas_thread()
def calibrateRobotWorldHandEye(
    R_world2cam: Any,
    t_world2cam: Any,
    R_base2gripper: Any,
    t_base2gripper: Any,
    R_base2world: Array | None = None,
    t_base2world: Array | None = None,
    R_gripper2cam: Array | None = None,
    t_gripper2cam: Array | None = None,
    method: int = CALIB_ROBOT_WORLD_HAND_EYE_SHAH,
) -> tuple[Array, Array, Array, Array]:
    """Poses of a robot's base in the world (a fixed target) and of its gripper in the camera on it.

    Parameters
    ----------
    R_world2cam, R_base2gripper : sequence or array of N rotations
        Matrices (3, 3), or rotation vectors (3,), (3, 1), (1, 3) in radians.
    t_world2cam, t_base2gripper : sequence or array of N translations
        (3,), (3, 1) or (1, 3); the answer has the same unit.
    R_base2world, t_base2world, R_gripper2cam, t_gripper2cam : float64 arrays, optional
        (3, 3), (3, 1), (3, 3), (3, 1): filled and returned when they have these shapes, as in OpenCV.
    method : int
        One of CALIB_ROBOT_WORLD_HAND_EYE_SHAH, _LI, _CERTIFIED.

    Returns
    -------
    R_base2world (3, 3), t_base2world (3, 1), R_gripper2cam (3, 3), t_gripper2cam (3, 1)

    Raises
    ------
    PoseError, CountError, UnderdeterminedError, OptionError
        As ``calibrateHandEye``; Li's method without translations of the gripper.
    """
    solve = _ROBOT_WORLD.get(method) if isinstance(method, Hashable) else None
    if solve is None:
        raise OptionError(_unknown(method, "CALIB_ROBOT_WORLD_HAND_EYE"))
    R_A, t_A = checked_poses(R_world2cam, t_world2cam, ("R_world2cam", "t_world2cam"))
    R_B, t_B = checked_poses(R_base2gripper, t_base2gripper, ("R_base2gripper", "t_base2gripper"))
    check_counts(len(R_A), len(R_B), ("R_world2cam", "R_base2gripper"))
    check_axes((R_A.transpose(0, 2, 1), R_B.transpose(0, 2, 1)), ("R_world2cam", "R_base2gripper"))
    R_X, t_X, R_Z, t_Z = solve(R_A, t_A, R_B, t_B)
    return (
        _into(R_base2world, R_X),
        _into(t_base2world, t_X[:, None]),
        _into(R_gripper2cam, R_Z),
        _into(t_gripper2cam, t_Z[:, None]),
    )


def _into(given: Array | None, answer: Array) -> Array:
    """The caller's array, filled, if it can hold the answer; else the answer."""
    if isinstance(given, np.ndarray) and given.shape == answer.shape and given.dtype == np.float64:
        given[...] = answer
        return given
    return answer


def _unknown(method: object, prefix: str) -> str:
    names = {name: value for name, value in globals().items() if name.startswith(f"{prefix}_")}
    listed = ", ".join(f"{name} = {value}" for name, value in names.items())
    return f"method={brief(method)} is not one of {listed}"
