"""Reading folders of CSV files, and saying precisely what is wrong with them."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from counted_calls import counted_calls
from hypothesis import given, settings
from hypothesis import strategies as st
from places import DEMO
from strategies import damaged, tables

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError, NoiseError, UnitsWarning
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.problem.csv_folder import CsvWarning, read_pose_rows

GOOD = "1,0,0,0,0.5,-0.25,2e0"


@pytest.fixture
def demo(tmp_path: Path) -> Path:
    """A copy of the demo's files, to be spoilt."""
    return Path(shutil.copytree(DEMO, tmp_path / "demo"))


def write_pair(folder: Path, lines_a: list[str], lines_b: list[str], name: str = "tag_0_cam_0") -> None:
    """Write both files of a pair."""
    (folder / f"{name}_A.csv").write_text("".join(line + "\n" for line in lines_a), encoding="utf-8")
    (folder / f"{name}_B.csv").write_text("".join(line + "\n" for line in lines_b), encoding="utf-8")


def test_real_dataset_has_the_counts_of_the_paper(utias_folder: Path) -> None:
    problem = rw.read_csv(utias_folder, scale="shared", sigma=1.0, kappa=1.0)
    assert len(problem.targets) == 16
    assert sorted(problem.sensors, key=natural_key) == [f"cam_{k}" for k in range(8)]
    assert len(problem.pairs) == 73
    assert problem.number_of_measurements == 3230
    assert problem.scale == "shared"
    assert not problem.is_relative


def test_real_dataset_comes_in_natural_order(utias_folder: Path) -> None:
    targets = list(rw.read_csv(utias_folder).targets)
    assert targets == sorted(targets, key=lambda name: int(name.removeprefix("tag_")))
    assert targets != sorted(targets)


