"""The wheel that users install: the demo works from it, far away from any checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import gtsam
import numpy as np
import pytest
from places import REPOSITORY

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.intrinsics_files import read_cameras

CELL = REPOSITORY / "data" / "cell"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both sdists, and the wheels that are built of the sdists, not of the checkout."""
    folder = tmp_path_factory.mktemp("built")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder)]
    both = [subprocess.Popen([*command, str(source)]) for source in (REPOSITORY, REPOSITORY / "factors")]
    assert [process.wait() for process in both] == [0, 0]
    return folder


@pytest.fixture(scope="module")
def unpacked_wheel(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both wheels as pip would unpack them."""
    unpacked = tmp_path_factory.mktemp("site-packages")
    for wheel in built.glob("*.whl"):
        zipfile.ZipFile(wheel).extractall(unpacked)
    return unpacked


def test_one_wheel_for_all_systems_and_a_package_index_takes_it(built: Path) -> None:
    stems = [f"{name}-{version('gtsam-rwhec')}" for name in ("gtsam_rwhec", "rwhec_factors")]
    files = [str(built / f"{stem}{end}") for stem in stems for end in ("-py3-none-any.whl", ".tar.gz")]
    done = subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *files], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_file_is_in_both_wheels(built: Path) -> None:
    ours, factors = (set(zipfile.ZipFile(wheel).namelist()) for wheel in sorted(built.glob("*.whl")))
    assert not ours & factors
    assert {Path(name).parts[0] for name in factors} == {
        "rwhec_factors",
        f"rwhec_factors-{version('gtsam-rwhec')}.dist-info",
    }


def test_it_has_all_data_and_none_of_the_real_dataset(unpacked_wheel: Path) -> None:
    shipped = unpacked_wheel / "gtsam_rwhec" / "demo_data"
    assert sorted(path.name for path in shipped.iterdir()) == ["rig.yaml", "robot_cell.mcap", "truth.json"]
    for path in shipped.iterdir():
        assert path.read_bytes() == (CELL / path.name).read_bytes()
    assert (unpacked_wheel / "gtsam_rwhec" / "utias_files.txt").is_file()
    assert (unpacked_wheel / "gtsam_rwhec" / "py.typed").is_file()
    assert not list(unpacked_wheel.rglob("*.csv"))


def test_the_demo_runs_from_it_without_what_clouds_need_and_meets_the_truth(
    unpacked_wheel: Path, tmp_path: Path
) -> None:
    missing = tmp_path / "missing"
    missing.mkdir()
    for package in ("small_gicp", "lzf"):
        words = f"raise ModuleNotFoundError('{package} is not installed', name='{package}')"
        (missing / f"{package}.py").write_text(words, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "gtsam_rwhec", "demo"],
        capture_output=True,
        text=True,
        encoding="utf-8",
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{missing}{os.pathsep}{unpacked_wheel}", "PYTHONIOENCODING": "utf-8"},
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    log = unpacked_wheel / "gtsam_rwhec" / "demo_data" / "robot_cell.mcap"
    assert f"This is the same as: gtsam-rwhec calibrate {log} --rig {log.parent / 'rig.yaml'} -o " in done.stderr
    assert done.stdout.startswith("Use these poses with care: the stated size of board is 2.5 % too large ")
    calibrated, of_demo = done.stdout.split("Errors that we put into this log", 1)
    for words in ("How far off a point is", "Sensors in the frame hand", "Time offset of cam_wide: ", "--verbose."):
        assert words in calibrated
    assert "Found: 8 of 25 detections of this tag by cam_left were left out." in of_demo
    assert lines_on_a_terminal(calibrated + done.stderr.splitlines()[-1]) <= 40
    assert lines_on_a_terminal(done.stdout) <= 70
    out = tmp_path / "gtsam-rwhec-demo"
    files = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert files == {
        "calibration.mcap", "result.json", "static_tf.launch.py", "tf.yaml", "rig.urdf.xacro", "camchain.yaml",
        ".written.json", "seen.png", "cameras.opencv.yaml", "cameras.txt",
        "report.html", "evidence.json",
        "camera_info/cam_left.yaml", "camera_info/cam_wide.yaml",
    }  # fmt: skip
    check_against_truth(out)
    check_cameras(out)


def lines_on_a_terminal(text: str, width: int = 80) -> int:
    """Lines on a terminal that wraps."""
    return sum(max(1, -(-len(line) // width)) for line in text.splitlines())


def check_against_truth(out: Path) -> None:
    """Poses within 1 mm and 0.1 degrees and in their ellipsoids, clocks within 2 ms, the board's size within 0.2 %."""
    truth = json.loads((CELL / "truth.json").read_text(encoding="utf-8"))
    refined = rw.read_refined(out / "result.json")
    assert rw.read_solution(out / "result.json").certificate.is_certified
    for name, T in (truth["T_hand_camera"] | truth["T_base_target"]).items():
        off = gtsam.Pose3(np.array(T)).between((refined.X | refined.Y)[name])
        assert 1e3 * np.linalg.norm(off.translation()) < 1.0, name
        assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(off.rotation()))) < 0.1, name
        assert refined.contains(name, np.array(T), 0.95), name
    for sensor, offset_s in truth["time_offset_s"].items():
        sigma_s = np.sqrt(refined.covariance(f"time_offset:{sensor}")[0, 0])
        assert abs(refined.time_offsets_s[sensor] - offset_s) < min(0.002, 4.0 * sigma_s)
    assert isinstance(refined.scale, dict)
    assert refined.scale["board"] == pytest.approx(truth["scale"]["board"], rel=0.002)
    # JSON for people: what was removed, and why.
    said = json.loads((out / "result.json").read_text(encoding="utf-8"))["log"]
    twice = [track["removed"] for track in said["detection"]["tracks"] if track["target"] == "tag_2"]
    assert {"seen twice in one image": 6} in twice
    assert [size["target"] for size in said["sizes"] if size["is_free"]] == ["board"]


def check_cameras(out: Path) -> None:
    """The images were made with what the log states; files for other programs have what was estimated."""
    refined = rw.read_refined(out / "result.json")
    exported = read_cameras(out / "cameras.opencv.yaml")
    assert list(exported) == list(refined.intrinsics) == ["cam_left", "cam_wide"]
    for sensor, intrinsics in refined.intrinsics.items():
        off = np.array(intrinsics.values) - intrinsics.stated
        assert (np.abs(off) < 4.0 * np.array(intrinsics.standard_deviations)).all(), sensor
        (of_ros,) = read_cameras(out / "camera_info" / f"{sensor}.yaml").values()
        for camera in (exported[sensor], of_ros):
            assert (camera.K.tolist(), camera.D.tolist()) == (
                intrinsics.camera.K.tolist(),
                intrinsics.camera.D.tolist(),
            )
