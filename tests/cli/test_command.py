"""The command as people type it: its output and exit status, what the shell completes, and what convert passes over."""

from __future__ import annotations

import dataclasses
import http.server
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path

import gtsam
import numpy as np
import pytest
import synthetic_logs as made
from given_commands import command, given
from places import CELL, DEMO, REPOSITORY
from typer.testing import CliRunner
from web_server import served

import gtsam_rwhec as rw
from gtsam_rwhec.cli.app import app
from gtsam_rwhec.cli.convert_command import MOST_NAMED, messages_not_read
from gtsam_rwhec.methods import METHODS
from gtsam_rwhec.simulate import Noise, general

pytestmark = pytest.mark.usefixtures("without_figures")

NOISE = Noise(sigma_m=0.005, kappa=6000.0)
COMMAND = (str(Path(sys.executable).with_name("gtsam-rwhec")),)


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command to its end, in a process of its own."""
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8"}
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, encoding="utf-8", env=environment
    )


def without_stages(stderr: str) -> list[str]:
    """The lines that a fast machine prints; a slow one prints how far it is as well."""
    return [line for line in stderr.splitlines() if not re.match(r"\[\d+ s\] ", line)]


def write_csv(problem: rw.Problem, folder: Path) -> Path:
    """Write a simulated problem in the real dataset's format; target0 and sensor0 become tag_0 and cam_0."""
    for target, sensor in problem.pairs:
        measurements = problem.measurements(target, sensor)
        name = f"tag_{target.removeprefix('target')}_cam_{sensor.removeprefix('sensor')}"
        for side, poses in (("A", measurements.A), ("B", measurements.B)):
            rows = []
            for matrix in poses:
                q = gtsam.Rot3(matrix[:3, :3]).toQuaternion()
                rows.append([q.w(), q.x(), q.y(), q.z(), *matrix[:3, 3]])
            np.savetxt(folder / f"{name}_{side}.csv", rows, delimiter=",")
    return folder


@pytest.fixture
def serve(utias_folder: Path) -> Iterator[str]:
    """Address of a server on this machine that serves the real dataset."""
    with served(partial(http.server.SimpleHTTPRequestHandler, directory=str(utias_folder))) as address:
        yield address


class SlowHandler(http.server.BaseHTTPRequestHandler):
    """Answers every request after some seconds, with 404."""

    def do_GET(self) -> None:
        time.sleep(2.5)
        self.send_error(404)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def slow_address() -> Iterator[str]:
    """Address of a server that takes more than a second for anything."""
    with served(SlowHandler) as address:
        yield address


def test_the_real_dataset_and_its_result_file(utias_folder: Path, tmp_path: Path) -> None:
    result = tmp_path / "result.json"
    done = given("calibrate", utias_folder, "--certified-only", "--sigma", 1, "--kappa", 1, "-v", "-o", result)
    assert done.exit_code == 0, done.stderr
    assert "16 targets, 8 sensors, 73 pairs, 3230 measurements" in done.stdout
    assert "no answer below 8.281245" in done.stdout
    assert f"Written to {result}; report: {tmp_path / 'report.html'}." in done.stderr
    solution = rw.read_solution(result)
    assert solution.certificate.is_certified
    assert solution.cost == pytest.approx(8.2812454, abs=1e-7)


def test_scale_and_method(utias_folder: Path) -> None:
    done = given("calibrate", utias_folder, "--certified-only", "--scale", "shared", "--sigma", "1", "--kappa", "1")
    assert done.exit_code == 0, done.stderr
    assert "Scale: 1.025" in done.stdout


def test_a_misread_folder_is_named_without_refinement_too(tmp_path: Path) -> None:
    """B's quaternions are x, y, z, w, and are read as w first."""
    for path in DEMO.glob("*_cam_*.csv"):
        rows = np.loadtxt(path, delimiter=",")
        if path.stem.endswith("_B"):
            rows = rows[:, [1, 2, 3, 0, 4, 5, 6]]
        np.savetxt(tmp_path / path.name, rows, delimiter=",")
    done = given("calibrate", tmp_path, "--certified-only")
    assert done.exit_code == 6, done.stderr
    assert done.stdout.startswith("Do not use these poses: the quaternions of B are xyzw, and were read as wxyz")


def test_the_relaxation() -> None:
    done = given("calibrate", DEMO, "--certified-only", "--method", "sdp", "--sigma", 0.005, "--kappa", 6565)
    assert done.exit_code == 0, done.stderr
    assert "relaxation" in done.stdout


def test_unit_weights_are_called_relative() -> None:
    assert "costs and covariances are relative" in given("calibrate", DEMO, "--certified-only", "--verbose").stdout
    whole = given("calibrate", DEMO, "--verbose").stdout
    assert "The covariances are not: they come from the noise that the residuals show." in whole


