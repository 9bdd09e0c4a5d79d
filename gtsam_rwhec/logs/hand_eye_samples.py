"""Samples of hand-eye tools: the robot's pose and the target's pose in the camera, measured together, without images.

========================== ===================================== ===================================================
tool                       robot                                 target
========================== ===================================== ===================================================
MoveIt (moveit_calibration) ``effector_wrt_world``: T_base_hand  ``object_wrt_sensor``: T_camera_target
easy_handeye, easy_handeye2 ``robot``, ``hand_world_samples``    ``tracking``, ``optical``, ``camera_marker_samples``
OpenCV (calibrateHandEye)  ``R_gripper2base``, ``t_gripper2base``  ``R_target2cam``, ``t_target2cam``
========================== ===================================== ===================================================

easy_handeye looks up ``robot`` as T_base_hand with the camera on the hand, and as T_hand_base with the camera fixed: so
it is always T_targetcarrier_sensorcarrier, whatever the setup is, which ROS 1's files do not say.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rwhec_factors import se3

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.whole_files import checked_path
from gtsam_rwhec.files.yaml_lines import KeyPath, YamlFile, shown
from gtsam_rwhec.logs.pose_tables import PoseRow, PoseStatement, pose_text, poses_of
from gtsam_rwhec.logs.pose_trees import TREES, PoseTree, pairs_of_keys, pose_tree
from gtsam_rwhec.logs.records import Array


@dataclass(frozen=True)
class _Layout:
    """The words of one tool: its name, keys of the robot's poses and the target's, and which pose the robot's is."""

    tool: str
    robot: str
    target: str
    is_of_carriers: bool = False


_LAYOUTS = (
    _Layout("MoveIt", "effector_wrt_world", "object_wrt_sensor"),
    _Layout("easy_handeye2", "robot", "tracking", is_of_carriers=True),
    _Layout("easy_handeye", "robot", "optical", is_of_carriers=True),
    _Layout("easy_handeye", "hand_world_samples", "camera_marker_samples", is_of_carriers=True),
    _Layout("OpenCV", "gripper2base", "target2cam"),
    _Layout("OpenCV", "base2gripper", "target2cam"),
)
#: easy_handeye2's words for its two setups.
_ON_HAND = {"eye_in_hand": True, "eye_on_hand": True, "eye_on_base": False, "eye_to_hand": False}


@dataclass(frozen=True, eq=False)
class HandEyeSamples:
    """The samples of one file."""

    path: Path
    tool: str  #: Who wrote the file
    robot: Array  #: (N, 4, 4): T_base_hand in metres, or, if `is_of_carriers`, T_targetcarrier_sensorcarrier
    B: Array  #: (N, 4, 4): T_camera_target, metres
    is_of_carriers: bool
    is_on_hand: bool | None  #: Whether the camera is on the hand; None if the file does not say it

    def T_base_hand(self, is_on_hand: bool) -> Array:
        """The robot's poses (N, 4, 4), for a camera on the hand or a fixed one."""
        return se3.inverse(self.robot) if self.is_of_carriers and not is_on_hand else self.robot

    def A(self, is_on_hand: bool) -> Array:
        """T_sensorcarrier_targetcarrier (N, 4, 4): the sensor's carrier is the hand or the base."""
        T = self.T_base_hand(is_on_hand)
        return se3.inverse(T) if is_on_hand else T

    def reading(self, is_on_hand: bool) -> str:
        """How the file was read, in words."""
        robot = "T_hand_base" if self.is_of_carriers and not is_on_hand else "T_base_hand"
        where = "the camera on the hand" if is_on_hand else "the camera fixed and the target on the hand"
        return (
            f"{self.path}: {len(self.B)} samples of {self.tool}; the robot's poses were read as {robot}, the target's "
            f"as T_camera_target, with {where}"
        )


def is_samples_file(path: object) -> bool:
    """Whether a path is a file that can have samples, by its ending."""
    return isinstance(path, str | Path) and Path(path).suffix.lower() in TREES and Path(path).is_file()


