"""Eye-in-hand or eye-to-hand: what solving both ways tells, and where it cannot tell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import CELL
from rwhec_factors import se3

from gtsam_rwhec.cameras.targets import CORNERS, Checkerboard, CircleGrid, Tag, Target
from gtsam_rwhec.detect.detector import Detection
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.rig import PoseNoise, Rig, parse_rig, propose_rig
from gtsam_rwhec.rig.carrier_roles import (
    ARM,
    MOTION_CAPTURE,
    ODOMETRY,
    Seen,
    evidence_of_roles,
    origin_of,
    rest_of,
    smoothness_m,
)
from gtsam_rwhec.rig.target_sections import TagTarget

TAG = Tag("tag", "tag36h11", 0, 0.1)


def poses(rng: np.random.Generator, number: int, turn_rad: float = 1.0, move_m: float = 0.5) -> np.ndarray:
    return se3.expmap(
        np.concatenate([turn_rad * rng.normal(size=(number, 3)), move_m * rng.normal(size=(number, 3))], 1)
    )


def detection(T: np.ndarray) -> Detection:
    both = np.stack([T, np.full((4, 4), np.nan)])
    covariance = np.tile(1e-6 * np.eye(6), (2, 1, 1))
    return Detection(
        "tag", np.zeros((4, 2)), np.arange(4), both, np.array([0.1, np.nan]), np.zeros(2), covariance, 50.0, 1.0
    )


def seen(
    T: np.ndarray, on_child: bool, rng: np.random.Generator, target: Target = TAG, size: float = 1.0
) -> list[Seen]:
    """What a camera on the child or on the parent of poses T sees of a target on the other, `size` times too large."""
    X, Y = poses(rng, 2)
    B = se3.inverse(X) @ (se3.inverse(T) if on_child else T) @ Y
    B = B @ se3.expmap(1e-3 * rng.normal(size=(len(T), 6)))
    B[:, :3, 3] *= size
    return [Seen("camera", target, detection(b), t) for b, t in zip(B, T, strict=True)]


@pytest.mark.parametrize("on_child", [True, False])
def test_both_roles_are_told_apart_with_the_scale(on_child: bool) -> None:
    rng = np.random.default_rng(3)
    found = evidence_of_roles(seen(poses(rng, 10), on_child, rng, size=1.6))
    assert found.role == ("child" if on_child else "parent")
    assert found.sizes == {"tag": pytest.approx(1.0 / 1.6, rel=0.02)}
    assert "over 10 measurements" in found.in_words("base", "hand")


@pytest.mark.parametrize(
    "board", [Checkerboard("board", 4, 4, 0.1), CircleGrid("grid", 7, 5, 0.1), CircleGrid("dot", 7, 5, 0.1, CORNERS[0])]
)
def test_boards_that_look_the_same_turned(board: Checkerboard | CircleGrid) -> None:
    rng = np.random.default_rng(4)
    found = evidence_of_roles(seen(poses(rng, 12), False, rng, board))
    assert found.role == "parent"


def test_what_tells_nothing() -> None:
    rng = np.random.default_rng(5)
    still = np.tile(poses(rng, 1), (10, 1, 1))
    assert evidence_of_roles(seen(still, True, rng)).role is None
    assert evidence_of_roles(seen(poses(rng, 5), True, rng)).role is None  # too few
    assert evidence_of_roles([]).role is None
    assert evidence_of_roles(seen(poses(rng, 12, turn_rad=0.0), True, rng)).role is None  # moved without turning
    nonsense = [Seen("camera", TAG, detection(T), A) for T, A in zip(poses(rng, 12), poses(rng, 12), strict=True)]
    assert evidence_of_roles(nonsense).role is None
    assert evidence_of_roles(nonsense).sizes == {}


def test_rotations_that_fit_without_the_positions_tell_nothing() -> None:
    """Quaternions in another order turn all rotations alike, and the positions say so."""
    rng = np.random.default_rng(6)
    T = poses(rng, 16)
    measured = seen(T, False, rng)
    other = T.copy()
    other[:, :3, 3] = rng.permutation(T[:, :3, 3])
    found = evidence_of_roles(
        [Seen(one.sensor, one.target, one.detection, A) for one, A in zip(measured, other, strict=True)]
    )
    assert found.role is None


STEP_NS = 100_000_000


def proposed(path: Path) -> tuple[Rig, str, str]:
    with open_log(path) as log:
        text, notes = propose_rig(log, "rig.yaml")
    return parse_rig(text, "rig.yaml"), " ".join(text.replace("\n  #", "").split()), "\n".join(notes)


def written(path: Path, *, on_child: bool, parent: str = "base", child: str = "tool0", turning: bool = True) -> Path:
    """A log of poses at 10 Hz and of a driver's detections of a tag that is 8 cm where the driver says nothing."""
    rng = np.random.default_rng(7)
    X, Y = se3.expmap(rng.normal(size=(2, 6)))
    time = np.arange(60)[:, None]
    xi = 0.7 * np.sin(0.11 * time * np.array([1.0, 1.3, 0.7, 0.9, 1.1, 0.6]) + np.arange(6))
    if not turning:
        xi[:, :3] = 0.0
    T = se3.expmap(xi)
    B = se3.inverse(X) @ (se3.inverse(T) if on_child else T) @ Y @ se3.expmap(2e-3 * rng.normal(size=(60, 6)))
    B[:, :3, 3] *= 0.1 / 0.08  # lengths for a tag of 10 cm, which is what a first rig file says
    with LogWriter(path) as out:
        for i in range(60):
            out.transforms("/tf", 10**9 + i * STEP_NS, [(parent, child, T[i])])
            record = DetectionRecord(0, 0, "", "", "36h11", "5", T_camera_tag=B[i])
            out.detections("/tags", 10**9 + i * STEP_NS, "optical", [record])
    return path