def test_words_of_file_names(tmp_path: Path) -> None:
    for path in DEMO.iterdir():
        shutil.copy(path, tmp_path / path.name.replace("tag_", "board_").replace("cam_", "lidar_"))
    done = given("calibrate", tmp_path, "--targets", "board", "--sensors", "lidar")
    assert done.exit_code == 0, done.stderr
    assert "\nboard_3 " in done.stdout
    assert "\nlidar_2 " in done.stdout


def test_bad_input_is_status_2_and_one_message(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(DEMO, tmp_path / "demo"))
    with open(folder / "tag_0_cam_1_B.csv", "a", encoding="utf-8") as stream:
        stream.write("1,0,0,0,oops,0,0\n")
    done = run("calibrate", folder)
    assert done.returncode == 2
    assert done.stdout == ""
    error = f"Error: {folder}/tag_0_cam_1_B.csv, line 17: not a finite number: tx is 'oops'."
    assert without_stages(done.stderr) == [error, "More: docs/files.md"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["calibrate", "/nowhere"], "/nowhere does not exist"),
        (["calibrate", DEMO, "--sigma", "-1"], "sigma is -1.0"),
        (["calibrate", DEMO, "--scale", "unknown"], "unknown"),
        (["calibrate", DEMO, "--certified-only", "--method", "local"], "--initial"),
        (["calibrate", DEMO, "--certified-only", "--initial", "x.json"], "--method local"),
        (["calibrate", DEMO, "-o", "/nowhere/result.json"], "the folder /nowhere does not exist"),
        (["calibrate", DEMO, "--robust", "gnc", "--certified-only"], "--robust"),
        (["calibrate", DEMO, "--carrier-noise-mm", "2"], "go together"),
        (["calibrate", DEMO, "--arm-accuracy-deg", "0.1"], "--arm-accuracy-deg and --arm-accuracy-mm go together"),
        (["calibrate", DEMO, "--noise", "given"], "--noise estimate"),
        (["calibrate", CELL / "robot_cell.mcap"], "--rig"),
        (["calibrate", CELL / "robot_cell.mcap", "--rig", CELL / "rig.yaml"], "several files"),
        (["calibrate"], "source"),
        (["fetch", "other"], "other"),
        (["guess"], "guess"),
    ],
)
def test_what_cannot_be_done_is_status_2(arguments: list[object], said: str) -> None:
    done = given(*arguments)
    assert done.exit_code == 2
    assert said in done.stderr


def test_files_that_are_not_read_are_warned_of(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(DEMO, tmp_path / "demo"))
    (folder / "README.txt").touch()
    done = given("calibrate", folder)
    assert done.exit_code == 0
    (warning,) = without_stages(done.stderr)
    assert warning.startswith("Warning: ")
    assert "README.txt" in warning


def test_not_unique_is_status_3(tmp_path: Path) -> None:
    folder = write_csv(general(2, 2, seed=5, motion="planar", noise=NOISE).problem, tmp_path)
    weights = ("--sigma", 0.005, "--kappa", 6000, "--noise", "given")
    done = given("calibrate", folder, *weights, "-v", "-o", tmp_path / "r.json")
    assert done.exit_code == 3
    assert without_stages(done.stderr) == [f"Written to {tmp_path / 'r.json'}; report: {tmp_path / 'r.html'}."]
    assert "not unique" in done.stdout
    assert " free " in done.stdout
    direction, *_ = [line for line in done.stdout.splitlines() if "Not determined: " in line]
    assert all(name in direction for name in ("tag_0", "tag_1", "cam_0", "cam_1"))  # they move together
    assert done.stdout.startswith("Do not use these poses: ")
    assert rw.read_solution(tmp_path / "r.json").certificate.status is rw.Status.CERTIFIED_NOT_UNIQUE
    assert np.isinf(rw.read_refined(tmp_path / "r.json").covariance("cam_0")).any()


