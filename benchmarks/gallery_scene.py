"""The gallery's cell: an arm, a camera on its hand, a board on a table; pictures of it, and a folder as users have it.

Images are drawn by `rendered_scenes`, ray by ray. What a fault changes is a field of `Recording`: the truth of each
image, what the controller reports of it, and how it is written.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import rendered_prints as prints
import rendered_scenes as scenes
from rendered_prints import Array
from rwhec_factors import se3
from rwhec_factors.se3 import inverse
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from simulated_arms import ARM, BENT_RAD, moved_by, white

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Charuco

IMAGES = 30
#: The controller's poses: rad and m about and along each axis.
REPEAT_RAD, REPEAT_M = float(np.radians(0.02)), 1e-4
#: The board of the rig file: 7 x 5 squares of 40 mm.
SQUARE_M, MARKER_M, SQUARES = 0.040, 0.030, (7, 5)
#: Pixels of the printed picture in a marker's module: rays are at most as far apart as these.
PER_MODULE = 20
#: Nanoseconds at which a log begins; how often a controller reports; seconds of a moving log.
START_NS, RATE_HZ, SECONDS = 1_700_000_000_000_000_000, 50.0, 16.0
#: Bends of elbow and wrist from which a pose is looked for.
REACH_RAD = BENT_RAD + np.random.default_rng(0).uniform(-1.0, 1.0, (6, 6))
#: The arm of the data sheet: longer than that of `simulated_arms`, so that it reaches around the board.
LONG_ARM = replace(ARM, length_m=1.4 * ARM.length_m)
#: Where the board lies, seen from the arm's base; where the camera sits on the hand.
T_BASE_BOARD = se3.pose(np.eye(3), (-0.60, -0.15, 0.0))


@dataclass(frozen=True, eq=False)
class Recording:
    """What was true while images were taken, and what of it is written."""

    #: T_base_hand, T_hand_camera, T_base_board: (N, 4, 4): The truth in each image.
    T_base_hand: Array
    T_hand_camera: Array
    T_base_board: Array
    reported: Array  #: (N, 4, 4): T_base_hand as the controller has it; of a moving log also at other times
    #: camera, stated: The lens, and the intrinsics of the rig file.
    camera: Camera
    stated: Camera
    size: float = 1.0  #: The board's true size over the stated one
    #: stamps_ns, reported_ns: (N,): Of images and of poses, where the arm moved; else images were taken at rest
    stamps_ns: Array | None = None
    reported_ns: Array | None = None
    velocity: Array | None = field(default=None, repr=False)
    exposure_s: float = 0.0  #: For how long the shutter is open
    turned: tuple[int, ...] = ()  #: Images that are upside down
    poses: str = "xyzw"  #: How poses are written: "xyzw", "wxyz", "mm" or "inverse"
    carriers: tuple[str, str] = ("hand", "base")  #: What the rig file says of sensors and targets

    @property
    def T_camera_board(self) -> Array:
        """(N, 4, 4): what each image shows."""
        return inverse(self.T_base_hand @ self.T_hand_camera) @ self.T_base_board


def lens(rng: np.random.Generator) -> Camera:
    """A camera of 720 x 540 pixels with some distortion."""
    focal = rng.uniform(560.0, 640.0)
    K = [
        [focal, 0.0, scenes.WIDTH / 2 + rng.uniform(-8, 8)],
        [0.0, focal * rng.uniform(0.998, 1.002), scenes.HEIGHT / 2 + rng.uniform(-8, 8)],
        [0.0, 0.0, 1.0],
    ]
    D = [rng.uniform(-0.12, -0.04), rng.uniform(0.0, 0.04), *rng.uniform(-4e-4, 4e-4, 2)]
    return Camera.of(scenes.WIDTH, scenes.HEIGHT, "plumb_bob", K, D, "camera")


def on_hand(rng: np.random.Generator) -> Array:
    """T_hand_camera (4, 4): a few centimetres beside the flange, looking ahead."""
    return se3.pose(
        Rotation.from_euler("zyx", rng.normal(0.0, [40.0, 5.0, 5.0]), degrees=True).as_matrix(),
        rng.uniform([-0.06, -0.06, 0.03], [0.06, 0.06, 0.09]),
    )


def looking(distance_m: Array, tilt_rad: Array, towards_rad: Array, roll_rad: Array, beside_m: Array) -> Array:
    """T_board_camera (N, 4, 4) of cameras that look at points of the board's plane, `beside_m` (N, 2) of its middle."""
    n = len(distance_m)
    away = np.column_stack(
        [np.sin(tilt_rad) * np.cos(towards_rad), np.sin(tilt_rad) * np.sin(towards_rad), np.cos(tilt_rad)]
    )
    axis = np.column_stack([-np.sin(towards_rad), np.cos(towards_rad), np.zeros(n)])
    # A camera above the board that looks down has its y against the board's.
    R = (
        Rotation.from_rotvec(axis * tilt_rad[:, None])
        * Rotation.from_euler("x", np.pi)
        * Rotation.from_euler("z", roll_rad[:, None])
    )
    return se3.pose(R.as_matrix(), away * distance_m[:, None] + np.column_stack([beside_m, np.zeros(n)]))