@pytest.mark.parametrize("on_child", [True, False])
def test_the_role_and_the_size(tmp_path: Path, on_child: bool) -> None:
    rig, text, notes = proposed(written(tmp_path / "run.mcap", on_child=on_child))
    assert (rig.carriers.sensors, rig.carriers.targets) == (("tool0", "base") if on_child else ("base", "tool0"))
    assert "a guess: " + rig.carriers.sensors + " carries the sensors; solved both ways over 60 measurements" in text
    (tag,) = rig.targets.values()
    assert isinstance(tag, TagTarget)
    assert tag.size_m == pytest.approx(0.08, rel=0.01)
    assert "the length here is what the motion says" in text
    assert rig.carriers.noise is not None
    assert "a robot's arm, by the name tool0" in notes


def test_motion_that_tells_nothing(tmp_path: Path) -> None:
    rig, text, _ = proposed(written(tmp_path / "run.mcap", on_child=True, parent="a", child="b", turning=False))
    assert "TODO fixed camera and target on the hand: exchange the two names; solved both ways" in text
    assert rig.carriers.noise is None
    (tag,) = rig.targets.values()
    assert isinstance(tag, TagTarget)
    assert tag.size_m == 0.1


@pytest.mark.slow
def test_the_shipped_logs() -> None:
    rig, text, _ = proposed(CELL / "eye_to_hand.mcap")
    assert rig.carriers.sensors == "base"
    (tag,) = rig.targets.values()
    assert isinstance(tag, TagTarget)
    assert tag.size_m == pytest.approx(0.1, rel=0.01)
    rig, text, _ = proposed(CELL / "robot_cell.mcap")
    assert (rig.carriers.sensors, rig.carriers.targets) == ("hand", "base")
    assert {target.family for target in rig.target_list} == {"tag36h11", "aruco_5x5_50"}
    assert {sensor.time_offset for sensor in rig.sensors.values()} == {"estimate"}  # both logs are in motion
    assert text.count("the length here is what the motion says") >= 3
    assert "squares: [7, 5]" in text
    assert "other columns and rows do not fit" in text


@pytest.mark.parametrize(
    ("names", "schema", "noise", "reason"),
    [
        (["/vicon/hand/pose", "world", "hand"], "", MOTION_CAPTURE, "motion capture, by the name /vicon/hand/pose"),
        (["base_link", "tool0"], "", ARM, "a robot's arm, by the name base_link"),
        (["odom", "base_link"], "", ODOMETRY, "visual-inertial odometry or SLAM, by the name odom"),
        (["world", "body"], "nav_msgs/msg/Odometry", ODOMETRY, "by the messages' type nav_msgs/msg/Odometry"),
        (["world", "body"], "", None, "no name tells"),
    ],
)
def test_names_and_types_tell(names: list[str], schema: str, noise: PoseNoise | None, reason: str) -> None:
    origin = origin_of(names, schema)
    assert origin.noise == noise
    assert reason in origin.words


def path(rate_hz: float, number: int, speed_m_s: float = 0.2, noise_m: float = 0.0, stops: bool = False) -> Trajectory:
    stamps = (10**9 + np.arange(number) * 1e9 / rate_hz).astype(np.int64)
    seconds = 1e-9 * (stamps - stamps[0])
    if stops:  # three seconds at each station, one on the way
        seconds = 4.0 * np.floor(seconds / 4.0) + np.clip(4.0 * (seconds % 4.0 - 3.0), 0.0, None)
    xi = np.zeros((number, 6))
    xi[:, 3] = speed_m_s * seconds
    T = se3.expmap(xi)
    T[:, :3, 3] += noise_m * np.random.default_rng(0).normal(size=(number, 3))
    return Trajectory(stamps, T)


@pytest.mark.parametrize("noise_m", [0.0001, 0.003])
def test_how_smooth_a_path_is(noise_m: float) -> None:
    rough = path(100.0, 400, noise_m=noise_m)
    assert smoothness_m(rough) == pytest.approx(noise_m, rel=0.15)
    assert "100 poses a second, smooth to" in origin_of(["base", "hand"], path=rough).words


def test_at_rest_or_in_motion() -> None:
    moving, stopping = path(50.0, 2000), path(50.0, 2000, stops=True)
    at_stations = (10**9 + 10**9 * (4.0 * np.arange(1, 9) + 1.5)).astype(np.int64)
    assert not rest_of(at_stations, moving).at_rest
    assert rest_of(at_stations, stopping).at_rest
    assert rest_of(at_stations, stopping).words == "the carrier stood still at 8 of 8 images"
    assert not rest_of(at_stations + 2 * 10**9, stopping).at_rest  # on the way
    stations = path(0.2, 20)
    assert rest_of(stations.stamps_ns, stations).at_rest
    assert "5 s apart" in rest_of(stations.stamps_ns, stations).words
