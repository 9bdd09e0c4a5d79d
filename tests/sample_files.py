"""Samples of one rig as hand-eye tools write them, made of its poses, for the tests of their readers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

Array = np.ndarray


def pose(rotation: Array, position: Array) -> Array:
    return se3.pose(Rotation.from_rotvec(rotation).as_matrix(), position)


def rig_poses(on_hand: bool, count: int = 14, seed: int = 5) -> tuple[Array, Array, Array, Array]:
    """T_base_hand (N, 4, 4) and T_camera_target (N, 4, 4) with a little noise; the true X and Y of A X = Y B."""
    rng = np.random.default_rng(seed)
    hands = np.array([pose(rng.normal(0, 0.6, 3), rng.uniform([0.1, -0.4, 0], [0.9, 0.4, 0.8])) for _ in range(count)])
    Y = pose(np.array([0.1, -0.2, 1.5]), np.array([0.05, 0.02, 0.08]) if on_hand else np.array([1.2, 0.1, 0.9]))
    X = pose(np.array([0.3, 0.1, -0.4]), np.array([0.9, -0.1, 0.02]) if on_hand else np.array([0.01, 0.03, 0.1]))
    A = np.linalg.inv(hands) if on_hand else hands
    noise = np.array([pose(rng.normal(0, 1e-3, 3), rng.normal(0, 1e-3, 3)) for _ in range(count)])
    return hands, np.linalg.inv(Y) @ A @ X @ noise, X, Y


def message(T: Array) -> dict[str, Any]:
    q = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return {
        "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "rotation": dict(zip("xyzw", q, strict=True)),
    }


def block(node: Any, depth: int = 0) -> str:
    """YAML as emitters write it, with blocks."""
    pad = "  " * depth
    if isinstance(node, dict):
        lines = []
        for key, value in node.items():
            nested = isinstance(value, dict) or (isinstance(value, list) and value and not _is_flat(value))
            lines.append(f"{pad}{key}:\n{block(value, depth + 1)}" if nested else f"{pad}{key}: {json.dumps(value)}\n")
        return "".join(lines)
    return "".join(pad + "- " + block(each, depth + 1).lstrip() for each in node)


def _is_flat(value: list[Any]) -> bool:
    return not isinstance(value[0], (dict, list))


def moveit(path: Path, hands: Array, B: Array) -> Path:
    """As the panel of moveit_calibration saves samples: 16 numbers, row by row."""
    samples = [
        {"effector_wrt_world": T.ravel().tolist(), "object_wrt_sensor": b.ravel().tolist()}
        for T, b in zip(hands, B, strict=True)
    ]
    path.write_text(block(samples))
    return path


def easy_handeye2(path: Path, hands: Array, B: Array, calibration_type: str) -> Path:
    """The message SampleList of easy_handeye2; with a fixed camera it looks up the robot's poses the other way."""
    robot = np.linalg.inv(hands) if calibration_type == "eye_on_base" else hands
    content = {
        "parameters": {
            "name": "cell", "calibration_type": calibration_type, "robot_base_frame": "base_link",
            "robot_effector_frame": "tool0", "tracking_base_frame": "camera_optical", "tracking_marker_frame": "board",
            "freehand_robot_movement": True, "move_group_namespace": "/", "move_group": "manipulator",
        },
        "samples": [{"robot": message(T), "tracking": message(b)} for T, b in zip(robot, B, strict=True)],
    }  # fmt: skip
    path.write_text(block(content))
    return path


def easy_handeye(path: Path, hands: Array, B: Array) -> Path:
    """The answer of easy_handeye's service take_sample, as ``rosservice`` prints it: two lists."""
    content = {
        "samples": {"hand_world_samples": [message(T) for T in hands], "camera_marker_samples": [message(b) for b in B]}
    }
    path.write_text(block(content))
    return path


def easy_handeye_stamped(path: Path, hands: Array, B: Array) -> Path:
    """The sampler's list of stamped transforms, robot and optical, in JSON."""
    stamped = [
        {"robot": {"header": {"frame_id": "base"}, "child_frame_id": "tool0", "transform": message(T)},
         "optical": {"header": {"frame_id": "camera"}, "child_frame_id": "board", "transform": message(b)}}
        for T, b in zip(hands, B, strict=True)
    ]  # fmt: skip
    path.write_text(json.dumps(stamped, indent="\t"))
    return path


def opencv(path: Path, hands: Array, B: Array) -> Path:
    """Arrays for calibrateHandEye in a FileStorage, one matrix each."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for i, (T, b) in enumerate(zip(hands, B, strict=True)):
        for name, each in (("gripper2base", T), ("target2cam", b)):
            storage.write(f"R_{name}_{i}", np.ascontiguousarray(each[:3, :3]))
            storage.write(f"t_{name}_{i}", np.ascontiguousarray(each[:3, 3:]))
    storage.release()
    return path


def opencv_lists(path: Path, hands: Array, B: Array) -> Path:
    """The same as lists in JSON, rotation vectors for the target."""
    rvec = [cv2.Rodrigues(b[:3, :3])[0].ravel().tolist() for b in B]
    content = {
        "R_gripper2base": hands[:, :3, :3].tolist(), "t_gripper2base": hands[:, :3, 3].tolist(),
        "rvec_target2cam": rvec, "tvec_target2cam": B[:, :3, 3].tolist(),
    }  # fmt: skip
    path.write_text(json.dumps(content))
    return path
