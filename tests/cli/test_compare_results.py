"""``gtsam-rwhec diff`` and ``compare``: exit statuses, the verdict first, and names that cannot steer a terminal."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from given_commands import given
from places import DEMO
from two_logs import calibrated, log_of

import gtsam_rwhec as rw
from gtsam_rwhec.cli import compare_results
from gtsam_rwhec.cli.failures import ExitStatus

pytestmark = pytest.mark.usefixtures("without_figures")

BAD_NAME = "\x1b[31mleft<script>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three calibrations: old, the same cell later, and with a camera that was knocked."""
    folder = tmp_path_factory.mktemp("calibrations")
    problems = {"old": log_of(0), "same": log_of(1), "knocked": log_of(2, knocked="left")}
    for name, problem in problems.items():
        renamed = rw.Problem()
        for pair in problem.pairs:
            one = problem.measurements(*pair)
            sensor = BAD_NAME if pair.sensor == "left" else pair.sensor
            renamed.add(pair.target, sensor, one.A, one.B, 0.001, 1e5, stamps_ns=one.stamps_ns)
        (folder / name).mkdir()
        rw.write_calibration(calibrated(renamed), folder / name / "result.json")
    return folder


@pytest.mark.parametrize(
    ("new", "status", "begins"),
    [
        ("same", ExitStatus.DONE, "Nothing changed by more than chance at 1 %"),
        ("knocked", ExitStatus.CHANGED, r"Changed: \x1b[31mleft<script> moved"),
        ("old", ExitStatus.DONE, "Nothing changed: both are the same answer"),
    ],
)
def test_the_verdict_is_the_first_line_and_the_status(folder: Path, new: str, status: ExitStatus, begins: str) -> None:
    page = folder / f"{new}.html"
    done = given("diff", folder / "old", folder / new, "-o", page)
    assert done.exit_code == status, done.output
    assert done.stdout.startswith(begins)
    assert "\x1b" not in done.output
    text = page.read_text("utf-8")
    assert "left<script>" not in text
    assert "left&lt;script&gt;" in text
    assert "\x1b" not in text


def write_csv(folder: Path, one: rw.Measurements, target: int = 0) -> None:
    """The measurements of one camera and one target as a folder of CSV files."""
    folder.mkdir()
    for side, poses in (("A", one.A), ("B", one.B)):
        q = [gtsam.Rot3(T[:3, :3]).toQuaternion() for T in poses]
        rows = [[each.w(), each.x(), each.y(), each.z(), *T[:3, 3]] for each, T in zip(q, poses, strict=True)]
        np.savetxt(folder / f"tag_{target}_cam_0_{side}.csv", rows, delimiter=",")


def test_a_calibration_of_csv_files_is_verified_on_others(folder: Path, tmp_path: Path) -> None:
    """The calibration of a folder of CSV files, and one more folder: the camera was knocked in between."""
    for name, log in (("old", log_of(0)), ("new", log_of(2, knocked="left"))):
        write_csv(tmp_path / name, log.measurements("board", "left"))
    rw.write_calibration(rw.calibrate(rw.read_csv(tmp_path / "old")), tmp_path / "old.json")
    done = [given("verify", tmp_path / "old.json", tmp_path / name) for name in ("old", "new")]
    assert [one.exit_code for one in done] == [ExitStatus.DONE, ExitStatus.CHANGED], done[1].output
    assert done[1].stdout.startswith("The calibration no longer holds: ")
    refused = given("verify", tmp_path / "old.json", "log.mcap")
    assert refused.exit_code == ExitStatus.BAD_INPUT


def test_the_level_is_that_of_the_library() -> None:
    assert compare_results.LEVEL == rw.results.LEVEL


def test_what_cannot_be_tested_is_said_and_has_a_status_of_its_own(folder: Path, tmp_path: Path) -> None:
    answer = rw.results.read_solution(folder / "knocked" / "result.json")
    rw.write_solution(answer, tmp_path / "solved.json")
    done = given("diff", folder / "old", tmp_path / "solved.json")
    assert done.exit_code == ExitStatus.BAD_INPUT
    assert done.output.startswith("Not tested: NEW has no covariances")
    assert "not tested" in done.output  # in the table, beside each movement


