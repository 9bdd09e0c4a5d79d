"""Folders of images with poses beside them: which pose goes with which image, at which stamp, and what does not fit."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from cells_of_others import CIRCLES, WORKCELL
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import Misreading
from gtsam_rwhec.calibration.other_readings import Mistake
from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import LogError, LogWarning, RigError
from gtsam_rwhec.logs import ImageRecord, PoseRecord, open_log
from gtsam_rwhec.logs.image_folder import read_poses
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.runs.carrier_motion import read_carrier_motion
from gtsam_rwhec.runs.log_findings import in_rig_file
from gtsam_rwhec.runs.recorded_logs import is_folder_of_images, write_folder_log
from gtsam_rwhec.runs.run_log import RECORDED_LOG
from gtsam_rwhec.runs.sensor_intrinsics import read_intrinsics

pytestmark = pytest.mark.usefixtures("without_figures")

_, PNG = cv2.imencode(".png", np.zeros((4, 6), dtype=np.uint8))
SENSOR = "  {name}: {{images: {name}/image, poses: {poses}, intrinsics: {{K: [6, 6, 3, 2], size: [6, 4]}}{more}}}\n"


def rig(*sensors: str, more: str = "", poses: str = "{name}/pose", **stated: str) -> rw.rig.Rig:
    source = "".join(f", {key}: {value}" for key, value in stated.items())
    text = f"carriers: {{sensors: base, targets: hand, poses: {{frames: [base, hand]{source}}}}}\nsensors:\n"
    text += "".join(SENSOR.format(name=name, poses=poses.format(name=name), more=more) for name in sensors)
    return parse_rig(
        text + "targets:\n  board: {type: checkerboard, inner_corners: [3, 4], square_m: 0.05}\n", "rig.yaml"
    )


def add(folder: Path, camera: str, images: list[str], poses: dict[str, float]) -> None:
    for part in ("image", "pose"):
        (folder / camera / part).mkdir(parents=True)
    for name in images:
        (folder / camera / "image" / name).write_bytes(PNG.tobytes())
    for name, x in poses.items():
        T = np.eye(4)
        T[0, 3] = x
        np.savetxt(folder / camera / "pose" / name, T)


def read(path: Path) -> tuple[list[tuple[str, int]], dict[int, float]]:
    with open_log(path) as log:
        records = list(log.records())
    images = [(r.topic, r.stamp_ns) for r in records if isinstance(r, ImageRecord)]
    return images, {r.stamp_ns: float(r.T[0, 3]) for r in records if isinstance(r, PoseRecord)}


def test_images_at_rest_never_share_a_stamp(tmp_path: Path) -> None:
    add(tmp_path, "a", ["0001.png", "0002.png", "0010.png"], {"0001.csv": 1.0, "0002.csv": 2.0, "0010.csv": 3.0})
    add(tmp_path, "b", ["0001.png", "0002.png"], {"0001.csv": 4.0, "0002.csv": 5.0})
    assert write_folder_log(tmp_path, rig("a", "b"), tmp_path / "log.mcap") == (5, 5)
    images, poses = read(tmp_path / "log.mcap")
    assert [topic for topic, _ in images] == ["a/image"] * 3 + ["b/image"] * 2
    assert [poses[stamp] for _, stamp in images] == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert len({stamp for _, stamp in images}) == 5


def test_one_instant_only_where_it_is_said(tmp_path: Path) -> None:
    for camera, last in (("a", 2.0), ("b", 2.5)):
        add(tmp_path, camera, ["0.png", "1.png"], {"0.csv": 1.0, "1.csv": last})
    write_folder_log(tmp_path, rig("a", "b"), tmp_path / "log.mcap")
    with pytest.raises(
        LogError, match=r"a/pose/1\.csv and .*b/pose/1\.csv are two poses of the same frame at one stamp"
    ):
        write_folder_log(tmp_path, rig("a", "b", one_instant="true"), tmp_path / "log.mcap")
    (tmp_path / "b" / "pose" / "1.csv").write_text((tmp_path / "a" / "pose" / "1.csv").read_text())
    assert write_folder_log(tmp_path, rig("a", "b", one_instant="true"), tmp_path / "log.mcap") == (4, 2)


def test_folders_converted_apart_are_no_one_log(tmp_path: Path) -> None:
    for camera, last in (("a", 2.0), ("b", 2.5)):
        add(tmp_path, camera, ["0.png", "1.png"], {"0.csv": 1.0, "1.csv": last})
        write_folder_log(tmp_path, rig(camera), tmp_path / f"{camera}.mcap")
    words = r"a\.mcap and .*b\.mcap have two poses of hand at one stamp, 2000000000 ns: \[2\.0, .* and \[2\.5"
    with open_log([tmp_path / "a.mcap", tmp_path / "b.mcap"]) as log, pytest.raises(LogError, match=words):
        read_carrier_motion(log, rig("a", "b"))
    with open_log([tmp_path / "a.mcap", tmp_path / "a.mcap"]) as log:
        assert len(read_carrier_motion(log, rig("a", "b")).trajectory.T) == 2


def test_the_rest_is_counted_and_said(tmp_path: Path) -> None:
    add(tmp_path, "a", [f"im_{i}.png" for i in range(5)], {f"pose_{i:04d}.csv": float(i) for i in (1, 3, 4, 7)})
    with pytest.warns(LogWarning, match=r"2 of 5 images have no pose \(im_0.png, im_2.png\), and 1 of 4 poses have no"):
        assert write_folder_log(tmp_path, rig("a"), tmp_path / "log.mcap") == (3, 3)
    images, poses = read(tmp_path / "log.mcap")
    assert [poses[stamp] for _, stamp in images] == [1.0, 3.0, 4.0]


def test_stamps_in_names_are_stamps(tmp_path: Path) -> None:
    add(tmp_path, "a", ["1700000000300000000.png", "1700000000500000000.png"], {})
    rows = [f"17000000{i:02d}.25,{i}.0,0,0,0,0,0,1" for i in range(3)]
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    assert write_folder_log(tmp_path, rig("a", poses="poses.csv"), tmp_path / "log.mcap") == (2, 3)
    images, poses = read(tmp_path / "log.mcap")
    assert [stamp for _, stamp in images] == [1700000000300000000, 1700000000500000000]
    assert poses == {1700000000250000000 + i * 10**9: float(i) for i in range(3)}
    rows.append("1700000001.25,7.0,0,0,0,0,0,1")
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    with pytest.raises(LogError, match=r"poses\.csv, line 2 and .*poses\.csv, line 4 are two poses of the same frame"):
        write_folder_log(tmp_path, rig("a", poses="poses.csv"), tmp_path / "log.mcap")


def test_poses_without_names_go_by_their_order(tmp_path: Path) -> None:
    add(tmp_path, "a", ["2.png", "10.png"], {})
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 0 1\n2 0 0 0 0 0 1\n")
    write_folder_log(tmp_path, rig("a", poses="poses.txt"), tmp_path / "log.mcap")
    assert list(read(tmp_path / "log.mcap")[1].values()) == [1.0, 2.0]
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 0 1\n2 0 0 0 0 0 1\n3 0 0 0 0 0 1\n")
    with pytest.raises(LogError, match="2 images and 3 poses without names"):
        write_folder_log(tmp_path, rig("a", poses="poses.txt"), tmp_path / "log.mcap")


def test_what_does_not_fit(tmp_path: Path) -> None:
    add(tmp_path, "a", ["left.png", "right.png"], {"0.csv": 1.0, "1.csv": 2.0})
    out = tmp_path / "log.mcap"
    with pytest.raises(LogError, match=r"no pose has the name of an image\. The first image is left\.png"):
        write_folder_log(tmp_path, rig("a"), out)
    with pytest.raises(LogError, match=r"line 3: sensors.a.time_offset: .* no clock can be estimated"):
        write_folder_log(tmp_path, rig("a", more=", time_offset: estimate"), out)
    with pytest.raises(LogError, match="b/image: there is no such folder of images"):
        write_folder_log(tmp_path, rig("b"), out)
    with pytest.raises(LogError, match="nothing cannot be read: No such file"):
        write_folder_log(tmp_path, rig("a", poses="nothing"), out)
    assert not out.exists()
    with pytest.raises(LogError, match="no such folder of images"):
        rw.runs.calibrate_log(tmp_path, rig("b"), tmp_path / "results")
    assert not (tmp_path / "results").exists()
    of_a_log = parse_rig(WORKCELL.replace("frames", "tf").replace("poses: pose, ", ""), "rig.yaml")
    with pytest.raises(LogError, match=r"is of a log.* write poses: {frames: \[base, hand\]}"):
        rw.runs.calibrate_log(tmp_path, of_a_log, tmp_path / "results")


def test_the_rig_file_of_a_folder() -> None:
    assert rig("a").sensors["a"].intrinsics is not None
    with pytest.raises(
        RigError, match=r"sensors\.a\.poses: poses in files beside images, and carriers.poses is of a log"
    ):
        parse_rig(rw.rig.rig_text(rig("a")).replace("{frames:", "{tf:"), "rig.yaml")
    with pytest.raises(RigError, match="'XXZ'; give three axes"):
        rig("a", euler="XXZ")
    with pytest.raises(RigError, match="D without model"):
        rig("a", more=", frame: f").model_validate(
            parse_rig(rw.rig.rig_text(rig("a")).replace("size: [6, 4]", "size: [6, 4], D: [0.1, 0, 0, 0]"), "rig.yaml")
        )


def test_images_are_read_where_a_log_lies_beside_them(tmp_path: Path) -> None:
    """A log that this library had written into the folder was taken in place of the images, without a word."""
    (tmp_path / "log.mcap").write_bytes(b"")
    assert not is_folder_of_images(tmp_path, rig("a"))
    images = rig("a").sensors["a"].images
    assert images is not None
    (tmp_path / images).mkdir(parents=True)
    assert is_folder_of_images(tmp_path, rig("a"))


def test_the_two_folders_of_other_people(workcell_camera2: Path, circle_grid_10x10: Path, tmp_path: Path) -> None:
    workcell, circles = parse_rig(WORKCELL, "rig.yaml", workcell_camera2), parse_rig(CIRCLES, "rig.yaml")
    assert is_folder_of_images(workcell_camera2, workcell)
    assert write_folder_log(workcell_camera2, workcell, tmp_path / "log.mcap") == (39, 39)
    with open_log(tmp_path / "log.mcap") as log:
        camera = read_intrinsics(log, workcell)["camera2"]
    assert (camera.width, camera.height, camera.model) == (1920, 1080, "radtan")
    assert camera.K[0].tolist() == [1371.02278154, 0.0, 960.5]
    assert write_folder_log(circle_grid_10x10, circles, tmp_path / "log.mcap") == (15, 15)
    of_index = parse_rig(CIRCLES.replace("poses: poses,", "poses: cal_data.yaml,"), "rig.yaml")
    assert write_folder_log(circle_grid_10x10, of_index, tmp_path / "index.mcap") == (15, 15)
    assert read(tmp_path / "index.mcap") == read(tmp_path / "log.mcap")


def part_of(folder: Path, workcell: Path) -> Path:
    """A folder with some of the workcell's images."""
    (folder / "image").mkdir(parents=True)
    for number in (1, 43, 61, 94, 112, 121, 208, 221, 233, 242):
        (folder / "image" / f"{number:04d}.png").symlink_to(workcell / "image" / f"{number:04d}.png")
    (folder / "intrinsic_pars_file.yaml").symlink_to(workcell / "intrinsic_pars_file.yaml")
    return folder


