"""Folders and logs of clouds by the command: from a folder with a table of poses to a calibration."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from given_commands import given
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.clouds import seen_object
from gtsam_rwhec.clouds.named_fields import cloud_of_depth
from gtsam_rwhec.errors import CloudError
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.rig.cloud_proposal import propose_cloud_rig
from gtsam_rwhec.rig.folder_contents import cloud_folders
from gtsam_rwhec.runs import cloud_detections
from gtsam_rwhec.runs.measured_pairs import problem_of, read_pairs
from gtsam_rwhec.simulate.simulated_clouds import SimulatedClouds, clouds_of_thing

pytestmark = pytest.mark.usefixtures("without_figures")  # but the module's own run has them

VIEWS = 8
RIG = """\
carriers:
  sensors: flange
  targets: base
  poses: {frames: [base, flange], euler: xyz, angles: degrees, length: mm}
sensors:
  camera: {clouds: clouds, poses: poses.txt}
targets:
  thing: {type: object}
"""


def run(*arguments: object, status: int | tuple[int, ...] = (0, 1)) -> str:
    """What a user reads, of a command that ends with this status."""
    done = given(*arguments)
    wanted = (status,) if isinstance(status, int) else status
    assert done.exit_code in wanted, done.stderr
    return str(done.stdout + done.stderr)


def write_poses(A: np.ndarray, path: Path) -> None:
    """T_base_flange as a controller writes it: x, y, z in millimetres, rx, ry, rz in degrees, a comma at the end."""
    T = se3.inverse(A)
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=True)
    rows = np.column_stack([1e3 * T[:, :3, 3], angles])
    path.write_text("".join(",".join(f"{number:.5f}" for number in row) + ",\n" for row in rows), encoding="utf-8")


@pytest.fixture(scope="module")
def made() -> SimulatedClouds:
    return clouds_of_thing("bust", VIEWS, 3)


@pytest.fixture(scope="module")
def folder(made: SimulatedClouds, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clouds 3 to 10: the tenth comes last, though its name sorts before."""
    folder = tmp_path_factory.mktemp("cell")
    (folder / "clouds").mkdir()
    for number, cloud in enumerate(made.clouds, start=3):
        np.save(folder / "clouds" / f"view{number}.npy", cloud.points.astype(np.float32))
    write_poses(made.A, folder / "poses.txt")
    (folder / "rig.yaml").write_text(RIG, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def out(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "out"
    run("calibrate", folder, "--rig", folder / "rig.yaml", "-o", out)
    return out


def sensor(out: Path) -> np.ndarray:
    """T_sensorcarrier_sensor of the one sensor."""
    (row,) = json.loads((out / "result.json").read_text(encoding="utf-8"))["sensors"]
    return se3.pose(row["rotation_matrix"], row["translation_m"])


def off(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Degrees and millimetres."""
    xi = se3.logmap((se3.inverse(truth) @ T)[None])[0]
    return float(np.degrees(np.linalg.norm(xi[:3]))), 1e3 * float(np.linalg.norm(xi[3:]))


def test_a_folder_of_clouds_gives_the_truth(out: Path, made: SimulatedClouds) -> None:
    degrees, mm = off(sensor(out), made.T_sensorcarrier_sensor)
    assert degrees < 0.05
    assert mm < 0.3
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert result["certified"]["certificate"]["status"] == "certified"
    assert result["verdict"] != "do_not_use"
    (seen,) = result["log"]["detection"]["objects"]
    assert (seen["used"], seen["views"]) == (VIEWS, VIEWS)
    assert {pair["first"] for pair in seen["registrations"]} <= {f"clouds/view{n}.npy" for n in range(3, 11)}
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "The clouds in one frame" in page
    assert "Registrations of the clouds of camera" in page
    assert "view10.npy" in page
    assert not (out / "detections.jsonl").exists()


def test_how_poses_are_read_is_found_and_no_rig_file_is_needed(
    folder: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone, said = tmp_path / "alone", list[str]()
    shutil.copytree(folder, alone)
    (alone / "rig.yaml").unlink()
    monkeypatch.setattr(cloud_detections, "seen_object", None)  # what let the clouds agree is not registered again
    rw.calibrate_log(alone, None, tmp_path / "out", progress=said.append)
    assert any("angles xyz in degrees, mm, the sensor on flange, lets the clouds agree" in words for words in said)
    np.testing.assert_allclose(sensor(tmp_path / "out"), sensor(out), atol=1e-9)


@pytest.fixture(scope="module")
def log(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    said = run("convert", folder, "--rig", folder / "rig.yaml", "-o", path, status=0)
    assert f"{VIEWS} clouds and {VIEWS} poses" in said
    return path


def test_init_writes_a_rig_file_for_clouds_of_a_log(log: Path, tmp_path: Path) -> None:
    said = run("init", log, "-o", tmp_path / "rig.yaml", status=0)
    assert "clouds in clouds" in said
    rig = rw.rig.read_rig(tmp_path / "rig.yaml")
    assert (rig.carriers.sensors, rig.carriers.targets) == ("flange", "base")
    (section,) = rig.sensors.values()
    assert section.clouds == "clouds"
    assert rig.object == "object"
    text = (tmp_path / "rig.yaml").read_text(encoding="utf-8")
    assert "misfit of the clouds with the sensor" in text


def test_another_frame_of_the_thing_is_no_change(out: Path, made: SimulatedClouds) -> None:
    old = rw.results.read_result(out / "result.json")
    elsewhere = {"thing": gtsam.Pose3(old.refined.X["thing"].matrix() @ se3.pose(np.eye(3), [0.3, 0.0, 0.0]))}
    found = rw.results.difference(old, replace(old, refined=replace(old.refined, X=elsewhere)))
    assert set(found.movements) == {"camera"}
    assert "clouds" in found.not_compared["thing"]
    problem = rw.Problem()
    seen_object([replace(c, points=c.points[::2]) for c in made.clouds], made.A).add_to(problem, "thing", "camera")
    again = rw.results.verify(old, problem)
    assert again.holds
    assert set(again.movements) == {"camera"}


def test_clouds_keep_their_weights_where_the_rig_file_states_noise(out: Path) -> None:
    rig = rw.rig.parse_rig(RIG + "noise: {rotation_deg: 0.1, translation_mm: 1.0}\n", "rig.yaml")
    with rw.logs.open_log(out / "calibration.mcap") as kept:
        pairs = read_pairs(kept, rig)
    assert problem_of(pairs, rig, {"camera": 0.0}).directed == frozenset(pairs)


@pytest.mark.slow
def test_a_log_of_the_folder_and_its_stages_give_the_same_to_the_last_bit(log: Path, out: Path, tmp_path: Path) -> None:
    text = re.sub(r"poses: \{.*\}", "poses: {tf: [base, flange]}", RIG).replace(", poses: poses.txt", "")
    (tmp_path / "log.yaml").write_text(text, encoding="utf-8")
    run("calibrate", log, "--rig", tmp_path / "log.yaml", "-o", tmp_path / "out", "--images")
    np.testing.assert_array_equal(sensor(tmp_path / "out"), sensor(out))
    run("detect", log, "--rig", tmp_path / "log.yaml", "-o", tmp_path / "detected.mcap", status=0)
    run("clean", tmp_path / "detected.mcap", "-o", tmp_path / "clean.mcap", status=0)
    run("solve", tmp_path / "clean.mcap", "-o", tmp_path / "solved")
    np.testing.assert_array_equal(sensor(tmp_path / "solved"), sensor(out))
    run("diff", out, tmp_path / "out", status=0)
    run("verify", out, log, status=0)
    # Raw clouds are copied on request; what is registered is kept in any case.
    kept = {
        name: {topic.name for topic in rw.logs.open_log(path / "calibration.mcap").topics()}
        for name, path in {"copied": tmp_path / "out", "linked": out}.items()
    }
    assert "clouds" in kept["copied"]
    assert "clouds" not in kept["linked"]
    assert all("/calibration/camera/clouds" in topics for topics in kept.values())


def test_an_interrupted_run_does_not_register_again(
    folder: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, calls = rw.rig.read_rig(folder / "rig.yaml"), []
    register = cloud_detections.seen_object

    def counted(*given: Any) -> Any:
        calls.append(1)
        return register(*given)

    monkeypatch.setattr(cloud_detections, "seen_object", counted)

    def interrupted(stage: str) -> None:
        if "reading the carriers" in stage and calls:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rw.calibrate_log(folder, rig, tmp_path / "out", progress=interrupted)
    rw.calibrate_log(folder, rig, tmp_path / "out", replace=False)
    assert len(calls) == 1
    np.testing.assert_array_equal(sensor(tmp_path / "out"), sensor(out))


def test_bad_clouds_are_named_and_the_others_used(folder: Path, made: SimulatedClouds, tmp_path: Path) -> None:
    bad = tmp_path / "bad"
    shutil.copytree(folder, bad)
    (bad / "clouds" / "view4.npy").write_bytes(b"")
    np.save(bad / "clouds" / "view6.npy", np.full((100, 3), np.nan))
    np.save(bad / "clouds" / "view9.npy", np.zeros((10**6, 3), np.float32))
    (bad / "clouds" / "view0.npy").write_bytes((folder / "clouds" / "view3.npy").read_bytes()[:200])  # the first is cut
    assert [each.path for each in cloud_folders(bad)] == ["clouds"]
    (bad / "clouds" / "view0.npy").unlink()
    said = run("calibrate", bad, "--rig", bad / "rig.yaml", "-o", tmp_path / "out")
    assert "view4.npy is empty" in said
    assert "view6.npy: of 100 points none is seen" in said
    assert "view9.npy: of 1000000 points none is seen" in said
    assert said.count("It counts as a cloud that cannot be used") == 3  # each once
    degrees, mm = off(sensor(tmp_path / "out"), made.T_sensorcarrier_sensor)
    assert degrees < 0.1
    assert mm < 0.6


def test_a_folder_of_clouds_by_a_wrong_focal_length_is_named(folder: Path, tmp_path: Path) -> None:
    wide = tmp_path / "wide"
    shutil.copytree(folder, wide)
    for path in (wide / "clouds").iterdir():
        np.save(path, np.load(path) * np.float32([1.01, 1.01, 1.0]))
    said = run("calibrate", wide, "--rig", wide / "rig.yaml", "-o", tmp_path / "out", status=0)
    assert "% longer across its z axis than along it" in " ".join(said.split())


def test_depth_images_that_show_nothing_are_named_by_topic_and_stamp() -> None:
    dark = rw.logs.ImageRecord(5, 7, "/depth", "camera", "16UC1", bytes(24), width=4, height=3, step=8)
    log: Any = SimpleNamespace(records=lambda topics: [dark])
    camera = rw.Camera.of(4, 3, "pinhole", np.diag([4.0, 4.0, 1.0]), np.zeros(0), "camera")
    ((_, error),) = cloud_detections._Source(log, "/depth", camera, None, {}).each()
    assert str(error).startswith("topic /depth, image at 7 ns: of 12 points none is seen")
    other = rw.Camera.of(8, 6, "pinhole", np.diag([4.0, 4.0, 1.0]), np.zeros(0), "camera")
    with pytest.raises(CloudError, match=r"^depth/3\.png: 4 x 3 pixels, but the intrinsics are for 8 x 6"):
        cloud_of_depth(dark, other, source="depth/3.png")  # an image of a folder has a name


@pytest.mark.parametrize(
    ("times", "words"),
    [
        pytest.param(
            1000.0,
            r"like mm beside m: multiply all points, or unit_m of the rig file, by 0\.001",
            marks=pytest.mark.slow,
        ),
        (0.0, r"none of the 8 clouds of camera can be used; the first: .*view3\.npy"),
    ],
)
def test_what_is_wrong_with_all_is_named(folder: Path, tmp_path: Path, times: float, words: str) -> None:
    """What else is wrong with poses is named by `seen_object`, and tested there."""
    bad = tmp_path / "bad"
    shutil.copytree(folder, bad)
    for path in (bad / "clouds").iterdir():
        np.save(path, np.load(path) * times)
    said = run("calibrate", bad, "--rig", bad / "rig.yaml", "-o", tmp_path / "out", status=(1, 2))
    assert re.search(words, said), said


def real_clouds(shared_data: Path, name: str) -> Path:
    source = shared_data / "clouds" / name
    if not source.is_dir():
        pytest.skip(f"no {source}; GTSAM_RWHEC_DATA names the folder of data sets")
    return source


def test_init_finds_how_real_poses_are_read(shared_data: Path, tmp_path: Path) -> None:
    run("init", real_clouds(shared_data, "David"), "-o", tmp_path / "rig.yaml", status=0)
    poses = rw.rig.read_rig(tmp_path / "rig.yaml").carriers.poses
    assert (poses.euler, poses.angles, poses.length) == ("xyz", "radians", "mm")
    assert poses.columns == ("rx", "ry", "rz", "tx", "ty", "tz")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("thing", "off_m", "status"), [("Plane", 0.0015, "certified"), ("Sphere", 0.01, "certified_not_unique")]
)
def test_a_real_thing_by_one_command(thing: str, off_m: float, status: str, shared_data: Path, tmp_path: Path) -> None:
    """That things give one answer is tested where they are registered."""
    said = run("calibrate", real_clouds(shared_data, thing), "-o", tmp_path / "out")
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert result["certified"]["certificate"]["status"] == status
    assert result["verdict"] != "do_not_use"
    # Eight things of this cell agreed within 1.5 mm, by another road (motions of pairs, and no joint registration).
    assert np.abs(sensor(tmp_path / "out")[:3, 3] - [0.0711, -0.0352, 0.0598]).max() < off_m
    assert ("The sensors' poses do not need them" in " ".join(said.split())) == (thing == "Sphere")


def write_depths(made: SimulatedClouds, views: int, focal: float, unit_m: float, folder: Path) -> None:
    """Depth images of 16 bits, and poses beside them."""
    (folder / "depth").mkdir()
    size = round(2.0 * focal / 3.0)
    for number, cloud in enumerate(made.clouds[:views]):
        x, y, z = cloud.points.T
        u, v = (np.rint(focal * axis / z + (size - 1) / 2.0).astype(int) for axis in (x, y))
        image = np.zeros((size, size), np.uint16)
        image[v, u] = np.rint(z / unit_m)
        cv2.imwrite(str(folder / "depth" / f"{number}.png"), image)
    write_poses(made.A[:views], folder / "poses.txt")


def test_a_folder_of_depth_images_is_a_folder_of_clouds(made: SimulatedClouds, tmp_path: Path) -> None:
    """calibrate said that images need a rig file, which init writes; and init that there are no images."""
    write_depths(made, 4, 120.0, 0.001, tmp_path)
    centre = {"rows": 3, "cols": 3, "data": [120.0, 0.0, 39.5, 0.0, 120.0, 39.5, 0.0, 0.0, 1.0]}
    lens = {"distortion_model": "plumb_bob", "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5}}
    intrinsics = {"image_width": 80, "image_height": 80, "camera_matrix": centre, **lens}
    (tmp_path / "depth.yaml").write_text(json.dumps(intrinsics), encoding="utf-8")
    found = propose_cloud_rig(tmp_path, cloud_folders(tmp_path), silent)
    assert "4 depth images in depth, poses in poses.txt, intrinsics in depth.yaml" in found.notes[0]
    assert not rw.rig.todo_lines(found.text)
    assert found.registered is not None
    degrees, mm = off(found.registered.T_sensorcarrier_sensor, made.T_sensorcarrier_sensor)
    assert degrees < 1.0  # pixels are 3 mm wide
    assert mm < 5.0
    for file in map(str, (tmp_path / "depth").iterdir()):  # in tenths of a millimetre
        cv2.imwrite(file, 10 * cv2.imread(file, cv2.IMREAD_UNCHANGED))
    found = propose_cloud_rig(tmp_path, cloud_folders(tmp_path), silent)
    assert "images are 10 times those of the poses, like 0.1 mm beside mm: multiply unit_m by 0.1" in found.notes[-1]


def test_poses_of_other_clouds_are_named_before_how_they_are_read(
    folder: Path, made: SimulatedClouds, tmp_path: Path
) -> None:
    """Of poses that were shifted by a row, the first words were of angles."""
    shutil.copytree(folder / "clouds", tmp_path / "clouds")
    T = se3.inverse(np.r_[made.A[1:], made.A[:1] @ made.A[2]])  # the last is of no cloud
    rows = np.column_stack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()])
    np.savetxt(tmp_path / "poses.csv", rows, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    found = propose_cloud_rig(tmp_path, cloud_folders(tmp_path), silent)
    assert found.notes[-1].startswith("the poses belong to other clouds: each cloud fits the pose one row before its")


@pytest.mark.slow
def test_depth_images_are_clouds(made: SimulatedClouds, tmp_path: Path) -> None:
    """Images of 16 bits, in tenths of a millimetre."""
    write_depths(made, VIEWS, 300.0, 1e-4, tmp_path)
    intrinsics = "intrinsics: {K: [300.0, 300.0, 99.5, 99.5], size: [200, 200]}, unit_m: 0.0001"
    text = RIG.replace("clouds: clouds", f"clouds: depth, {intrinsics}")
    (tmp_path / "rig.yaml").write_text(text, encoding="utf-8")
    run("calibrate", tmp_path, "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "out")
    degrees, mm = off(sensor(tmp_path / "out"), made.T_sensorcarrier_sensor)
    assert degrees < 0.1  # pixels are a millimetre wide
    assert mm < 0.5
    run("convert", tmp_path, "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "run.mcap", status=0)
    said = run("init", tmp_path / "run.mcap", "-o", tmp_path / "log.yaml", status=0)
    assert f"{VIEWS} depth images in depth" in said
    proposed = (tmp_path / "log.yaml").read_text(encoding="utf-8")
    assert "clouds: depth" in proposed
    assert "TODO no topic has them" in proposed
