"""Folders as other tools lay them out, each read by one command with a short rig file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from given_commands import given
from intrinsics_samples import CAMCHAIN, ROS
from rwhec_factors import se3
from scipy.spatial.transform import Rotation
from typer.testing import Result

import gtsam_rwhec as rw
from gtsam_rwhec.errors import LogWarning
from gtsam_rwhec.logs import ImageRecord, PoseRecord, open_log
from gtsam_rwhec.rig import read_rig
from gtsam_rwhec.runs.sensor_intrinsics import read_intrinsics

COUNT = 4
RNG = np.random.default_rng(11)
TURNS = Rotation.random(COUNT, rng=RNG)
T = se3.pose(TURNS.as_matrix(), RNG.uniform(-1.0, 1.0, (COUNT, 3)))
Q = TURNS.as_quat()
_, PNG = cv2.imencode(".png", np.zeros((4, 6), dtype=np.uint8))
NS = [1_700_000_000_000_000_000 + i * 500_000_000 for i in range(COUNT)]
RIG = """\
carriers: {{sensors: {carriers}, poses: {{frames: [base, hand]{stated}}}}}
sensors:
{sensors}
targets:
  board: {{type: checkerboard, inner_corners: [5, 4], square_m: 0.03}}
"""
NUMBERS = "{K: [500, 500, 320, 240], size: [640, 480]}"


def images(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for name in names:
        (folder / name).write_bytes(PNG.tobytes())


def rig_text(*sensors: str, carriers: str = "hand, targets: base", stated: str = "") -> str:
    return RIG.format(carriers=carriers, stated=stated, sensors="\n".join(f"  {each}" for each in sensors))


def storage(path: Path, values: dict[str, object]) -> None:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        file.write(key, value)
    file.release()


def workcell(folder: Path) -> str:
    """Several fixed cameras side by side, each with its own images and poses of the hand."""
    for camera in ("camera1", "camera2"):
        images(folder / camera / "image", [f"{i:04d}.png" for i in range(COUNT)])
        (folder / camera / "pose").mkdir()
        for i in range(COUNT):
            np.savetxt(folder / camera / "pose" / f"{i:04d}.csv", T[i], delimiter=",")
        (folder / camera / "intrinsic_pars_file.yaml").write_text(
            "img_width: 640\nimg_height: 480\nfx: 500\nfy: 500\ncx: 320\ncy: 240\nhas_dist_coeff: 1\n"
            "dist_k0: 0.1\ndist_k1: 0\ndist_k2: 0\ndist_px: 0\ndist_py: 0\n"
        )
    sensor = (
        "camera{0}: {{images: camera{0}/image, poses: camera{0}/pose, intrinsics: camera{0}/intrinsic_pars_file.yaml}}"
    )
    return rig_text(sensor.format(1), sensor.format(2), carriers="base, targets: hand")


def industrial_calibration(folder: Path) -> str:
    """ROS-Industrial's ``cal_data.yaml``, with a pose file an image; the poses in it are first guesses."""
    images(folder / "images", [f"{i}.png" for i in range(COUNT)])
    (folder / "poses").mkdir()
    for i in range(COUNT):
        keys = dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*T[i, :3, 3].tolist(), *Q[i].tolist()], strict=True))
        (folder / "poses" / f"{i}.yaml").write_text("".join(f"{key}: {value!r}\n" for key, value in keys.items()))
    entries = "".join(f"  - pose: poses/{i}.yaml\n    image: images/{i}.png\n" for i in (2, 0, 1, 3))
    guess = "x: 0\n  y: 0\n  z: 0\n  qx: 0\n  qy: 0\n  qz: 0\n  qw: 1\n"
    (folder / "cal_data.yaml").write_text(f"data:\n{entries}target_guess:\n  {guess}camera_guess:\n  {guess}")
    return rig_text(f"camera: {{images: images, poses: cal_data.yaml, intrinsics: {NUMBERS}}}")


