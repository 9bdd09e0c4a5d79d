"""Variables out of gtsam.Values, with errors that name the key and the type that it should have."""

from __future__ import annotations

import gtsam

from rwhec_factors.se3 import Array


def pose_of(values: gtsam.Values, key: int, what: str) -> gtsam.Pose3:
    """The Pose3 of a key. Raises KeyError if the key is missing, and TypeError if it holds another type."""
    try:
        return values.atPose3(key)
    except RuntimeError as error:
        raise _explained(values, key, f"{what}, a gtsam.Pose3", error) from error


def number_of(values: gtsam.Values, key: int, what: str) -> float:
    """The number in a key's 1-vector. Raises KeyError if the key is missing, and TypeError if it has another type."""
    try:
        vector = values.atVector(key)
    except RuntimeError as error:
        raise _explained(values, key, f"{what}, a 1-vector (numpy.array([...]), not a float)", error) from error
    if vector.shape != (1,):
        raise TypeError(f"{name_of(key)} should be {what}, a 1-vector; it is a vector of {len(vector)}")
    return float(vector[0])


def vector_of(values: gtsam.Values, key: int, dimension: int, what: str) -> Array:
    """The vector of a key. Raises KeyError or TypeError like ``pose_of``, and TypeError for another length."""
    try:
        vector: Array = values.atVector(key)
    except RuntimeError as error:
        raise _explained(values, key, f"{what}, a {dimension}-vector", error) from error
    if vector.shape != (dimension,):
        raise TypeError(f"{name_of(key)} should be {what}, a {dimension}-vector; it is a vector of {len(vector)}")
    return vector


def name_of(key: int) -> str:
    """A key as GTSAM prints it: "x3"."""
    return str(gtsam.DefaultKeyFormatter(key))


def _explained(values: gtsam.Values, key: int, what: str, error: RuntimeError) -> KeyError | TypeError:
    if not values.exists(key):
        return KeyError(f"{name_of(key)} is not in the values; it should be {what}")
    return TypeError(f"{name_of(key)} should be {what}; it holds another type ({error})")
