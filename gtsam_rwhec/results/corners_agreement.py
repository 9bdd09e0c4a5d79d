"""Cameras and boards of a refinement from corners in a result file: all of them whole, and as the rest of it says.

Every function raises `ValueError` with the JSON path, what was found, and what the file says elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.fitting.corners_as_refined import SHAPE_NAMES
from gtsam_rwhec.fitting.reprojection_record import SIZE, BoardShape, Intrinsics, Regions, Reprojection, lens_of
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.covariance_agreement import TWICE
from gtsam_rwhec.results.schema import RefinedFields

#: Focal lengths and principal point: the parameters of a camera without distortion.
LEAST = 4
#: Fields of an `Intrinsics` with a number for each of its names.
_BY_NAME = ("values", "standard_deviations", "stated", "stated_deviations")


def check_corners(refined: RefinedFields) -> None:
    """Cameras, boards and errors in pixels belong to frames of the file, and their deviations are the covariance's."""
    found = refined.reprojection
    if found is None:
        if refined.intrinsics:
            raise ValueError(
                f"$.refined.intrinsics: has {_names(refined.intrinsics)}, but $.refined.reprojection is null; "
                "intrinsics are estimated from corners alone"
            )
        return
    place = "$.refined.reprojection"
    _check_are_there(found.sensors, refined.Y, f"{place}.sensors", "sensors")
    _check_are_there(found.boards, refined.X, f"{place}.boards", "targets")
    _check_are_there(refined.intrinsics, refined.Y, "$.refined.intrinsics", "sensors")
    _check_reprojection(found, refined, place)
    for name, intrinsics in refined.intrinsics.items():
        _check_intrinsics(name, intrinsics, refined, f"$.refined.intrinsics.{shown(name)}")
    for name, board in found.boards.items():
        _check_board(name, board, refined, f"{place}.boards.{shown(name)}")


def _check_reprojection(found: Reprojection, refined: RefinedFields, place: str) -> None:
    _check_not_negative(found, place)
    if found.carrier_poses == "exact" and (found.carrier_rotation_rad or found.carrier_translation_m):
        raise ValueError(
            f"{place}.carrier_poses: 'exact', but the noise of A is {found.carrier_rotation_rad} rad and "
            f"{found.carrier_translation_m} m"
        )
    for name, sensor in found.sensors.items():
        _check_not_negative(sensor, f"{place}.sensors.{shown(name)}")
        _check_regions(sensor.regions_px, f"{place}.sensors.{shown(name)}.regions_px")
    counted = [sensor.rms_px for sensor in found.sensors.values() if sensor.corners]
    if counted and not min(counted) * (1.0 - TWICE) <= found.rms_px <= max(counted) * (1.0 + TWICE):
        raise ValueError(
            f"{place}.rms_px: must be between the sensors' {min(counted)} and {max(counted)} (found {found.rms_px})"
        )
    for index, tried in enumerate(found.tried):
        _check_not_negative(tried, f"{place}.tried[{index}]")
    chosen = sum(tried.is_chosen for tried in found.tried)
    if found.tried and chosen != 1:
        raise ValueError(f"{place}.tried: one model is chosen, and here are {chosen}")
    for index, consequence in enumerate(found.consequences):
        _check_not_negative(consequence, f"{place}.consequences[{index}]")
        _check_are_there(
            [consequence.frame], refined.X.keys() | refined.Y.keys(), f"{place}.consequences[{index}].frame", "frames"
        )


def _check_intrinsics(name: str, intrinsics: Intrinsics, refined: RefinedFields, place: str) -> None:
    width = len(intrinsics.names)
    if width < LEAST:
        raise ValueError(f"{place}.names: a camera has at least {LEAST} parameters (found {width})")
    for what in _BY_NAME:
        if len(getattr(intrinsics, what)) != width:
            raise ValueError(f"{place}.{what}: {len(getattr(intrinsics, what))} numbers for {width} names")
    for what in ("camera", "stated_camera"):
        try:
            getattr(intrinsics, what)
        except CameraError as error:
            values = "stated" if what == "stated_camera" else "values"
            raise ValueError(f"{place}.{values}: no camera has them: {error}") from error
    wanted = replace(lens_of(intrinsics), D=np.zeros(width - LEAST)).parameter_names
    if intrinsics.names != wanted:
        raise ValueError(
            f"{place}.names: must be {', '.join(wanted)} (found {', '.join(map(shown, intrinsics.names))})"
        )
    _check_not_negative(intrinsics, place)
    for what in ("standard_deviations", "stated_deviations"):
        if min(getattr(intrinsics, what)) < 0.0:
            raise ValueError(f"{place}.{what}: must not be negative (found {list(getattr(intrinsics, what))})")
    if intrinsics.widened < 1.0:
        raise ValueError(f"{place}.widened: must be at least 1 (found {intrinsics.widened})")
    _check_are_there(intrinsics.held_by_prior, intrinsics.names, f"{place}.held_by_prior", "parameters")
    for other in intrinsics.shared_with:
        of_other = refined.intrinsics.get(other)
        if (
            other == name
            or of_other is None
            or (of_other.model, of_other.values) != (intrinsics.model, intrinsics.values)
        ):
            raise ValueError(f"{place}.shared_with: {shown(other)} has not the same camera in $.refined.intrinsics")
    _check_regions(intrinsics.projection_px, f"{place}.projection_px")
    of_sensor = None if refined.reprojection is None else refined.reprojection.sensors.get(name)
    if of_sensor is not None and not math.isclose(of_sensor.rms_px, intrinsics.rms_px, rel_tol=TWICE):
        raise ValueError(
            f"{place}.rms_px: must be {of_sensor.rms_px}, as in $.refined.reprojection.sensors (found "
            f"{intrinsics.rms_px})"
        )
    expected = _deviations(refined, Unknown(UnknownKind.INTRINSICS, name))
    if expected is None:
        expected = np.zeros(width)
    _check_deviations(intrinsics.standard_deviations, expected, place)