def all_around(rng: np.random.Generator, n: int | None = None) -> Array:
    """T_board_camera (N, 4, 4) of good stations: from all sides, near and far, and turned."""
    n = IMAGES if n is None else n
    return looking(
        rng.uniform(0.42, 0.62, n),
        np.radians(rng.uniform(8.0, 36.0, n)),
        rng.permutation(2.0 * np.pi * (np.arange(n) + rng.uniform(0.0, 1.0, n)) / n),
        np.radians(rng.uniform(-60.0, 60.0, n)),
        rng.uniform(-0.04, 0.04, (n, 2)),
    )


def path(rng: np.random.Generator, t_s: Array) -> Array:
    """T_board_camera (N, 4, 4) along a smooth path that turns about every axis, at seconds (N,)."""
    a, b = rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    rates = rng.uniform(0.75, 1.25, 6) * [2.0, 2.8, 1.6, 2.2, 3.0, 1.8]
    wave = np.sin(t_s[:, None] * rates + a) + 0.25 * np.sin(2.7 * t_s[:, None] * rates + b)
    T = np.tile(np.eye(4), (len(t_s), 1, 1))
    turn = Rotation.from_euler("ZYX", np.radians(wave[:, :3] * [30.0, 18.0, 18.0]))
    T[:, :3, :3] = (Rotation.from_euler("x", np.pi) * turn).as_matrix()
    distance = 0.58 + 0.08 * wave[:, 3]
    # The camera goes to where it looks away from, so that the board stays in view.
    T[:, :3, 3] = -T[:, :3, 2] * distance[:, None] + np.column_stack([0.03 * wave[:, 4:], np.zeros(len(t_s))])
    return T


def at_rest(rng: np.random.Generator, T_board_camera: Array) -> Recording:
    """A good recording of stations."""
    return _recorded(rng, T_board_camera)


def in_motion(rng: np.random.Generator) -> Recording:
    """A good recording of an arm that does not stop, with a short exposure."""
    n = IMAGES
    reported_s = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    image_s = np.linspace(0.6, SECONDS - 0.6, n) + rng.uniform(-0.05, 0.05, n)
    step_s = 1e-3
    of_path = path(rng, np.concatenate([reported_s, image_s, image_s + step_s]))
    stream, images, after = np.split(of_path, [len(reported_s), len(reported_s) + n])
    there = _recorded(rng, images)
    T_base_hand = T_BASE_BOARD @ stream @ inverse(there.T_hand_camera[:1])
    return replace(
        there,
        reported=moved_by(T_base_hand, white(len(stream), REPEAT_RAD, REPEAT_M, rng)),
        reported_ns=START_NS + np.rint(1e9 * reported_s).astype(np.int64),
        stamps_ns=START_NS + np.rint(1e9 * image_s).astype(np.int64),
        velocity=(inverse(after) - inverse(images)) / step_s,
        exposure_s=2e-3,
    )


def _recorded(rng: np.random.Generator, T_board_camera: Array) -> Recording:
    n, camera = len(T_board_camera), lens(rng)
    T_hand_camera = np.tile(on_hand(rng), (n, 1, 1))
    T_base_board = np.tile(T_BASE_BOARD, (n, 1, 1))
    T_base_hand = T_base_board @ T_board_camera @ inverse(T_hand_camera)
    reported = moved_by(T_base_hand, white(n, REPEAT_RAD, REPEAT_M, rng))
    return Recording(T_base_hand, T_hand_camera, T_base_board, reported, camera, camera)


def joints_for(T_base_hand: Array) -> Array:
    """Joint angles (N, 6) with which the arm of the data sheet is at poses (N, 4, 4); nan where it does not reach."""
    found, start = [], BENT_RAD
    for T in T_base_hand:
        for begin in (start, BENT_RAD, *REACH_RAD):
            fit = least_squares(_off, begin, args=(T,), xtol=1e-13, ftol=1e-13, gtol=1e-13)
            if fit.cost < 1e-12:
                start = fit.x
                break
        found.append(fit.x if fit.cost < 1e-12 else np.full(6, np.nan))
    return np.array(found)


def _off(joints_rad: Array, T: Array) -> Array:
    return np.asarray((LONG_ARM.hand(joints_rad[None])[0] - T)[:3].ravel())


def within_reach(rng: np.random.Generator) -> tuple[Recording, Array]:
    """A good recording of stations that the arm reaches, and its joint angles (N, 6)."""
    recording = at_rest(rng, all_around(rng, 2 * IMAGES))
    joints = joints_for(recording.T_base_hand)
    kept = np.flatnonzero(np.isfinite(joints[:, 0]))[:IMAGES]
    assert len(kept) == IMAGES, "put the board nearer to the arm"
    of = {name: getattr(recording, name)[kept] for name in ("T_base_hand", "T_hand_camera", "T_base_board", "reported")}
    return replace(recording, **of), joints[kept]