def test_refinement_reports_covariances_and_writes_them(tmp_path: Path) -> None:
    result = tmp_path / "refined.json"
    options = ("calibrate", DEMO, "--sigma", 0.005, "--kappa", 6565, "--noise", "given", "--verbose")
    done = given(*options, "-o", result)
    assert done.exit_code == 0, done.stderr
    assert done.stdout.startswith("Use these poses: ")
    assert done.stdout.index("How far off a point is") < done.stdout.index("What was chosen, and why")
    assert re.search(r"cam_0 +the frame that carries cam_0 +2\.60 +95 +3\.92 ", done.stdout)
    assert done.stdout.index("±x mm") < done.stdout.index("Proven: ") < done.stdout.index("certified: cost 368.6")
    assert "Other sensors in the frame of cam_0" in done.stdout
    assert not re.search("Not shown|evidence.json|Inputs and versions|free_directions", done.stdout)
    assert "Noise of B: 0.5° and 5 mm for each axis of a typical measurement, as given." in done.stdout
    refined = rw.read_refined(result)
    poses = done.stdout[done.stdout.index("Sensors in the frame") :].splitlines()
    for name in refined.Y:
        (row, *_) = [line for line in poses if line.startswith(f" {name} ")]
        np.testing.assert_allclose(
            [float(cell) for cell in row.split()[7:10]], refined.standard_deviations(name)[1], atol=0.0051
        )
    noisier = given(*options, "--carrier-noise-deg", 0.3, "--carrier-noise-mm", 2, "-o", tmp_path / "noisier.json")
    assert "Noise of A: 0.3° and 2 mm for each axis of the target carrier, as given." in noisier.stdout
    wider = rw.read_refined(tmp_path / "noisier.json")
    assert (wider.standard_deviations("cam_0")[1] > refined.standard_deviations("cam_0")[1]).all()
    accuracy = ("--arm-accuracy-deg", 0.1, "--arm-accuracy-mm", 1)
    of_an_arm = run("calibrate", DEMO, "--scale", "shared", *accuracy, "--verbose")
    assert (
        "Accuracy of the arm: 0.1° and 1 mm for each axis, as you stated, because an option says so."
        in of_an_arm.stdout
    )
    again = given("calibrate", DEMO, "--certified-only", "--method", "local", "--initial", result)
    assert again.exit_code == 0, again.stderr
    assert "given start" in again.stdout


def test_outliers_are_left_out(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(DEMO, tmp_path / "demo"))
    path = folder / "tag_0_cam_1_B.csv"
    lines = path.read_text(encoding="utf-8").splitlines()
    for i in (-1, -2, -3):
        *rotation, x, y, z = lines[i].split(",")
        lines[i] = ",".join([*rotation, str(float(x) + 0.7), y, z])
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    weights = ("--sigma", 0.005, "--kappa", 6565, "--noise", "given", "--verbose")
    done = given("calibrate", folder, *weights, "-o", tmp_path / "result.json")
    assert done.exit_code == 0, done.stderr
    kept, number = rw.read_refined(tmp_path / "result.json").inlier_counts["tag_0", "cam_1"]
    assert kept == number - 3
    assert f"3 of {number} of tag_0-cam_1" in done.stdout
    all_count = given("calibrate", folder, "--robust", "none", "--verbose")
    assert "every measurement counts, because an option says so" in all_count.stdout
    assert all_count.stdout.startswith("Use these poses with care: 3 of ")
    assert "--robust auto" in all_count.stdout.partition("Sensors in the frame")[0]


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_not_certified_is_status_4(tmp_path: Path) -> None:
    """Few and very noisy measurements: from some starts the descent ends in a local minimum, and must not hide it."""
    start = ({"target0": gtsam.Pose3()}, {"sensor0": gtsam.Pose3()}, 1.0)
    problems = (
        general(1, 1, seed=seed, number_of_measurements=5, noise=Noise(sigma_m=1.0, kappa=1.0)).problem
        for seed in range(100)
    )
    problem = next(p for p in problems if rw.solve(p, "local", initial=start).certificate.status is rw.Status.GAP)
    (tmp_path / "csv").mkdir()
    folder = write_csv(problem, tmp_path / "csv")
    earlier = rw.solve(rw.read_csv(folder))
    elsewhere = dataclasses.replace(earlier, X={"tag_0": gtsam.Pose3()}, Y={"cam_0": gtsam.Pose3()})
    rw.write_solution(elsewhere, tmp_path / "start.json")
    local = ("--certified-only", "--method", "local", "--initial", tmp_path / "start.json")
    done = given("calibrate", folder, "--sigma", 1, "--kappa", 1, *local)
    assert done.exit_code == 4, done.stderr
    assert "Not certified: this answer costs" in done.stdout
    assert without_stages(done.stderr) == []


def test_fetch_then_calibrate(serve: str, tmp_path: Path) -> None:
    first = given("fetch", "utias", "--base-url", serve, cwd=tmp_path)
    assert first.exit_code == 0, first.stderr
    assert "146 files downloaded to utias, 0 existed already; all are verified." in first.stdout
    again = given("fetch", "utias", "utias", "--base-url", serve, cwd=tmp_path)
    assert "0 files downloaded to utias, 146 existed already" in again.stdout
    next_command = again.stdout.splitlines()[-1].removeprefix("Next: gtsam-rwhec ").split()
    assert given(*next_command, "--certified-only", cwd=tmp_path).exit_code == 0