def test_files_with_the_same_checksums_are_not_tested(folder: Path, tmp_path: Path) -> None:
    file = rw.results.InputFile(name="run.mcap", bytes=1, sha256="0" * 64)
    for name in ("old", "same"):
        (tmp_path / name).mkdir()
        result = tmp_path / name / "result.json"
        result.write_bytes((folder / name / "result.json").read_bytes())
        inputs = rw.results.Inputs(files=(file,), versions={})
        rw.results.write_evidence(rw.results.Evidence(inputs=inputs), rw.results.evidence_path(result), result)
    done = given("diff", tmp_path / "old", tmp_path / "same")
    assert done.exit_code == ExitStatus.BAD_INPUT
    assert done.stdout.startswith("Not tested: both rest on the same measurements")


def test_a_log_that_the_calibration_was_made_from_is_known_again(tmp_path: Path) -> None:
    """By its content: under another name too, and as a folder; another log is not."""
    result, log, other = (tmp_path / name for name in ("result.json", "run.mcap", "other.mcap"))
    result.write_bytes(b"{}")
    log.write_bytes(b"a log")
    other.write_bytes(b"another log")
    assert not compare_results.is_of_old_log(result, log)  # nothing says what it was made from
    inputs = rw.results.Inputs(files=rw.results.input_files([log]), versions={})
    rw.results.write_evidence(rw.results.Evidence(inputs=inputs), rw.results.evidence_path(result), result)
    (tmp_path / "bag").mkdir()
    assert not compare_results.is_of_old_log(result, tmp_path / "bag")
    (tmp_path / "bag" / "again.mcap").write_bytes(b"a log")
    assert compare_results.is_of_old_log(result, log)
    assert compare_results.is_of_old_log(result, tmp_path / "bag")
    assert not compare_results.is_of_old_log(result, other)


def test_a_path_that_is_none_is_refused(tmp_path: Path, folder: Path) -> None:
    done = given("diff", folder / "old", tmp_path / "nothing.json")
    assert done.exit_code == ExitStatus.BAD_INPUT


def touches(folder: Path, file: Path, off_m: float) -> Path:
    """A file of touched points, if predictions of the right camera are off by so much."""
    T = rw.results.read_refined(folder / "old" / "result.json").Y["right"].matrix()
    chance = np.random.default_rng(4)
    seen = (chance.random((8, 3)) - 0.5) * [0.4, 0.3, 0.2] + [0.0, 0.0, 0.6]
    known = seen @ T[:3, :3].T + T[:3, 3] + [off_m, 0.0, 0.0] + 1e-4 * chance.standard_normal((8, 3))
    names = "sensor_x_m,sensor_y_m,sensor_z_m,known_x_m,known_y_m,known_z_m"
    np.savetxt(file, np.hstack([seen, known]), delimiter=",", header=names, comments="")
    return file


def test_touches_accept_a_calibration_or_not(folder: Path, tmp_path: Path) -> None:
    result = tmp_path / "result.json"
    result.write_bytes((folder / "old" / "result.json").read_bytes())
    good, bad = (touches(folder, tmp_path / f"{off_m}.csv", off_m) for off_m in (0.0, 0.003))
    calls = (
        ([str(good), "--limit-mm", "1"], ExitStatus.DONE, "Accepted: right is off by less than 1 mm with 95 %"),
        ([str(good), "--limit-mm", "0.15"], ExitStatus.NOT_UNIQUE, "Not accepted yet: "),
        ([str(good), "--limit-mm", "1", "--ball", "9", "9", "9", "1"], ExitStatus.NOT_UNIQUE, "Not determined: "),
        ([str(bad), "--limit-mm", "1", "--box", *"000111"], ExitStatus.CHANGED, "Rejected: "),
    )
    for arguments, status, begins in calls:
        done = given("accept", str(result), *arguments, "--sensor", "right")
        assert done.exit_code == status, done.output
        assert done.stdout.startswith(begins)
        (found,) = rw.results.read_result(result).acceptance
        assert done.stdout.startswith(str(found))
        assert found.source == Path(arguments[0]).name
    lines = good.read_text().splitlines()
    points = [line.split(",") for line in lines[1:]]
    mixed = (",".join(one[:3] + other[3:]) for one, other in zip(points, points[::-1], strict=True))
    (tmp_path / "mixed.csv").write_text("\n".join([lines[0], *mixed]))
    done = given("accept", str(result), str(tmp_path / "mixed.csv"), "--limit-mm", "1", "--sensor", "right")
    assert "which is no noise: do both points of each line belong together" in " ".join(done.output.split())
    before = result.read_bytes()
    done = given("accept", str(result), *calls[0][0], "--sensor", "right", "--no-write")
    assert done.exit_code == ExitStatus.DONE
    assert result.read_bytes() == before
    refused = given("accept", str(result), str(good), "--limit-mm", "1")
    assert refused.exit_code == ExitStatus.BAD_INPUT  # of two sensors none is named
    assert "say which one is tested" in refused.output
    for name in ("typo.csv", "nofile.mcap"):  # no traceback, and no status that says "rejected"
        done = given("accept", str(result), str(tmp_path / name), "--limit-mm", "1", "--sensor", "right")
        assert done.exit_code == ExitStatus.BAD_INPUT
    (tmp_path / "empty.csv").write_text("")
    done = given("accept", str(result), str(tmp_path / "empty.csv"), "--limit-mm", "1", "--sensor", "right")
    assert "empty.csv is empty: give a header with" in done.output
    both = ["--box", *"000111", "--ball", *"0001"]
    assert given("accept", str(result), *calls[0][0], *both).exit_code == ExitStatus.BAD_INPUT