def test_poses_are_those_of_the_files(utias_folder: Path) -> None:
    measurements = rw.read_csv(utias_folder).measurements("tag_0", "cam_1")
    for side, poses in (("A", measurements.A), ("B", measurements.B)):
        rows = np.loadtxt(utias_folder / f"tag_0_cam_1_{side}.csv", delimiter=",")
        np.testing.assert_array_equal(poses[:, :3, 3], rows[:, 4:])
        w, x, y, z = rows[:, :4].T
        # R p of p = e_x is the first column: (w^2 + x^2 - y^2 - z^2, 2 (x y + w z), 2 (x z - w y)).
        first = np.stack([w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
        np.testing.assert_allclose(poses[:, :3, 0], first, atol=1e-9)


def test_weights_left_out_make_the_problem_relative() -> None:
    assert rw.read_csv(DEMO).is_relative
    assert not rw.read_csv(DEMO, sigma=0.005, kappa=6000.0).is_relative


def test_a_folder_in_millimetres_has_one_warning(tmp_path: Path) -> None:
    line = "1,0,0,0,{},0,0"
    for name in ("tag_0_cam_0", "tag_0_cam_1", "tag_1_cam_0", "tag_1_cam_1"):
        # The first row of A is the origin that A is taken about.
        write_pair(tmp_path, [line.format(x) for x in (-900, 0, 900)], [line.format(x) for x in (700, 800, 900)], name)
    with pytest.warns(UnitsWarning) as caught:
        rw.read_csv(tmp_path)
    (message,) = [str(warning.message) for warning in caught]
    assert "tag_0-cam_0" in message
    assert "and 1 more" in message
    assert "of A and B" in message
    assert caught[0].filename == __file__


def test_measurements_need_not_be_kept() -> None:
    problem = rw.read_csv(DEMO, keep_measurements=False)
    with pytest.raises(rw.errors.MeasurementsNotKeptError):
        problem.measurements("tag_0", "cam_0")


def test_roles_can_be_exchanged() -> None:
    problem = rw.read_csv(DEMO, targets="cam", sensors="tag")
    assert set(problem.targets) == {"cam_0", "cam_1", "cam_2"}
    assert set(problem.sensors) == {"tag_0", "tag_1", "tag_2", "tag_3"}
    assert problem.number_of_measurements == rw.read_csv(DEMO).number_of_measurements


def test_words_and_ids_are_free(tmp_path: Path) -> None:
    write_pair(tmp_path, [GOOD], [GOOD], "board_left_wall_lidar_top-2")
    problem = rw.read_csv(tmp_path, targets="board", sensors="lidar")
    assert problem.pairs == (("board_left_wall", "lidar_top-2"),)


def test_windows_line_ends_byte_order_mark_spaces_and_a_last_blank_line(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_bytes(b"\xef\xbb\xbf1, 0, 0, 0, 1, 2, 3\r\n0,1,0,0,4,5,6\r\n\r\n")
    np.testing.assert_array_equal(read_pose_rows(path), [[1, 0, 0, 0, 1, 2, 3], [0, 1, 0, 0, 4, 5, 6]])


@pytest.mark.parametrize(
    ("bad_line", "said"),
    [
        ("1,0,0,0,0.5,-0.25", ["6 fields in place of 7", "qw,qx,qy,qz,tx,ty,tz"]),
        ("1,0,0,0,0.5,-0.25,2,", ["8 fields in place of 7"]),
        ("1,0,0,0,0.5,abc,2", ["ty is 'abc'", "not a finite number"]),
        ("1,0,0,0,0.5,,2", ["ty is ''"]),
        ("1,0,0,0,0.5,1_0,2", ["ty is '1_0'"]),
        ("1,0,0,0,nan,0,2", ["tx is 'nan'"]),
        ("1,0,0,0,0,0,-inf", ["tz is '-inf'"]),
        ("", ["blank line"]),
        ("# 1,0,0,0,0,0,0", ["qw is '# 1'"]),
        ("0,0,0,0,1,2,3", ["norm 0 in place of 1"]),
        ("1,2,3,1,0,0,0", ["norm 3.87298"]),
        ("1,0,0,-1.7e308,0,0,0", ["norm inf in place of 1"]),
        ("1;0;0;0;1;2;3", ["1 fields in place of 7"]),
        ("1,0,0,0,1,2," + "3" * 10_000, ["longer than 10000 bytes"]),
        (",".join("0" * 5001), ["longer than 10000 bytes"]),
        ("1,0,0,0,1,2,\u0663", ["tz is '\u0663'"]),
    ],
)
@pytest.mark.parametrize("side", ["A", "B"])
def test_a_bad_line_is_named_with_its_file_and_number(
    tmp_path: Path, side: str, bad_line: str, said: list[str]
) -> None:
    good, bad = [GOOD] * 4, [GOOD, GOOD, bad_line, GOOD]
    write_pair(tmp_path, bad if side == "A" else good, bad if side == "B" else good)
    with pytest.raises(FileFormatError) as caught:
        rw.read_csv(tmp_path)
    for words in [f"tag_0_cam_0_{side}.csv, line 3:", *said]:
        assert words in str(caught.value)


def test_a_header_is_recognised(tmp_path: Path) -> None:
    write_pair(tmp_path, ["qw,qx,qy,qz,tx,ty,tz", GOOD], [GOOD])
    with pytest.raises(FileFormatError, match=r"A\.csv, line 1: .* If it is a header, delete it"):
        rw.read_csv(tmp_path)


@pytest.mark.parametrize("content", [b"", b"\n \n"])
def test_an_empty_file_is_named(demo: Path, content: bytes) -> None:
    (demo / "tag_2_cam_1_B.csv").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"tag_2_cam_1_B\.csv is empty"):
        rw.read_csv(demo)


def test_a_binary_file_is_named(demo: Path) -> None:
    (demo / "tag_2_cam_1_B.csv").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(FileFormatError, match=r"tag_2_cam_1_B\.csv is not a text file in UTF-8 \(byte 0\)"):
        rw.read_csv(demo)


@pytest.mark.parametrize(("missing", "there"), [("A", "B"), ("B", "A")])
def test_a_missing_file_of_a_pair_is_named(demo: Path, missing: str, there: str) -> None:
    (demo / f"tag_1_cam_2_{missing}.csv").unlink()
    with pytest.raises(FileFormatError, match=rf"tag_1_cam_2_{missing}\.csv is missing: tag_1_cam_2_{there}\.csv is"):
        rw.read_csv(demo)


def test_different_numbers_of_lines_are_named(demo: Path) -> None:
    path = demo / "tag_0_cam_0_B.csv"
    path.write_text("".join(path.read_text(encoding="utf-8").splitlines(keepends=True)[:-1]), encoding="utf-8")
    with pytest.raises(FileFormatError, match=r"tag_0_cam_0_A\.csv has 18 lines and .*tag_0_cam_0_B\.csv has 17"):
        rw.read_csv(demo)


def test_a_folder_without_such_files(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"no files named like tag_0_cam_0_A\.csv.*'tag'.*'cam'"):
        rw.read_csv(tmp_path)


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="does not exist"):
        rw.read_csv(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(FileFormatError, match="is a file"):
        rw.read_csv(tmp_path / "file")


def test_everything_that_is_not_read_is_counted_and_named(demo: Path) -> None:
    (demo / "notes.txt").write_text("x", encoding="utf-8")
    (demo / "tag_0_cam_0_C.csv").write_text(GOOD, encoding="utf-8")
    (demo / "old").mkdir()
    with pytest.warns(CsvWarning, match=r"3 entries .*: notes\.txt, old, tag_0_cam_0_C\.csv$") as caught:
        rw.read_csv(demo)
    assert caught[0].filename == __file__


def test_nothing_is_warned_of_in_clean_data() -> None:
    with warnings.catch_warnings(action="error"):
        rw.read_csv(DEMO)


def test_one_pair_under_both_orders_of_names(demo: Path) -> None:
    shutil.copy(demo / "tag_0_cam_0_A.csv", demo / "cam_0_tag_0_A.csv")
    with pytest.raises(FileFormatError, match="are both A of tag_0 and cam_0"):
        rw.read_csv(demo)


@pytest.mark.parametrize(("targets", "sensors"), [("", "cam"), ("tag", ""), ("tag", "tag"), ("cam", "cam_left")])
def test_words_that_cannot_be_told_apart(targets: str, sensors: str) -> None:
    with pytest.raises(FileFormatError, match=r"targets=|sensors="):
        rw.read_csv(DEMO, targets=targets, sensors=sensors)


def test_errors_of_the_problem_name_the_files(demo: Path) -> None:
    with pytest.raises(NoiseError, match=r"tag_0_cam_0_A\.csv and tag_0_cam_0_B\.csv"):
        rw.read_csv(demo, sigma=-1.0)


def test_quaternions_slightly_off_are_normalised(tmp_path: Path) -> None:
    write_pair(tmp_path, ["1.000001,0,0,0,0,0,0"], [GOOD])
    rotation = rw.read_csv(tmp_path).measurements("tag_0", "cam_0").A[0, :3, :3]
    np.testing.assert_array_equal(rotation, np.eye(3))


def test_no_loop_over_lines(tmp_path: Path) -> None:
    lines = 20_000
    write_pair(tmp_path, [GOOD] * lines, [GOOD] * lines)
    problem, calls = counted_calls(lambda: rw.read_csv(tmp_path, keep_measurements=False))
    assert problem.number_of_measurements == lines
    assert calls < lines / 2


@settings(max_examples=300, deadline=None)
@given(
    content=tables(7, GOOD).map(lambda text: text.encode(errors="surrogatepass")) | damaged([f"{GOOD}\n".encode() * 4])
)
def test_any_content_gives_rows_or_an_error_of_ours(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(content)
    try:
        rows = read_pose_rows(path)
    except FileFormatError as error:
        assert "any.csv" in str(error)  # noqa: PT017
        assert len(str(error)) < 2000  # noqa: PT017
    else:
        assert rows.shape == (content.decode("utf-8-sig").rstrip().count("\n") + 1, 7)
        assert np.isfinite(rows).all()


@settings(max_examples=50, deadline=None)
@given(name=st.text(st.sampled_from("tagcm_01AB.sv\n\x1b "), min_size=1, max_size=20))
def test_any_name_of_a_file_is_read_or_named_in_a_warning(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    folder = tmp_path_factory.mktemp("names")
    (folder / f"{name.strip('.') or 'x'}.csv").write_text(GOOD)
    with (
        warnings.catch_warnings(action="ignore", category=CsvWarning),
        pytest.raises(FileFormatError, match=r"is missing|has no files named"),
    ):
        rw.read_csv(folder)
