"""Files of poses as many tools write them: each gives the same transforms, and what is not said is asked for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rwhec_factors import se3
from scipy.spatial.transform import Rotation
from strategies import damaged, tables

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files import yaml_lines
from gtsam_rwhec.logs import pose_trees
from gtsam_rwhec.logs.image_folder import read_poses
from gtsam_rwhec.logs.pose_tables import PoseStatement

RNG = np.random.default_rng(3)
TURNS = Rotation.random(4, rng=RNG)
T = se3.pose(TURNS.as_matrix(), RNG.uniform(-1.0, 1.0, (4, 3)))
Q = TURNS.as_quat()
NAMES = [f"im_{i}.png" for i in range(4)]


def lines(header: str, *columns: object, mark: str = ",") -> str:
    rows = [mark.join(str(x) for part in row for x in np.ravel(part).tolist()) for row in zip(*columns, strict=True)]
    return "\n".join([header, *rows] if header else rows) + "\n"


P, WXYZ, DEGREES = T[:, :3, 3], Q[:, [3, 0, 1, 2]], TURNS.as_euler("ZYX", degrees=True)
ABOUT_XYZ = DEGREES[:, ::-1]  # yaw, pitch, roll: about x, y, z
TEXTS = {
    "tum.txt": (lines("# timestamp tx ty tz qx qy qz qw", range(4), P, Q, mark=" "), {}),
    "plain.csv": (lines("", P, Q), {}),
    "wxyz.csv": (lines("", P, WXYZ), {"quaternion": "wxyz"}),
    "named.csv": (lines("image,qw,qx,qy,qz,x,y,z", NAMES, WXYZ, P), {}),
    "euroc.csv": (
        lines(
            "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []",
            [17 * 10**17 + i for i in range(4)], P, WXYZ,
        ),
        {},
    ),
    "rostopic.csv": (
        lines(
            "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,"
            "field.pose.position.y,field.pose.position.z,field.pose.orientation.x,field.pose.orientation.y,"
            "field.pose.orientation.z,field.pose.orientation.w",
            range(4), range(4), [17 * 10**17] * 4, ["base"] * 4, P, Q,
        ),
        {},
    ),
    "millimetres.csv": (lines("name;x [mm];y [mm];z [mm];q_x;q_y;q_z;q_w", NAMES, 1e3 * P, Q, mark=";"), {}),
    "stated_millimetres.csv": (lines("", NAMES, 1e3 * P, Q), {"length": "mm"}),
    "euler.csv": (lines("", NAMES, P, DEGREES), {"euler": "ZYX", "angles": "degrees"}),
    "roll_pitch_yaw.csv": (lines("x,y,z,roll,pitch,yaw", P, ABOUT_XYZ), {"euler": "ZYX", "angles": "degrees"}),
    "rotvec.txt": (lines("", P, TURNS.as_rotvec(), mark=" "), {"euler": "rotation_vector", "angles": "radians"}),
    "kitti.txt": (lines("", T[:, :3].reshape(4, 12), mark=" "), {}),
    "flat.csv": (lines("", NAMES, T.reshape(4, 16)), {}),
    "stacked.txt": (lines("", T.reshape(16, 4), mark=" "), {}),
    "entries.csv": (
        lines("r11,r12,r13,r21,r22,r23,r31,r32,r33,tx,ty,tz", T[:, :3, :3].reshape(4, 9), P), {},
    ),
    "matrices.json": (json.dumps({name: t.tolist() for name, t in zip(NAMES, T, strict=True)}), {}),
    "nerf.json": (
        json.dumps(
            {"frames": [{"file_path": n, "transform_matrix": t.tolist()} for n, t in zip(NAMES, T, strict=True)]}
        ),
        {},
    ),
    "ros.yaml": (
        json.dumps([
            {
                "header": {"stamp": {"sec": i, "nanosec": 5}},
                "pose": {
                    "position": dict(zip("xyz", P[i].tolist(), strict=True)),
                    "orientation": dict(zip("xyzw", Q[i].tolist(), strict=True)),
                },
            }
            for i in range(4)
        ]),
        {},
    ),
    "lists.yaml": (
        "poses:\n"
        + "".join(f"  - {{image: {NAMES[i]}, t: {P[i].tolist()}, q: {WXYZ[i].tolist()}}}\n" for i in range(4)),
        {"quaternion": "wxyz"},
    ),
}  # fmt: skip


def test_names_of_matrices_and_stamps(tmp_path: Path) -> None:
    for name in ("ros.yaml", "euroc.csv", "tum.txt"):
        (tmp_path / name).write_text(TEXTS[name][0])
    assert read_poses(tmp_path / "ros.yaml").names[:2] == ("5", "1000000005")
    assert read_poses(tmp_path / "euroc.csv").names[1] == "1700000000000000001"
    assert read_poses(tmp_path / "tum.txt").places[1] == f"{tmp_path / 'tum.txt'}, line 3"


def test_a_file_an_image_and_an_index(tmp_path: Path) -> None:
    folder = tmp_path / "poses"
    folder.mkdir()
    for i, t in enumerate(T):
        keys = dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*t[:3, 3].tolist(), *Q[i].tolist()], strict=True))
        (folder / f"{i}.yaml").write_text("".join(f"{key}: {value}\n" for key, value in keys.items()))
    index = tmp_path / "cal_data.yaml"
    index.write_text("data:\n" + "".join(f"  - pose: poses/{i}.yaml\n    image: images/{i}.png\n" for i in (3, 1)))
    found = read_poses(folder)
    assert found.names == ("0.yaml", "1.yaml", "2.yaml", "3.yaml")
    np.testing.assert_allclose(found.T, T, atol=1e-12)
    of_index = read_poses(index)
    assert of_index.names == ("images/3.png", "images/1.png")
    np.testing.assert_allclose(of_index.T, T[[3, 1]], atol=1e-12)
    index.write_text("data:\n  - {pose: poses/9.yaml, image: images/9.png}\n")
    with pytest.raises(LogError, match=r"line 2: data\[0\]: there is no file .*9\.yaml"):
        read_poses(index)


@pytest.mark.parametrize(
    ("name", "text", "stated", "words"),
    [
        ("a.csv", lines("", NAMES, 1e3 * P, Q), {}, "millimetres. Write length: mm"),
        ("a.csv", lines("x,y,z,roll,pitch,yaw", P, ABOUT_XYZ), {}, "convention is not stated. .* euler: ZYX"),
        ("a.csv", lines("", P, DEGREES), {"euler": "ZYX"}, "angles without a unit"),
        ("a.csv", lines("", P, DEGREES), {"euler": "ZYX", "angles": "radians"}, "Are they degrees. Write angles"),
        ("a.csv", lines("", P, 2 * Q), {}, "line 1: quaternion .* norm 2"),
        ("a.csv", lines("", P, Q) + "1,2,3\n", {}, "line 5: 3 fields"),
        ("a.csv", lines("x,y,z,qx,qy,qz,qw", P, Q) + "1,2,x,4,5,6,7\n", {}, "line 6: 'x' is not a number"),
        ("a.csv", lines("", T.swapaxes(1, 2).reshape(4, 16)), {}, "line 1: .* is no transform.* transpose it"),
        ("a.csv", "", {}, "has no poses"),
        ("a.yaml", "a: {b: 3}", {}, "has no poses. A pose is"),
        ("a.yaml", "a: [", {}, "not YAML"),
    ],
)
def test_what_cannot_be_meant(tmp_path: Path, name: str, text: str, stated: dict[str, str], words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(LogError, match=words) as caught:
        read_poses(tmp_path / name, PoseStatement(**stated))
    assert name in str(caught.value)


@settings(max_examples=150, deadline=None)
@given(
    ending=st.sampled_from([".csv", ".yaml", ".json"]),
    content=tables(8, "a 1 2 3 0 0 0.6 0.8", " ").map(lambda text: text.encode(errors="surrogatepass"))
    | damaged([text.encode() for text, _ in TEXTS.values()]),
    stated=st.sampled_from([stated for _, stated in TEXTS.values()]),
)
def test_any_file_gives_poses_or_an_error_of_ours(
    tmp_path_factory: pytest.TempPathFactory, ending: str, content: bytes, stated: dict[str, Any]
) -> None:
    path = tmp_path_factory.getbasetemp() / f"any{ending}"
    path.write_bytes(content)
    try:
        found = read_poses(path, PoseStatement(**stated))
    except LogError as error:
        assert path.name in str(error)  # noqa: PT017
        assert len(str(error)) < 2000  # noqa: PT017
    else:
        R = found.T[:, :3, :3]
        assert np.isfinite(found.T).all()
        np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9)


def test_names_of_columns_and_a_stated_order_that_differ_are_refused(tmp_path: Path) -> None:
    """The order that a rig file states had no effect then, and the cure was to state the other one, and back again."""
    path = tmp_path / "a.csv"
    path.write_text("x,y,z,qx,qy,qz,qw\n0.1,0.2,0.3,0,0,0,1\n")
    assert read_poses(path, PoseStatement(quaternion="xyzw")).T[0, 0, 3] == 0.1
    with pytest.raises(LogError, match=r"a\.csv, line 1: .* Names count before a statement: leave quaternion out, or"):
        read_poses(path, PoseStatement(quaternion="wxyz"))


def test_names_of_columns_that_tell_no_pose_are_refused(tmp_path: Path) -> None:
    """An order that is guessed would give other poses."""
    (tmp_path / "imu0.csv").write_text(
        lines("timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z", range(4), P, P)
    )
    (tmp_path / "odd.csv").write_text(lines("u0,u1,u2,u3,u4,u5,u6", P, Q))
    with pytest.raises(LogError, match=r"imu0\.csv, line 1: .* Are they the rates and accelerations of an IMU"):
        read_poses(tmp_path / "imu0.csv")
    with pytest.raises(LogError, match=r"odd\.csv, line 1: .* tell no position with a rotation. Known names"):
        read_poses(tmp_path / "odd.csv")


@pytest.mark.parametrize("header", ["X,Y,Z,A,B,C", "px,py,pz,ox,oy,oz,ow", "X [mm],Y [mm],Z [mm],W,P,R"])
def test_names_of_robots(tmp_path: Path, header: str) -> None:
    if "A" in header:  # KUKA: about z, y, x
        text, stated = lines(header, P, DEGREES), {"euler": "ZYX", "angles": "degrees"}
    elif "W" in header:  # FANUC: about fixed x, y, z
        text, stated = lines(header, 1e3 * P, ABOUT_XYZ), {"euler": "xyz", "angles": "degrees"}
    else:
        text, stated = lines(header, P, Q), {}
    (tmp_path / "a.csv").write_text(text)
    np.testing.assert_allclose(read_poses(tmp_path / "a.csv", PoseStatement(**stated)).T, T, atol=1e-9)


def opencv(path: Path, poses: dict[str, np.ndarray]) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in poses.items():
        storage.write(name, np.ascontiguousarray(value))
    storage.release()


@pytest.mark.parametrize("ending", ["yaml", "xml", "json"])
def test_rotations_and_positions_apart(tmp_path: Path, ending: str) -> None:
    """As users of OpenCV's FileStorage write them; poses of the target beside them are passed over."""
    path, apart, whole, stacked = tmp_path / f"a.{ending}", {}, {}, {}
    for i in range(4):
        apart |= {f"R_gripper2base_{i}": T[i, :3, :3], f"t_gripper2base_{i}": T[i, :3, 3]}
        apart |= {f"R_target2cam_{i}": np.eye(3), f"t_target2cam_{i}": np.ones(3)}
        whole |= {f"T_gripper2base_{i}": T[i]}
    stacked = {"rvecs": TURNS.as_rotvec(), "tvecs": T[:, :3, 3]}
    for poses, names in ((apart, ("0", "1", "2", "3")), (whole, tuple(whole)), (stacked, ("",) * 4)):
        opencv(path, poses)
        found = read_poses(path)
        np.testing.assert_allclose(found.T, T, atol=1e-12)
        assert found.names == names
    opencv(path, {"rvecs": TURNS.as_rotvec(), "tvecs": T[:3, :3, 3]})
    with pytest.raises(LogError, match=r"rvecs.*: 4 rotations and 3 positions in tvecs"):
        read_poses(path)


