"""Whether an old calibration still holds on a new log, from the messages on."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import synthetic_logs as made
from given_commands import given
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus
from gtsam_rwhec.errors import FrameError, LogError
from gtsam_rwhec.runs.verified_log import OldCalibration, verify_log, with_cameras

#: Three of the old calibration's joint deviations and more: 4 mm and 0.3 degrees.
KNOCK = se3.expmap(np.array([[0.0, 0.005, 0.0, 0.004, 0.0, 0.0]]))[0]
SECONDS = 3.0


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of a calibration."""
    folder = tmp_path_factory.mktemp("old")
    log = made.write(folder / "raw.mcap", made.recording(SECONDS))
    rw.runs.detect_log(log, made.rig(), folder / "detected.mcap")
    rw.runs.clean_log(folder / "detected.mcap", folder / "calibration.mcap")
    rw.runs.solve_into(folder / "calibration.mcap", None, folder / "out")
    return folder / "out"


def new_log(folder: Path, seed: int = 1, **changed: object) -> Path:
    return made.write(folder / f"new_{seed}.mcap", made.recording(SECONDS, seed=seed, **changed))  # type: ignore[arg-type]


def test_it_holds_and_the_command_says_so(old: Path, tmp_path: Path) -> None:
    log = new_log(tmp_path)
    done = given("verify", old, log, "-o", tmp_path / "page.html")
    assert done.exit_code == ExitStatus.DONE, done.output
    assert done.stdout.startswith("The calibration still holds at 1 %: ")
    assert "<h1" in (tmp_path / "page.html").read_text("utf-8")


def test_a_camera_that_was_knocked_is_named(old: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(made.Y, "cam_1", made.Y["cam_1"] @ KNOCK)
    log = new_log(tmp_path)
    done = given("verify", old / "result.json", log)
    assert done.exit_code == ExitStatus.CHANGED, done.output
    assert done.stdout.startswith("The calibration no longer holds: cam_1 moved ")


def test_a_camera_that_sees_nothing_is_named(old: Path, tmp_path: Path) -> None:
    messages = [one for one in made.recording(SECONDS, seed=1) if one.topic != "/cam_1/tags"]
    messages += [made.detections("/cam_1/tags", made.BEGIN_NS + 10**9, "cam_1", [])]
    log = made.write(tmp_path / "new.mcap", sorted(messages, key=lambda one: one.logged_ns))
    done = given("verify", old, log)
    assert done.exit_code == ExitStatus.NOT_UNIQUE, done.output
    assert done.stdout.splitlines()[0].endswith("Not checked: cam_1.")


def test_a_clock_that_is_estimated_may_be_late_by_another_time(old: Path, tmp_path: Path) -> None:
    rig = made.rig(cam_1="detections: /cam_1/tags\n    time_offset: estimate")
    log = made.write(tmp_path / "new.mcap", made.recording(6.0, seed=1, offsets_s={"cam_1": 0.03}))
    (tmp_path / "result.json").write_bytes((old / "result.json").read_bytes())  # and nothing beside it
    found = verify_log(tmp_path / "result.json", log, rig)
    assert found.holds
    assert found.not_checked == {}


def test_a_clock_that_the_new_motion_does_not_tell_is_as_it_was(old: Path, tmp_path: Path) -> None:
    rig = made.rig(cam_1="detections: /cam_1/tags\n    time_offset: estimate")
    found = verify_log(old, new_log(tmp_path), rig)  # so short that its motion repeats itself
    assert found.holds
    assert found.not_checked == {}


def test_the_log_of_the_calibration_itself_is_told(old: Path) -> None:
    calibration = OldCalibration.read(old / "calibration.mcap")
    assert calibration.rig is not None
    assert calibration.result.log is not None
    found = verify_log(old / "calibration.mcap", old / "calibration.mcap")
    assert found.holds
    assert found.test.chance > 0.999


def test_a_rig_file_that_a_cleaned_log_was_not_made_with_is_refused(old: Path) -> None:
    other = made.rig(tag_0=f"{{type: tag, family: tag36h11, id: 7, size_m: {made.SIZE_M}}}")
    with pytest.raises(LogError, match="was made with another rig file"):
        verify_log(old, old / "calibration.mcap", other)


def test_intrinsics_of_the_old_calibration_become_numbers() -> None:
    camera = rw.Camera.of(640, 480, "radtan", made.K, [-0.1, 0.01, 0.0, 0.0], "a test")
    text = "images: /cam_0/image\n    intrinsics: estimate"
    found = with_cameras(made.rig(cam_0=text), {"cam_0": camera, "cam_1": camera})
    section = found.sensors["cam_0"].intrinsics
    assert section is not None
    again = section.camera_of_numbers("a test")
    assert (again.model, again.width, again.height) == ("radtan", 640, 480)
    np.testing.assert_array_equal(again.parameters, camera.parameters)
    assert found.sensors["cam_1"].intrinsics is None  # its poses come from a driver


def test_other_carriers_are_refused(old: Path, tmp_path: Path) -> None:
    text = made.RIG.replace("sensors: hand", "sensors: base").replace("targets: base", "targets: hand")
    with pytest.raises(FrameError, match="is hand in the old calibration and base in the new log"):
        verify_log(old, new_log(tmp_path), rw.rig.parse_rig(text, "rig.yaml"))


def test_a_result_without_its_log_needs_a_rig_file(old: Path, tmp_path: Path) -> None:
    (tmp_path / "result.json").write_bytes((old / "result.json").read_bytes())
    log = new_log(tmp_path)
    with pytest.raises(LogError, match="give --rig FILE"):
        verify_log(tmp_path / "result.json", log)


def test_a_new_log_accepts_a_calibration_and_its_own_log_does_not(old: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(old, out)
    log = new_log(tmp_path)
    done = given("accept", str(out), str(log), "--limit-mm", "100", "--sensor", "cam_1")
    assert done.exit_code == ExitStatus.DONE, done.output
    assert done.stdout.startswith("Accepted: cam_1 is off by less than 100 mm with 95 %")
    (found,) = rw.results.read_calibration(out).acceptance
    assert (found.of, found.source) == ("views", log.name)
    with pytest.raises(LogError, match="made from this very log"):
        rw.runs.accept_log(old, old / "calibration.mcap", limit_mm=100.0, sensor="cam_1")