def test_from_a_folder_to_a_result(workcell_camera2: Path, tmp_path: Path) -> None:
    folder, out = part_of(tmp_path / "cell", workcell_camera2), tmp_path / "out"
    poses = read_poses(workcell_camera2 / "pose")
    rows = np.hstack([poses.T[:, :3, 3], Rotation.from_matrix(poses.T[:, :3, :3]).as_quat(scalar_first=True)])
    lines = [f"{name} {' '.join(map(repr, row))}" for name, row in zip(poses.names, rows.tolist(), strict=True)]
    (folder / "poses.txt").write_text("\n".join(lines))
    (folder / "image" / "0100.png").write_bytes(b"no picture")
    text = WORKCELL.replace("poses: pose,", "poses: poses.txt,").replace("hand]}", "hand], quaternion: wxyz}")
    with pytest.warns(LogWarning, match="28 of 39 poses have no image"):
        calibrated = rw.runs.calibrate_log(folder, parse_rig(text, "rig.yaml"), out)
    assert not list(out.glob(f"*{RECORDED_LOG}"))
    assert calibrated.judgement.verdict is not Verdict.DO_NOT_USE
    assert calibrated.log.detection.sources == ("cell.images.mcap",)
    (fault,) = calibrated.log.detection.undecoded["camera2"]
    assert fault.startswith("image/0100.png: ")
    # All 34 boards together have the camera here, to a millimetre.
    np.testing.assert_allclose(calibrated.refined.Y["camera2"].translation(), [1.7666, 2.0622, 1.1559], atol=0.02)


