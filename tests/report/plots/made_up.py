"""Invented calibrations to draw: cameras on a hand, targets on walls, and realistic noise."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.report.plots import PlottedCorners, PlottedIntrinsics, PlottedMeasurement
from gtsam_rwhec.rig import RigFrames

TARGETS = ("tag_0", "tag_1", "tag_2", "tag_3", "board")
REASONS = (
    "standstill (m moved)",
    "outlier (robust estimation)",
    "rotation off the pair's consensus (rad)",
    "moving fast (m/s)",
    "gap in the carriers' poses (s)",
    "ambiguous pose",
    "few corners",
    "blurred",
    "grazing",
)


def pose(euler_deg: tuple[float, float, float], t: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", euler_deg, degrees=True).as_matrix()
    T[:3, 3] = t
    return T


def rig(count: int, seed: int = 0) -> RigFrames:
    """A ring of cameras (two: a stereo pair) on a hand, and five targets on two walls and a table."""
    generator = np.random.default_rng(seed)
    sensors = {}
    for k in range(count):
        if count == 2:
            T = pose((-90.0 + 4.0 * k, 2.0, -90.0), (0.05, 0.06 - 0.12 * k, 0.08))
        else:
            yaw = 2.0 * np.pi * k / count
            T = pose((float(np.degrees(yaw)) - 90.0, 0.0, -90.0), (0.15 * np.cos(yaw), 0.15 * np.sin(yaw), 0.3))
        sensors[["cam_left", "cam_right"][k] if count == 2 else f"cam_{k}"] = T
    targets = {
        "tag_0": pose((90.0, 0.0, 90.0), (1.6, 0.4, 0.9)),
        "tag_1": pose((92.0, 1.0, 90.0), (1.6, -0.3, 1.2)),
        "tag_2": pose((3.0, 0.0, 90.0), (0.7, 1.3, 1.0)),
        "tag_3": pose((30.0, 0.0, 0.0), (0.8, -0.2, 0.02)),
        "board": pose((75.0, -4.0, 88.0), (1.5, 0.0, 0.5)),
    }
    targets = {name: pose_noised(T, generator) for name, T in targets.items()}
    cameras = {
        name: Camera.of(1280, 960, "pinhole", [[820.0, 0.0, 640.0], [0.0, 820.0, 480.0], [0.0, 0.0, 1.0]], (), name)
        for name in sensors
    }
    return RigFrames("hand", "base", sensors, targets, cameras)


def pose_noised(T: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    noised = T.copy()
    noised[:3, 3] += 0.02 * generator.standard_normal(3)
    return noised


def covariances(frames: RigFrames, seed: int = 1) -> dict[str, np.ndarray]:
    """Covariances of about 0.02 degrees and half a millimetre, larger for targets."""
    generator = np.random.default_rng(seed)
    result = {}
    for name in (*frames.sensors, *frames.targets):
        root = generator.standard_normal((6, 6))
        size = np.r_[np.full(3, 3e-4), np.full(3, 4e-4)] * (2.0 if name in frames.targets else 1.0)
        result[name] = size[:, None] * (root @ root.T / 6.0) * size
    return result


def measurements(frames: RigFrames, each: int = 120, seed: int = 2) -> dict[tuple[str, str], PlottedMeasurement]:
    generator = np.random.default_rng(seed)
    result = {}
    for s, sensor in enumerate(frames.sensors):
        for target in frames.targets:
            stamps = 1.7e9 + np.sort(generator.uniform(0.0, 60.0, each))
            rotation = 0.15 * np.sqrt(generator.chisquare(3, each) / 3.0)
            translation = 2.0 * np.sqrt(generator.chisquare(3, each) / 3.0)
            kinds = REASONS if s else REASONS[:3]
            reason = [
                str(kinds[int(generator.integers(len(kinds)))]) if generator.random() < 0.15 else "" for _ in stamps
            ]
            wild = np.array([word.startswith(("outlier", "off")) for word in reason])
            rotation[wild] *= generator.uniform(5.0, 300.0, wild.sum())
            translation[wild] *= generator.uniform(5.0, 300.0, wild.sum())
            nowhere = np.array([word.startswith("gap") for word in reason])
            rotation[nowhere] = translation[nowhere] = np.nan
            result[target, sensor] = PlottedMeasurement(
                stamps, rotation, translation, np.array([not word for word in reason]), reason
            )
    return result


def corners(frames: RigFrames, each: int = 1500, seed: int = 3) -> dict[str, PlottedCorners]:
    """Clusters of corners; the first camera's intrinsics are slightly wrong."""
    generator = np.random.default_rng(seed)
    result = {}
    for k, sensor in enumerate(frames.sensors):
        camera = frames.cameras[sensor]
        middles = generator.uniform((150.0, 120.0), (camera.width - 150.0, camera.height - 120.0), (each // 20, 2))
        pixels = (middles[:, None] + generator.uniform(-90.0, 90.0, (each // 20, 20, 2))).reshape(-1, 2)
        errors = 0.25 * generator.standard_normal(pixels.shape)
        if k == 0:
            errors += 6e-7 * (pixels - (640.0, 480.0)) * np.linalg.norm(pixels - (640.0, 480.0), axis=1)[:, None]
        result[sensor] = PlottedCorners(pixels, errors)
    return result


def intrinsics(frames: RigFrames, seen: dict[str, PlottedCorners]) -> dict[str, PlottedIntrinsics]:
    """Projections that are more uncertain from the middle outwards, and errors of images that were left out."""
    result = {}
    for sensor, camera in frames.cameras.items():
        u, v = (np.linspace(0.0, size - 1.0, 20) for size in (camera.width, camera.height))
        grid = np.stack(np.meshgrid(u, v), axis=-1)
        radius = np.linalg.norm(grid - (640.0, 480.0), axis=-1) / 800.0
        held_out = ((0.41, 0.3, None), (0.33, 0.28, 0.35), (0.5, 0.31, 0.47))
        size = (camera.width, camera.height)
        image = np.arange(len(seen[sensor].pixels)) % 30
        result[sensor] = PlottedIntrinsics(size, seen[sensor], image, grid, 0.05 + 2.0 * radius**4, 1.2, held_out)
    return result