def board() -> Charuco:
    """As the rig file has it."""
    return Charuco("board", "aruco_4x4_100", *SQUARES, SQUARE_M, MARKER_M)


def image(recording: Recording, number: int, rng: np.random.Generator, background: scenes.Picture) -> scenes.Gray:
    """One picture."""
    T = recording.T_camera_board[number]
    printed = prints.charuco(board(), PER_MODULE, 4.0)
    printed = prints.Print(printed.picture, printed.pixel_m * recording.size)
    light = scenes.Light(0.05, 0.8, 0.15, 0.7, (0.0, 0.0), 1.0, 1.5)
    lit = background.copy()
    scenes.laid_over(lit, scenes.Pose(recording.camera, T, 0.0), printed, light)
    if recording.velocity is not None:
        lit = blurred(lit, way_px(recording, number))
    gray = scenes.seen_by_camera(rng, lit, light)
    return np.ascontiguousarray(gray[::-1, ::-1]) if number in recording.turned else gray


def way_px(recording: Recording, number: int) -> Array:
    """The way (2,) of the board's middle over the image while the shutter is open."""
    assert recording.velocity is not None
    T = recording.T_camera_board[number]
    half = 0.5 * recording.exposure_s * recording.velocity[number][:3, 3]
    ends = np.stack([T[:3, 3] - half, T[:3, 3] + half])
    return np.asarray(np.diff(scenes.projected(recording.camera, ends, np.eye(4)), axis=0)[0])


def blurred(lit: scenes.Picture, way: Array) -> scenes.Picture:
    """Light (height, width) that moved evenly by a way (2,) of pixels."""
    half = int(np.ceil(0.5 * np.abs(way).max())) + 1
    grid = np.stack(np.meshgrid(*2 * [np.arange(-half, half + 1)]), axis=-1)
    along = np.linspace(-0.5, 0.5, 8 * half + 1)[:, None] * way
    near = np.clip(1.0 - np.abs(grid[:, :, None] - along), 0.0, 1.0).prod(axis=-1).sum(axis=-1)
    kernel = (near / near.sum()).astype(np.float32)
    return np.asarray(cv2.filter2D(lit, -1, kernel, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)


def write(recording: Recording, folder: Path, seed: int) -> Path:
    """The images, the poses beside them and the rig file, as their user has them; returns the rig file."""
    rng = np.random.default_rng([seed, 15])
    images = folder / "images"
    images.mkdir(parents=True)
    background = scenes.cluttered(rng) * np.float32(0.6)
    for number in range(len(recording.T_base_hand)):
        name = f"{number:03d}" if recording.stamps_ns is None else str(int(recording.stamps_ns[number]))
        cv2.imwrite(str(images / f"{name}.png"), image(recording, number, rng, background))
    (folder / "poses.csv").write_text("\n".join(pose_lines(recording)) + "\n", encoding="utf-8")
    rig = folder / "rig.yaml"
    rig.write_text(rig_text(recording), encoding="utf-8")
    return rig


def pose_lines(recording: Recording) -> list[str]:
    """A table of poses as a controller writes it: x, y, z and a quaternion."""
    T = inverse(recording.reported) if recording.poses == "inverse" else recording.reported
    q = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    if recording.poses == "wxyz":
        q = q[:, [3, 0, 1, 2]]
    unit = 1e3 if recording.poses == "mm" else 1.0
    if recording.reported_ns is None:
        names = [f"{number:03d}" for number in range(len(T))]
        columns = "name"
    else:
        names, columns = [str(int(stamp)) for stamp in recording.reported_ns], "stamp_ns"
    rows = np.column_stack([unit * T[:, :3, 3], q])
    table = [f"{name}," + ",".join(f"{value:.8f}" for value in row) for name, row in zip(names, rows, strict=True)]
    return [f"{columns},x,y,z,qx,qy,qz,qw", *table]


def rig_text(recording: Recording) -> str:
    """The rig file."""
    camera = recording.stated
    K = [round(float(x), 3) for x in (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2])]
    D = [round(float(x), 6) for x in camera.D[:4]]
    sensors, targets = recording.carriers
    return (
        f"carriers: {{sensors: {sensors}, targets: {targets}, poses: {{frames: [base, hand]}}}}\n"
        "sensors:\n"
        "  camera:\n"
        "    images: images\n"
        "    poses: poses.csv\n"
        f"    intrinsics: {{model: radtan, K: {K}, D: {D}, size: [{camera.width}, {camera.height}], "
        "stated: calibration}\n"
        "targets:\n"
        f"  board: {{type: charuco, family: aruco_4x4_100, squares: [{SQUARES[0]}, {SQUARES[1]}], "
        f"square_m: {SQUARE_M}, marker_m: {MARKER_M}}}\n"
    )