@pytest.mark.parametrize(
    ("mistake", "likely", "words"),
    [
        (Mistake.QUATERNION_ORDER, "", "write quaternion: wxyz beside the frames (rig.yaml, line 1: carriers.poses)"),
        (Mistake.INVERTED, "A is inverted", "the files have T_hand_base: write frames: [hand, base] (rig.yaml, line 1"),
        (Mistake.ROWS_SHIFTED, "", "poses belong to other images than those of their names or order (a/image with"),
    ],
)  # fmt: skip
def test_the_cures_of_files(mistake: Mistake, likely: str, words: str) -> None:
    (found,) = in_rig_file((Misreading(mistake, likely, "", (9.0, 1.0), (9.0, 1.0)),), rig("a"))
    assert words in found.cure


def test_patterns_and_words_before_stamps(tmp_path: Path) -> None:
    """Other images in the folder are left out by a pattern; a stamp may have words before it."""
    stamps = [1700000000300000000, 1700000000500000000]
    add(tmp_path, "a", [f"frame_{stamp}{kind}" for stamp in stamps for kind in (".bmp", ".depth.png")], {})
    rows = [f"17000000{i:02d}.25,{i}.0,0,0,0,0,0,1" for i in range(3)]
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    text = rw.rig.rig_text(rig("a", poses="poses.csv")).replace("a/image", "a/image/*.bmp")
    assert write_folder_log(tmp_path, parse_rig(text, "rig.yaml"), tmp_path / "log.mcap") == (2, 3)
    images, _ = read(tmp_path / "log.mcap")
    assert images == [("a/image/*.bmp", stamp) for stamp in stamps]
    text = text.replace("*.bmp", "*.webp")
    with pytest.raises(LogError, match=r"a/image/\*\.webp has no images"):
        write_folder_log(tmp_path, parse_rig(text, "rig.yaml"), tmp_path / "log.mcap")
