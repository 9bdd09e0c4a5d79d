"""Checked numbers of files of intrinsics: lists, matrices, sizes in pixels; every fault has its line."""

from __future__ import annotations

import math
from typing import Any, NoReturn

import numpy as np

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.yaml_lines import KeyPath, YamlFile, shown
from gtsam_rwhec.geometry.poses import Array


def matrix_of(file: YamlFile, key: str, count: int | None) -> Array:
    """The numbers of a matrix, given as {rows, cols, data}, as a list, or as a list of rows."""
    value, path = file.data[key], (key,)
    if not isinstance(value, dict):
        if isinstance(value, tuple) and value and all(isinstance(row, tuple) for row in value):
            value = tuple(number for row in value for number in row)
        return numbers_of(file, path, value, count)
    if "sizes" in value and "rows" not in value:  # OpenCV 5: a vector, or a matrix of more than two dimensions
        return numbers_of(file, (*path, "data"), value.get("data"), count)
    for part in ("rows", "cols", "data"):
        if part not in value:
            refuse(file, (*path, part), "is missing; a matrix has rows, cols and data")
    numbers = numbers_of(file, (*path, "data"), value["data"], count)
    rows, cols = value["rows"], value["cols"]
    if not isinstance(rows, int) or not isinstance(cols, int) or rows * cols != len(numbers):
        refuse(file, (*path, "data"), f"{len(numbers)} numbers for {shown(rows)} rows and {shown(cols)} columns")
    return numbers


def numbers_of(file: YamlFile, path: KeyPath, value: Any, count: int | None) -> Array:
    """A list of finite numbers, as many as stated."""
    if value is None:
        refuse(file, path, "is missing" if path not in file.lines else "is empty")
    if not isinstance(value, tuple) or (count is not None and len(value) != count):
        many = f"a list of {count} numbers" if count is not None else "a list of numbers"
        refuse(file, path, f"{shown(value)}; {many} was expected")
    for i, number in enumerate(value):
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not math.isfinite(number):
            refuse(file, (*path, i), f"{shown(number)}; a finite number was expected")
    return np.array(value, dtype=float)


def pixels_of(file: YamlFile, path: KeyPath, value: Any) -> int:
    """A whole number of pixels."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value % 1:
        refuse(file, path, f"{shown(value)}; a whole number of pixels was expected")
    return int(value)


def refuse(file: YamlFile, path: KeyPath, words: str) -> NoReturn:
    """Raise FileFormatError with the file, the line and the key."""
    raise FileFormatError(file.fault(path, words) + ".")
