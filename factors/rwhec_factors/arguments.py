"""Arguments and values, checked: an error names the argument or the key, its value, and what to give."""

from __future__ import annotations

from typing import Any, get_args

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors.se3 import Array, stacked


def pose_of(values: gtsam.Values, key: int, what: str) -> gtsam.Pose3:
    """The Pose3 of a key. Raises KeyError if the key is missing, and TypeError if it holds another type."""
    try:
        return values.atPose3(key)
    except RuntimeError as error:
        raise _explained(values, key, f"{what}, a gtsam.Pose3", error) from error


def number_of(values: gtsam.Values, key: int, what: str) -> float:
    """The number in a key's 1-vector; errors as of ``vector_of``."""
    return float(vector_of(values, key, 1, what)[0])


def vector_of(values: gtsam.Values, key: int, dimension: int, what: str) -> Array:
    """The vector of a key. Raises KeyError or TypeError like ``pose_of``, and TypeError for another length."""
    what = f"{what}, a {dimension}-vector"
    try:
        vector: Array = values.atVector(key)
    except RuntimeError as error:
        raise _explained(values, key, f"{what} (numpy.array([...]), not a float)", error) from error
    if vector.shape != (dimension,):
        raise TypeError(f"{name_of(key)} should be {what}; it is a vector of {len(vector)}")
    return vector


def name_of(key: int) -> str:
    """A key as GTSAM prints it: "x3"."""
    return str(gtsam.DefaultKeyFormatter(key))


def _explained(values: gtsam.Values, key: int, what: str, error: RuntimeError) -> KeyError | TypeError:
    if not values.exists(key):
        return KeyError(f"{name_of(key)} is not in the values; it should be {what}")
    return TypeError(f"{name_of(key)} should be {what}; it holds another type ({error})")


def check_pose(pose: object, what: str) -> None:
    """Refuse a value that is not a finite gtsam.Pose3."""
    if not isinstance(pose, gtsam.Pose3):
        raise TypeError(f"{what} is a {type(pose).__name__}; give a gtsam.Pose3")
    if not np.isfinite(pose.matrix()).all():
        raise ValueError(f"{what} has entries that are NaN or infinite; leave the measurement out:\n{pose.matrix()}")


def check_choice(name: str, value: object, choices: Any) -> None:
    """Refuse a value that is not in a Literal type."""
    if value not in get_args(choices):
        raise ValueError(f"{name}={value!r} is not one of {', '.join(map(repr, get_args(choices)))}")


def check_keys(keys: list[int]) -> None:
    """Refuse one key for two variables."""
    if len(set(keys)) != len(keys):
        raise ValueError(f"the keys {', '.join(map(name_of, keys))} are not all different; give each variable its own")


def checked_pairs(A: Any, B: Any) -> tuple[Array, Array]:
    """A and B as finite (N, 4, 4) arrays with one N of at least 1."""
    A, B = stacked(A), stacked(B)
    if A.ndim != 3 or A.shape[1:] != (4, 4) or A.shape != B.shape or len(A) == 0:
        raise ValueError(f"A has shape {A.shape} and B {B.shape}; both must be (N, 4, 4) with one N of at least 1")
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        raise ValueError("A or B has entries that are NaN or infinite; leave these measurements out")
    return A, B


def check_time_offset(time_offset_key: int | None, twists: ArrayLike | None) -> None:
    """Refuse a time offset without the carriers' velocity, and a velocity without a time offset."""
    if (time_offset_key is None) != (twists is None):
        raise ValueError("a time offset needs both its key (time_offset_key=) and the carriers' velocity (twist=)")


def checked_numbers(value: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    """Finite numbers of the given shape."""
    numbers = np.asarray(value, dtype=np.float64)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"{name} is {value!r}; give finite numbers of shape {shape}")
    return numbers


def checked_twists(twists: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Velocities of the carriers, finite and of the given shape."""
    return checked_numbers(twists, shape, "the twist [omega (rad/s), v (m/s)]")


def checked_effect(effect: ArrayLike, key: int, count: int) -> Array:
    """The residuals' changes (N, 6, m) by the m coefficients of a key, finite."""
    changes = np.asarray(effect, dtype=np.float64)
    if changes.ndim != 3 or changes.shape[:2] != (count, 6) or changes.shape[2] == 0:
        raise ValueError(
            f"the effect of {name_of(key)} has shape {changes.shape}; give ({count}, 6, m), one 6 x m matrix for each "
            "measurement"
        )
    if not np.isfinite(changes).all():
        raise ValueError(f"the effect of {name_of(key)} has entries that are NaN or infinite; give numbers")
    return changes


def unit_vector(value: ArrayLike, name: str) -> Array:
    """A direction (3,) as a vector of length 1."""
    vector = checked_numbers(value, (3,), name)
    length = np.linalg.norm(vector)
    if length == 0.0:
        raise ValueError(f"{name} is {vector}, which has no direction; give a vector that is not zero")
    unit: Array = vector / length
    return unit


def positive(value: float, name: str) -> float:
    """A finite number above zero."""
    if not (np.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} is {value}; give a positive number")
    return float(value)