def read_hand_eye_samples(path: str | Path, stated: PoseStatement | None = None) -> HandEyeSamples:
    """Read samples of MoveIt, easy_handeye, easy_handeye2, or arrays for OpenCV's ``calibrateHandEye``.

    The file is YAML, JSON, or OpenCV's YAML, XML or JSON; `stated` says what it does not.

    Raises
    ------
    LogError
        The file cannot be read, has no samples, a sample lacks one of its two poses, or a pose is none; the message has
        the file and the line.
    """
    path, stated = checked_path(path), stated or PoseStatement()
    tree = PoseTree(pose_tree(str(path), pose_text(path)))
    for layout in _LAYOUTS:
        found = _of_layout(tree, layout)
        if found is not None:
            break
    else:
        known = "; ".join(f"{each.tool}: {each.robot} and {each.target}" for each in _LAYOUTS)
        raise LogError(f"{path} has no hand-eye samples. Samples have, with names of {known}")
    robot, targets = found
    if len(robot) != len(targets) or not robot:
        raise LogError(
            f"{path}: {len(robot)} poses of the robot ({layout.robot}) and {len(targets)} of the target "
            f"({layout.target}); a sample has one of each"
        )
    T = poses_of(robot, stated).T
    if layout.robot == "base2gripper":
        T = se3.inverse(T)
    B = poses_of(targets, stated).T
    return HandEyeSamples(path, layout.tool, T, B, layout.is_of_carriers, _is_on_hand(tree.file))


def _of_layout(tree: PoseTree, layout: _Layout) -> tuple[list[PoseRow], list[PoseRow]] | None:
    """The poses of the robot and of the target; None if the file is of another tool."""
    node: Any = tree.file.data
    path: KeyPath = ()
    while isinstance(node, dict) and "samples" in node:
        node, path = node["samples"], (*path, "samples")
    if isinstance(node, tuple) and any(isinstance(each, dict) and layout.robot in each for each in node):
        return _of_list(tree, layout, node, path)
    if not isinstance(node, dict):
        return None
    if layout.tool == "OpenCV":
        robot, targets = (_named(tree, node, path, word) for word in (layout.robot, layout.target))
        return (robot, targets) if robot and targets else None
    if layout.robot in node and layout.target in node:
        robot, targets = (_listed(tree, node[key], (*path, key)) for key in (layout.robot, layout.target))
        return robot, targets
    return None


def _of_list(
    tree: PoseTree, layout: _Layout, node: Sequence[Any], path: KeyPath
) -> tuple[list[PoseRow], list[PoseRow]] | None:
    """Samples one after the other, each with both poses."""
    if not any(isinstance(each, dict) and layout.target in each for each in node):
        return None
    keys = (layout.robot, layout.target)
    for i, each in enumerate(node):
        for key in keys:
            if not isinstance(each, dict) or key not in each:
                raise LogError(tree.file.fault((*path, i), f"no {key}; a sample of {layout.tool} has it"))
    robot, targets = ([_pose(tree, each[key], (*path, i, key)) for i, each in enumerate(node)] for key in keys)
    return robot, targets


def _listed(tree: PoseTree, node: Any, path: KeyPath) -> list[PoseRow]:
    """The poses of a list, which may be in a message."""
    if isinstance(node, dict) and isinstance(node.get("transforms"), tuple):
        node, path = node["transforms"], (*path, "transforms")
    if not isinstance(node, tuple):
        raise LogError(tree.file.fault(path, f"{shown(node)}; a list of poses was expected"))
    return [_pose(tree, each, (*path, i)) for i, each in enumerate(node)]


def _named(tree: PoseTree, node: dict[str, Any], path: KeyPath, word: str) -> list[PoseRow]:
    """The poses whose keys have a word: rotations and positions apart, or whole matrices."""
    mine = {key: value for key, value in node.items() if word in key.lower()}
    rows = [row for pair in pairs_of_keys(mine) for row in tree.apart(path, *pair)]
    if rows:
        return rows
    for key, value in mine.items():
        row = tree.pose(value, (*path, key))
        several = value if isinstance(value, tuple) and row is None else ()
        rows += [row] if row is not None else [_pose(tree, each, (*path, key, i)) for i, each in enumerate(several)]
    return rows


def _pose(tree: PoseTree, node: Any, path: KeyPath) -> PoseRow:
    """A pose, or the one transform of a stamped message."""
    while isinstance(node, dict) and isinstance(node.get("transform"), dict):
        node, path = node["transform"], (*path, "transform")
    row = tree.pose(node, path)
    if row is None:
        words = f"{shown(node)} is no pose: a 4 x 4 matrix (16 numbers, row by row), or translation and rotation"
        raise LogError(tree.file.fault(path, words))
    return row


def _is_on_hand(file: YamlFile) -> bool | None:
    """Whether the file says that the camera is on the hand."""
    parameters = file.data.get("parameters", file.data) if isinstance(file.data, dict) else {}
    if not isinstance(parameters, dict):
        return None
    flag = parameters.get("eye_on_hand")
    word = re.sub(r"[ -]", "_", str(parameters.get("calibration_type", "")).lower())
    return flag if isinstance(flag, bool) else _ON_HAND.get(word)