def kalibr(folder: Path) -> str:
    """Kalibr's folder of two cameras, names of images in nanoseconds; poses of a tracker beside them."""
    for camera in ("cam0", "cam1"):
        images(folder / camera, [f"{stamp}.png" for stamp in NS])
    (folder / "imu0.csv").write_text("timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z\n")
    lines = [
        " ".join([f"{stamp // 10**9}.{stamp % 10**9:09d}", *map(repr, [*t[:3, 3].tolist(), *q.tolist()])])
        for stamp, t, q in zip(NS, T, Q, strict=True)
    ]
    (folder / "poses.tum").write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", *lines]) + "\n")
    (folder / "camchain.yaml").write_text(CAMCHAIN)
    sensor = "{0}: {{images: {0}, poses: poses.tum, intrinsics: camchain.yaml}}"
    return rig_text(sensor.format("cam0"), sensor.format("cam1"))


def opencv_one_file(folder: Path) -> str:
    """Rotations and positions for calibrateHandEye in one FileStorage, and its calibration in another."""
    images(folder / "images", [f"img_{i}.jpg" for i in range(COUNT)])
    apart = {}
    for i in range(COUNT):
        apart |= {f"R_gripper2base_{i}": np.ascontiguousarray(T[i, :3, :3])}
        apart |= {f"t_gripper2base_{i}": np.ascontiguousarray(T[i, :3, 3:])}
    storage(folder / "poses.xml", apart)
    camera = {"camera_matrix": np.diag([500.0, 500.0, 1.0]), "distortion_coefficients": np.zeros((1, 5))}
    camera["camera_matrix"][:2, 2] = 320, 240
    storage(folder / "camera.json", {"image_width": 640, "image_height": 480, **camera})
    return rig_text("camera: {images: images, poses: poses.xml, intrinsics: camera.json}")


def opencv_one_an_image(folder: Path) -> str:
    """A FileStorage an image with a 4 x 4 matrix, millimetres."""
    images(folder / "images", [f"{i}.png" for i in range(COUNT)])
    (folder / "poses").mkdir()
    for i in range(COUNT):
        T_mm = T[i].copy()
        T_mm[:3, 3] *= 1e3
        storage(folder / "poses" / f"{i}.yml", {"T_gripper2base": T_mm})
    sensor = "camera: {images: images, poses: poses, intrinsics: {file: stereo.yml, camera: '2', size: [640, 480]}}"
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    storage(
        folder / "stereo.yml",
        {"M1": K + np.diag([9.0, 9.0, 0.0]), "D1": np.zeros((1, 5)), "M2": K, "D2": np.zeros((1, 5))},
    )
    return rig_text(sensor, stated=", length: mm")


def robot_angles(folder: Path) -> str:
    """A robot's own table: millimetres, and yaw, pitch and roll in degrees."""
    images(folder / "images", [f"shot{i}.png" for i in range(COUNT)])
    angles = TURNS.as_euler("ZYX", degrees=True)
    rows = ["image;X [mm];Y [mm];Z [mm];A;B;C"]
    rows += [
        f"shot{i};" + ";".join(map(repr, [*(1e3 * T[i, :3, 3]).tolist(), *angles[i].tolist()])) for i in range(COUNT)
    ]
    (folder / "robot.csv").write_text("\n".join(rows))
    (folder / "ost.yaml").write_text(ROS)
    sensor = "camera: {images: images, poses: robot.csv, intrinsics: ost.yaml}"
    return rig_text(sensor, stated=", euler: ZYX, angles: degrees")


def colmap_and_json(folder: Path) -> str:
    """COLMAP's cameras.txt, and poses in JSON by the names of images."""
    images(folder / "images", [f"{i}.png" for i in range(COUNT)])
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": T[i].tolist()} for i in range(COUNT)]
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    (folder / "cameras.txt").write_text("# Camera list\n1 PINHOLE 640 480 500 500 320.5 240.5\n")
    return rig_text("camera: {images: images, poses: transforms.json, intrinsics: cameras.txt}")


LAYOUTS: dict[str, tuple[Callable[[Path], str], int, float]] = {
    "workcell": (workcell, 2, 500.0),
    "industrial_calibration": (industrial_calibration, 1, 500.0),
    "kalibr": (kalibr, 2, 458.6),
    "opencv_one_file": (opencv_one_file, 1, 500.0),
    "opencv_one_an_image": (opencv_one_an_image, 1, 500.0),
    "robot_angles": (robot_angles, 1, 430.2),
    "colmap_and_json": (colmap_and_json, 1, 500.0),
}


def convert(folder: Path, layout: str, log: Path) -> Result:
    """The one command, on a folder with such a layout."""
    folder.mkdir()
    (folder / "rig.yaml").write_text(LAYOUTS[layout][0](folder))
    return given("convert", folder, "--rig", folder / "rig.yaml", "-o", log)