def test_the_answer_of_touches_stays_where_other_commands_read_the_result(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "result.json").write_bytes((folder / "old" / "result.json").read_bytes())
    file = touches(folder, tmp_path / "touches.csv", 0.0)
    options = ["--limit-mm", "1", "--sensor", "right"]
    assert given("accept", str(tmp_path), str(file), *options).exit_code == ExitStatus.DONE
    assert given("diff", str(folder / "old"), str(tmp_path)).exit_code == ExitStatus.DONE
    page = tmp_path / "page.html"
    assert given("report", str(tmp_path), "-o", str(page)).exit_code == ExitStatus.DONE
    assert "right is off by less than 1 mm with 95 %" in page.read_text("utf-8")
    assert len(rw.results.read_result(tmp_path / "result.json").acceptance) == 1


def test_a_board_in_other_csv_files_accepts_a_calibration_of_csv_files(tmp_path: Path) -> None:
    for name, log in (("old", log_of(0)), ("new", log_of(1, count=40))):
        one = log.measurements("board" if name == "old" else "tag", "left")
        write_csv(tmp_path / name, one, len(name) + len(log.pairs))
    result = tmp_path / "result.json"
    done = given("calibrate", str(tmp_path / "old"), "-o", str(result))
    assert done.exit_code == ExitStatus.DONE, done.output
    answers = [given("accept", str(result), str(tmp_path / name), "--limit-mm", "10") for name in ("new", "old")]
    assert answers[0].exit_code == ExitStatus.DONE, answers[0].output
    assert answers[0].stdout.startswith("Accepted: cam_0 is off by less than 10 mm")
    assert answers[1].exit_code == ExitStatus.BAD_INPUT
    assert "the calibration was made from it" in answers[1].output


def test_the_probability_is_that_of_the_library() -> None:
    from gtsam_rwhec.results import acceptance

    assert compare_results.PROBABILITY == acceptance.LEVEL
    assert set(compare_results.STATUSES) == {answer.value for answer in rw.results.Answer}


def test_the_methods_that_apply_and_why_the_others_do_not(tmp_path: Path) -> None:
    output = tmp_path / "comparison.json"
    done = given(
        "compare", DEMO, "--sigma", 0.005, "--kappa", 6000, "--method", "lom", "--method", "shah2013", "-o", output
    )
    assert done.exit_code == 0, done.stderr
    assert "lom " in done.stdout
    reason = "this method solves for one target and one sensor; the problem has 4 targets, 3 sensors and 11 pairs"
    assert f"  - shah2013: {reason}\n" in done.stdout
    assert "Certified globally optimal" in done.stdout
    assert [row["method"] for row in json.loads(output.read_text())["methods"]] == ["lom", "shah2013"]


def test_bad_input_is_refused_in_words(tmp_path: Path) -> None:
    for arguments, words in (
        ((tmp_path / "nowhere",), "nowhere"),
        ((DEMO, "--method", "shah"), "'shah' is not one of"),
        ((DEMO, "-o", tmp_path / "nowhere" / "comparison.json"), "cannot be written"),
    ):
        done = given("compare", *arguments)
        assert done.exit_code == 2
        assert words in done.stderr