def test_one_file_an_image_of_opencv(tmp_path: Path) -> None:
    for i in range(4):
        opencv(tmp_path / f"im_{i}.xml", {"R": T[i, :3, :3], "t": T[i, :3, 3]})
    found = read_poses(tmp_path)
    np.testing.assert_allclose(found.T, T, atol=1e-12)
    assert found.names == ("im_0.xml", "im_1.xml", "im_2.xml", "im_3.xml")


#: More forms that programs print: of each, the file and what is stated.
PRINTED = {
    "topic_echo.yaml": (
        "---\n".join(
            f"header:\n  stamp:\n    sec: 1700000000\n    nanosec: {i}\n  frame_id: base\npose:\n"
            f"  position: {dict(zip('xyz', P[i].tolist(), strict=True))}\n"
            f"  orientation: {dict(zip('xyzw', Q[i].tolist(), strict=True))}\n"
            for i in range(4)
        )
        + "---\n",
        {},
    ),
    "robot.json": (
        json.dumps([
            {"joints": [0.1] * 7, "tcp_pose": [*P[i].tolist(), *TURNS[i].as_rotvec().tolist()]} for i in range(4)
        ]),
        {"euler": "rotation_vector", "angles": "radians"},
    ),
    "sevens.json": (json.dumps({"poses": np.hstack([P, Q]).tolist()}), {}),
    "words.yaml": (
        json.dumps([
            {"rotation_matrix": T[i, :3, :3].tolist(), "translation_vector": P[i].tolist()} for i in range(4)
        ]),
        {},
    ),
    "two_parts.csv": (
        lines("secs,nsecs,x,y,z,qx,qy,qz,qw", [1700000000] * 4, range(4), P, Q),
        {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(TEXTS | PRINTED))
def test_each_form_gives_the_same_poses(tmp_path: Path, name: str) -> None:
    text, stated = (TEXTS | PRINTED)[name]
    (tmp_path / name).write_text(text)
    found = read_poses(tmp_path / name, PoseStatement(**stated))
    np.testing.assert_allclose(found.T, T, atol=1e-9)
    if name in TEXTS and "im_0" in text:
        assert list(found.names) == NAMES
    if name in ("topic_echo.yaml", "two_parts.csv"):
        assert found.names == tuple(str(1_700_000_000 * 10**9 + i) for i in range(4))
    if name == "topic_echo.yaml":
        assert found.places[1] == f"{tmp_path / name}, line 15: [1].pose"


def test_how_long_a_tree_of_poses_may_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Longer than a file that a person writes, but not without a limit."""
    assert pose_trees.MOST_VALUES > 3 * yaml_lines.MOST_VALUES
    monkeypatch.setattr(pose_trees, "MOST_VALUES", 30)
    for name in ("ros.yaml", "robot.json"):
        (tmp_path / name).write_text(dict(TEXTS | PRINTED)[name][0])
        with pytest.raises(LogError, match=r"more than 30 keys and values"):
            read_poses(tmp_path / name)
