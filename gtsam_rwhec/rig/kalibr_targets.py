"""Kalibr's files of targets in place of a target's section: ``board: {kalibr: april.yaml}``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from gtsam_rwhec.errors import FileFormatError, RigError
from gtsam_rwhec.files.yaml_lines import YamlFile, read_yaml, shown

#: Kalibr detects this family on its AprilGrids.
FAMILY = "tag36h11"
#: Of each type: Kalibr's keys.
_KEYS = {
    "aprilgrid": ("tagCols", "tagRows", "tagSize", "tagSpacing"),
    "checkerboard": ("targetCols", "targetRows", "rowSpacingMeters", "colSpacingMeters"),
    "circlegrid": ("targetCols", "targetRows", "spacingMeters"),
}


def with_kalibr_targets(file: YamlFile, folder: Path) -> YamlFile:
    """The rig file with the sections that Kalibr's files stand for.

    Parameters
    ----------
    file : YamlFile
        A rig file as it was read.
    folder : Path
        The folder of the rig file, from which the paths start.

    Raises
    ------
    RigError
        A file cannot be read, or is no target that is detected; the message has the rig file's line and the file's.
    """
    data = file.data
    targets = data.get("targets") if isinstance(data, dict) else None
    if not isinstance(targets, dict):
        return file
    named = {name: each for name, each in targets.items() if isinstance(each, dict) and "kalibr" in each}
    if not named:
        return file
    sections = {}
    for name, each in named.items():
        place = file.place(("targets", name, "kalibr"))
        if set(each) != {"kalibr"} or not isinstance(each["kalibr"], str):
            raise RigError(f"{place}: give the path of Kalibr's file, and no other key: {{kalibr: april.yaml}}")
        try:
            sections[name] = _section(read_yaml(folder / each["kalibr"]))
        except FileFormatError as error:
            raise RigError(f"{place}: {error}") from error
    return replace(file, data={**data, "targets": {**targets, **sections}})


def _section(file: YamlFile) -> dict[str, Any]:
    """The section of a target for Kalibr's file."""
    given = file.data if isinstance(file.data, dict) else {}
    kind = given.get("target_type")
    if not isinstance(kind, str) or kind not in _KEYS:
        _refuse(file, "target_type", f"{shown(kind)}; Kalibr's targets are {', '.join(_KEYS)}")
    for key in _KEYS[kind]:
        value = given.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            _refuse(file, key, "is missing" if key not in given else f"{shown(value)}; a number was expected")
    columns, rows, length = (given[key] for key in _KEYS[kind][:3])
    if kind == "aprilgrid":
        spacing = float(given["tagSpacing"])
        return {
            "type": "aprilgrid", "family": FAMILY, "tags": (columns, rows), "tag_m": float(length), "spacing": spacing,
        }  # fmt: skip
    if kind == "checkerboard":
        if given["colSpacingMeters"] != length:
            _refuse(file, "colSpacingMeters", "squares that are no squares are not detected")
        return {"type": "checkerboard", "inner_corners": (columns, rows), "square_m": float(length)}
    shifted = given.get("asymmetricGrid", False)
    if not isinstance(shifted, bool):
        _refuse(file, "asymmetricGrid", f"{shown(shifted)}; give True or False")
    section = {"type": "circle_grid", "circles": (columns, rows), "spacing_m": float(length)}
    return {**section, "asymmetric": True} if shifted else section


def _refuse(file: YamlFile, key: str, words: str) -> NoReturn:
    raise FileFormatError(file.fault((key,), words))