def test_a_failed_download_is_status_5(serve: str, tmp_path: Path) -> None:
    done = given("fetch", "utias", tmp_path / "utias", "--base-url", f"{serve}/elsewhere")
    assert done.exit_code == 5
    assert "not found (404)" in done.stderr


def test_ctrl_c_is_status_130(slow_address: str, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*COMMAND, "fetch", "utias", str(tmp_path / "utias"), "--base-url", slow_address],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "NO_PROXY": "127.0.0.1"},
        # A test run that was started in the background ignores the signal, and so would its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stderr is not None
    first = process.stderr.readline()  # after a second: by now it waits for the server
    process.send_signal(signal.SIGINT)
    status = process.wait(timeout=30)
    rest = process.stderr.read()
    process.stderr.close()
    assert re.fullmatch(r"\[\d+ s\] downloading file 1 of 146: tag_0_cam_0_A\.csv\n", first)
    assert status == 130
    assert rest == "Interrupted.\n"


def test_version_and_help() -> None:
    assert run("--version").stdout == f"gtsam-rwhec {rw.__version__} (gtsam {version('gtsam')})\n"
    assert "3 the measurements do not determine" in " ".join(given("--help").stdout.split())
    assert "--kappa" in given("calibrate", "--help").stdout


def test_a_terminal_without_our_signs_gets_others() -> None:
    environment = {**os.environ, "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [*COMMAND, "calibrate", str(DEMO), "--verbose"], capture_output=True, env=environment, check=False, timeout=60
    )
    assert done.returncode == 0
    assert b"Proven: " in done.stdout


def complete(instruction: str, **environment: str) -> str:
    """What the command prints for a shell."""
    done = CliRunner(env={"_GTSAM_RWHEC_COMPLETE": instruction, **environment}).invoke(app)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return str(done.stdout)


def words(line: str) -> list[str]:
    """What bash would offer at the end of a line."""
    count = str(len(line.split(" ")) - 1)
    return complete("complete_bash", COMP_WORDS=line, COMP_CWORD=count).split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_gets_its_script(shell: str) -> None:
    script = complete(f"source_{shell}")
    assert "gtsam-rwhec" in script
    assert "_GTSAM_RWHEC_COMPLETE=" in script


def test_subcommands_options_and_values() -> None:
    assert words("gtsam-rwhec c") == ["calibrate", "convert", "clean", "compare"]
    assert words("gtsam-rwhec fetch ") == ["utias"]
    assert words("gtsam-rwhec calibrate --carrier") == ["--carrier-noise-deg", "--carrier-noise-mm"]
    assert words("gtsam-rwhec calibrate --scale ") == ["known", "shared", "per_target"]
    assert words("gtsam-rwhec calibrate --robust g") == ["gnc"]


def test_the_names_of_methods() -> None:
    """In a process of its own, as a shell asks."""
    line = "gtsam-rwhec compare --method "
    asked = {"_GTSAM_RWHEC_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": "3"}
    done = subprocess.run([sys.executable, "-m", "gtsam_rwhec"], capture_output=True, text=True, env=os.environ | asked)
    assert "Traceback" not in done.stderr
    assert done.stdout.split() == list(METHODS)


def test_types_that_the_next_step_does_not_read_are_named(tmp_path: Path) -> None:
    known = made.recording(1.0)
    assert not messages_not_read(made.write(tmp_path / "known.mcap", known))
    others = [made.Message(f"/of_{i}", "nav.Thing", {"a": 1}, made.BEGIN_NS + i) for i in range(3)]
    said = messages_not_read(made.write(tmp_path / "log.mcap", [*known, *others]))
    assert "does not read nav.Thing (3)" in said
    assert "TagDetections" not in said


def test_of_many_types_the_first_are_named(tmp_path: Path) -> None:
    others = [made.Message(f"/of_{i}", f"nav.Thing{i:02d}", {}, made.BEGIN_NS) for i in range(MOST_NAMED + 2)]
    assert "and 2 more; they are kept" in messages_not_read(made.write(tmp_path / "log.mcap", others))


CELL = REPOSITORY / "data" / "cell"


def test_a_robot_that_never_stands_still_leaves_no_calibration_and_says_so(tmp_path: Path) -> None:
    status, said = command(
        "live", CELL / "eye_to_hand.mcap", "--rig", CELL / "eye_to_hand.yaml", "-o", tmp_path / "cell", "--when-still",
        "--terminal", "--speed", "20",
    )  # fmt: skip
    assert status == 3, said
    assert "Nothing was taken: the robot never stood still" in " ".join(said.split())
    assert not (tmp_path / "cell" / "calibration").exists()
