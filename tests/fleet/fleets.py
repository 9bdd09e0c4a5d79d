"""Fleets of made-up robots, each with a hand that carries cameras over tags, and logs of a driver's detections.

written = write_fleet(tmp_path, robots=3, logs=2)
fleet.run(fleet.read_manifest(written.manifest), ...)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import synthetic_logs as made
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

from gtsam_rwhec.geometry.poses import Array

#: 2026-11-01 02:00 UTC; each log is a night later.
BEGIN_NS = 1_793_498_400_000_000_000
NIGHT_NS = 86_400_000_000_000
SIZE_M, FOCAL, CENTRE, IMAGE = 0.12, 400.0, (320.0, 240.0), (640, 480)
TF_HZ, CAMERA_HZ = 10.0, 5.0
HALF = 0.5 * SIZE_M
SQUARE = np.array([[-HALF, HALF, 0], [HALF, HALF, 0], [HALF, -HALF, 0], [-HALF, -HALF, 0]])
RIG = """\
carriers:
  sensors: hand
  targets: base
  poses: {tf: [base, hand]}
  max_gap_s: 0.5
sensors:
"""


@dataclass(frozen=True)
class MadeFleet:
    """Where it is, and the truth."""

    manifest: str
    rig: str  #: The rig file of all robots
    logs: dict[str, tuple[Path, ...]]  #: By robot
    truth: dict[str, dict[str, Array]]  #: By robot, then by frame: T_hand_camera and T_base_tag


def write_fleet(
    folder: Path,
    robots: int = 2,
    logs: int = 2,
    *,
    images: int = 40,
    tags: int = 4,
    cameras: int = 1,
    sites: Mapping[str, tuple[int, ...]] | None = None,
    corners: bool = True,
    seed: int = 0,
    moved: Mapping[tuple[int, str], tuple[int, Array]] | None = None,
) -> MadeFleet:
    """Write logs, a rig file and a manifest.

    Parameters
    ----------
    folder
        Gets ``fleet.yaml``, ``rig.yaml`` and ``logs/ROBOT/NIGHT.mcap``.
    robots, logs
        How many, and how many logs of each, a night apart.
    images, tags, cameras
        Of each log; every tag is in every image.
    sites : dict of str to tuple of int, optional
        The robots of a site see the same tags.
    corners : bool
        Whether the rig file has intrinsics, so that corners count.
    seed : int
    moved : dict of (robot, frame) to (log, (4, 4) array), optional
        From this log on the frame is where it was, turned and moved by this pose.
    """
    names = [f"robot_{i:03d}" for i in range(robots)]
    cams, tag_names = [f"cam_{i}" for i in range(cameras)], [f"tag_{i}" for i in range(tags)]
    at = {robot: site for site, members in (sites or {}).items() for robot in members}
    truth, paths = {}, {}
    for i, name in enumerate(names):
        own = np.random.default_rng([seed, 1, i])
        shared = np.random.default_rng([seed, 2, sorted(sites).index(at[i])]) if sites and i in at else own
        X, Y = _tags(tags, shared), _cameras(cameras, own)
        frames = dict(zip([*cams, *tag_names], [*Y, *X], strict=True))
        truth[name] = frames
        place = folder / "logs" / name
        place.mkdir(parents=True, exist_ok=True)
        written = []
        for j in range(logs):
            now = {
                frame: T @ change[1] if (change := (moved or {}).get((i, frame))) and j >= change[0] else T
                for frame, T in frames.items()
            }
            path = place / f"night_{j:02d}.mcap"
            write_log(path, [now[c] for c in cams], [now[t] for t in tag_names], images, j, [seed, 3, i, j])
            written.append(path)
        paths[name] = tuple(written)
    rig = folder / "rig.yaml"
    rig.write_text(rig_text(cams, tags, corners=corners), encoding="utf-8")
    listed = "".join(f'  {name}: "logs/{name}/*.mcap"\n' for name in names)
    stated = "".join(f"  {site}: [{', '.join(names[i] for i in members)}]\n" for site, members in (sites or {}).items())
    manifest = folder / "fleet.yaml"
    manifest.write_text(f"rig: rig.yaml\nrobots:\n{listed}{'sites:' if stated else ''}\n{stated}", encoding="utf-8")
    return MadeFleet(str(manifest), str(rig), paths, truth)


def rig_text(cams: list[str], tags: int, *, corners: bool = True, size_m: float = SIZE_M, focal: float = FOCAL) -> str:
    """The rig file."""
    known = f", intrinsics: {{K: [{focal}, {focal}, {CENTRE[0]}, {CENTRE[1]}], size: [{IMAGE[0]}, {IMAGE[1]}]}}"
    of_cams = "".join(f"  {cam}: {{detections: /{cam}/tags{known if corners else ''}}}\n" for cam in cams)
    of_tags = "".join(f"  tag_{i}: {{type: tag, family: tag36h11, id: {i}, size_m: {size_m}}}\n" for i in range(tags))
    return f"{RIG}{of_cams}targets:\n{of_tags}sizes: known\nnoise: estimate\n"


def hand_at(t_s: Array, phase: Array) -> Array:
    """T_base_hand (N, 4, 4): above the table, looking down, swinging about all axes."""
    s = 2.0 * np.pi * t_s[:, None]
    swing = np.array([12.0, 11.0, 40.0]) * np.sin(np.array([0.31, 0.23, 0.17]) * s + phase[:3])
    T = se3.pose(
        Rotation.from_euler("x", 180, degrees=True).as_matrix()
        @ (Rotation.from_euler("xyz", swing, degrees=True).as_matrix()),
        np.array([0.1, 0.1, 0.15]) * np.sin(np.array([0.19, 0.27, 0.13]) * s + phase[3:]),
    )
    T[:, 2, 3] += 1.25
    return T


def write_log(path: Path, Y: list[Array], X: list[Array], images: int, night: int, seed: list[int]) -> Path:
    """Write one log of detections; noise of poses 0.1 degrees and 1 mm, of corners 0.1 px, along each axis."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    begin = BEGIN_NS + night * NIGHT_NS
    t_tf = np.arange(int(np.ceil(images / CAMERA_HZ * TF_HZ)) + 2) / TF_HZ
    messages = [
        made.transform(begin + round(1e9 * t), "base", "hand", T)
        for t, T in zip(t_tf, hand_at(t_tf, phase), strict=True)
    ]
    # Half-way between stamps of tf nothing would be exact: images are taken at some of them.
    t_images = np.arange(images) / CAMERA_HZ
    for number, camera in enumerate(Y):
        T = np.linalg.inv(hand_at(t_images, phase) @ camera)[:, None] @ np.array(X)[None]
        corners = np.einsum("ntij,cj->ntci", T[..., :3, :3], SQUARE) + T[..., None, :3, 3]
        pixels = corners[..., :2] / corners[..., 2:] * FOCAL + np.array(CENTRE)
        pixels += rng.normal(0.0, 0.1, pixels.shape)
        xi = rng.normal(0.0, 1.0, (T[..., 0, 0].size, 6)) * np.repeat([np.radians(0.1), 1e-3], 3)
        seen = (T.reshape(-1, 4, 4) @ se3.expmap(xi)).reshape(T.shape)
        for i, t in enumerate(t_images):
            found = [made.tag(j, seen[i, j], size_m=SIZE_M, corners_px=pixels[i, j]) for j in range(len(X))]
            name = f"cam_{number}"
            messages.append(made.detections(f"/{name}/tags", begin + round(1e9 * t), name, found))
    return made.write(path, sorted(messages, key=lambda message: (message.logged_ns, message.topic)))


def _tags(count: int, rng: np.random.Generator) -> list[Array]:
    T = se3.pose(
        Rotation.from_euler("xyz", rng.uniform([-15, -15, -90], [15, 15, 90], (count, 3)), degrees=True).as_matrix(),
        rng.uniform([-0.15, -0.15, 0.0], [0.15, 0.15, 0.03], (count, 3)),
    )
    return list(T)


def _cameras(count: int, rng: np.random.Generator) -> list[Array]:
    T = se3.pose(
        Rotation.from_euler("xyz", rng.uniform([-5, -5, -40], [5, 5, 40], (count, 3)), degrees=True).as_matrix(),
        rng.uniform(-0.06, 0.06, (count, 3)),
    )
    return list(T)