def _check_board(name: str, board: BoardShape, refined: RefinedFields, place: str) -> None:
    _check_are_there(board.names, SHAPE_NAMES, f"{place}.names", "numbers of a board")
    if not len(board.names) == len(set(board.names)) == len(board.values) == len(board.standard_deviations):
        raise ValueError(f"{place}: names, values and standard_deviations must have one entry each for every number")
    if min(board.standard_deviations, default=0.0) < 0.0:
        raise ValueError(f"{place}.standard_deviations: must not be negative")
    off, of_off = board.corners_off_m, board.corners_deviations_m
    if len(off) != len(of_off) or any(len(each) != 3 for each in (*off, *of_off)):
        raise ValueError(f"{place}: corners_off_m and corners_deviations_m must have x, y, z of every corner")
    if any(deviation < 0.0 for each in of_off for deviation in each):
        raise ValueError(f"{place}.corners_deviations_m: must not be negative")
    shape = _deviations(refined, Unknown(UnknownKind.SHAPE, name))
    expected = iter(np.zeros(len(board.names)) if shape is None else shape)
    by_joint = []
    for number, value in zip(board.names, board.values, strict=True):
        if number != SIZE:
            by_joint.append(float(next(expected)))
            continue
        # scale = 1 / (1 + size), so that sigma_size = (1 + size)^2 sigma_scale
        scale = refined.scale[name] if isinstance(refined.scale, dict) and name in refined.scale else refined.scale
        if not (isinstance(scale, float) and math.isclose(scale * (1.0 + value), 1.0, rel_tol=TWICE)):
            raise ValueError(f"{place}.values: a size of {value} is not that of the scale, {scale}")
        of_scale = _deviations(refined, Unknown(UnknownKind.SCALE, name))
        by_joint.append(0.0 if of_scale is None else float(of_scale[0]) * (1.0 + value) ** 2)
    _check_deviations(board.standard_deviations, np.array(by_joint), place)


def _deviations(refined: RefinedFields, unknown: Unknown) -> Array | None:
    """Standard deviations of an unknown by the joint covariance; None if it has no rows."""
    rows = refined.joint.slots.get(unknown)
    return None if rows is None else np.sqrt(np.maximum(np.diagonal(refined.joint.finite)[rows], 0.0))


def _check_deviations(given: tuple[float, ...], expected: Array, place: str) -> None:
    if not np.allclose(given, expected, rtol=TWICE, atol=0.0):
        raise ValueError(
            f"{place}.standard_deviations: must be {expected.tolist()}, by $.refined.joint (found {list(given)})"
        )


def _check_regions(regions: Regions, place: str) -> None:
    """Rows of one length, without negative numbers; None stands where no corner was seen."""
    if len({len(row) for row in regions}) > 1:
        raise ValueError(f"{place}: rows of different lengths")
    for value in (value for row in regions for value in row if value is not None):
        if not value >= 0.0:
            raise ValueError(f"{place}: must not be negative (found {value})")


def _check_not_negative(record: Any, place: str) -> None:
    """No number that a record holds directly is below zero: they are counts, sizes and deviations."""
    for each in fields(record):
        value = getattr(record, each.name)
        if isinstance(value, int | float) and not value >= 0:
            raise ValueError(f"{place}.{each.name}: must not be negative (found {value})")


def _check_are_there(names: Iterable[str], there: Collection[str], place: str, what: str) -> None:
    strangers = [name for name in names if name not in there]
    if strangers:
        raise ValueError(f"{place}: has {_names(strangers)}, but the {what} are {_names(there)}")


def _names(names: Iterable[str]) -> str:
    return ", ".join(map(shown, names)) or "none"