@pytest.mark.parametrize("layout", sorted(LAYOUTS))
def test_each_layout_is_read_by_one_command(tmp_path: Path, layout: str) -> None:
    _, cameras, fx = LAYOUTS[layout]
    folder = tmp_path / "cell"
    done = convert(folder, layout, tmp_path / "log.mcap")
    assert done.exit_code == 0, done.output
    rig = read_rig(folder / "rig.yaml")
    with open_log(tmp_path / "log.mcap") as log:
        records = list(log.records())
        found = read_intrinsics(log, rig)
    poses = {record.stamp_ns: record.T for record in records if isinstance(record, PoseRecord)}
    for sensor in rig.sensors.values():
        stamps = [r.stamp_ns for r in records if isinstance(r, ImageRecord) and r.topic == sensor.images]
        np.testing.assert_allclose([poses[stamp] for stamp in stamps], T, atol=1e-9)
    assert len(found) == cameras
    assert next(iter(found.values())).K[0, 0] == fx


#: Layouts whose files or rig files do not say the unit of lengths, and where their poses are.
WITHOUT_UNIT = {
    "workcell": ("camera1/pose/", "camera1"), "industrial_calibration": ("poses/", "camera"),
    "kalibr": ("poses.tum, line", "cam0"), "opencv_one_file": ("poses.xml, line", "camera"),
    "colmap_and_json": ("transforms.json, line", "camera"),
}  # fmt: skip


def said(done: Result) -> str:
    return " ".join(done.output.split())


@pytest.mark.parametrize("layout", sorted(WITHOUT_UNIT))
def test_millimetres_are_found_when_poses_are_read(
    tmp_path: Path, layout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_mm = T.copy()
    in_mm[:, :3, 3] *= 1e3
    monkeypatch.setitem(globals(), "T", in_mm)
    done = convert(tmp_path / "cell", layout, tmp_path / "log.mcap")
    assert done.exit_code != 0
    assert "Are they millimetres? Write length: mm" in said(done)
    file, sensor = WITHOUT_UNIT[layout]
    assert file in said(done)
    assert f"line 3: sensors.{sensor}.poses" in said(done)
    assert not (tmp_path / "log.mcap").exists()


@pytest.mark.parametrize("layout", ["industrial_calibration", "kalibr"])
def test_quaternions_of_another_norm_are_found(tmp_path: Path, layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "Q", 1.1 * Q)
    done = convert(tmp_path / "cell", layout, tmp_path / "log.mcap")
    assert done.exit_code != 0
    assert "has norm 1.1 in place of 1" in said(done)


@pytest.mark.parametrize(
    ("layout", "missing", "words"),
    [
        ("workcell", "camera2/image", "camera2/image: there is no such folder of images (", ),
        ("kalibr", "cam1", "there is no such folder of images; {folder} has images in cam0 ("),
        ("kalibr", "poses.tum", "poses.tum cannot be read: No such file or directory. ("),
        ("industrial_calibration", "poses", "line 2: data[0]: there is no file {folder}/poses/2.yaml ("),
    ],
)  # fmt: skip
def test_what_is_missing_is_named_with_its_line(tmp_path: Path, layout: str, missing: str, words: str) -> None:
    folder = tmp_path / "cell"
    write = LAYOUTS[layout][0]
    folder.mkdir()
    (folder / "rig.yaml").write_text(write(folder))
    (folder / missing).rename(tmp_path / "elsewhere")
    done = given("convert", folder, "--rig", folder / "rig.yaml", "-o", tmp_path / "log.mcap")
    assert done.exit_code != 0
    assert words.format(folder=folder) in said(done)
    assert "rig.yaml, line" in said(done)
    assert not (tmp_path / "log.mcap").exists()


def test_other_files_beside_poses_are_passed_over_and_said(tmp_path: Path) -> None:
    folder = tmp_path / "cell"
    folder.mkdir()
    (folder / "rig.yaml").write_text(workcell(folder))
    (folder / "camera1" / "pose" / "README.txt").write_text("poses of the hand")
    with pytest.warns(
        LogWarning, match=r"camera1/pose: poses are read from the 4 files \.csv, and not from README\.txt"
    ):
        rw.runs.write_folder_log(folder, read_rig(folder / "rig.yaml"), tmp_path / "log.mcap")
