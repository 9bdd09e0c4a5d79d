"""Every example runs, says what it found and leaves a picture; at reduced sizes, so that none rots."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from places import EXAMPLES

#: Arguments that make it quick, and what must be in its output.
RUNS = {
    "certify_a_rig": ([], r"Proven: [^$]*certified: cost 368\.6"),
    "noise_sweep": (["--runs", "2", "--degrees", "2", "60"], r"shared\s+20\s+2\s+100"),
    "tightness_neighbourhood": (["--problems", "2", "--step", "45"], "all constraints: the first loss at"),
    "sparsity": (["--leaves", "2", "4"], r"8 Y: .* 8 to 36\n8 X: .* 8 to 8\n"),
    "certify_other_solver": (["--runs", "4"], "After local descent: certified"),
    "covariance_report": ([], r"Not determined: translation of .*cam_0 along its own y axis[^$]*cam_1 .* free "),
    "log_in_a_viewer": ([], "certified: cost 1"),
    "slam_graph": ([], r"Batch and iSAM2 agree to [\d.]+e-0[4-9] mm"),
}
#: The papers' tables and figures: likewise.
PAPERS = {
    "dq_table_1": (["--runs", "4"], r"DQNLOpt +\| planar .*\| DQOpt +\| from poses"),
    "dq_table_2": (["--runs", "2", "--slow-runs", "2", "--alphas", "4"], r"Linear, best translation alpha.* of 1\d"),
    "dq_figure_2": (["--runs", "50"], r"number 16: 8, 6, 4, 6, 4, 2, 0"),
    "dq_figure_3": (["--runs", "2"], r"Random +\| 1 +\| translation"),
    "dq_figure_6": (["--runs", "2"], r"DQConvRlx \| rotation +\| +11.50"),
    "rwhec_tables": (["--runs", "2", "--tables", "5", "--model", "released"], r"Ours .*\| paper .*1\.46 \+- 0\.61"),
}
#: They hold the paper's numbers and judge the same runs at 1,000 of each; rwhec_tables prints the tables.
JUDGES = {"lom_tables", "method_tables", "tables_2_to_5"}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a script that leaves a picture, in this process: to import all once more takes longer than most examples."""

    def run(script: Path, *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [str(script), *arguments])
        monkeypatch.syspath_prepend(script.parent)
        runpy.run_path(str(script), run_name="__main__")
        assert (tmp_path / f"{script.stem}.png").read_bytes().startswith(b"\x89PNG")
        return capsys.readouterr().out

    return run


@pytest.mark.usefixtures("without_figures")  # of the report; its own picture is drawn
@pytest.mark.parametrize("name", RUNS)
def test_an_example_runs(name: str, run: Callable[..., str], tmp_path: Path) -> None:
    arguments, expected = RUNS[name]
    output = run(EXAMPLES / f"{name}.py", "--save", str(tmp_path), *arguments)
    assert re.search(expected, output), output


@pytest.mark.parametrize("name", PAPERS)
def test_a_table_or_figure_of_the_papers(name: str, run: Callable[..., str], tmp_path: Path) -> None:
    arguments, expected = PAPERS[name]
    output = run(EXAMPLES / "papers" / f"{name}.py", "--workers", "1", "--output", str(tmp_path), *arguments)
    assert re.search(expected, output, re.DOTALL), output
    assert (tmp_path / f"{name}.md").read_text(encoding="utf-8") in output


def test_all_of_the_papers_are_run_by_one_command() -> None:
    listed = re.search(r"SCRIPTS = \((.*?)\)", (EXAMPLES / "papers" / "all.py").read_text(encoding="utf-8"), re.DOTALL)
    assert listed is not None
    assert set(re.findall(r'"(\w+)"', listed[1])) == set(PAPERS)
    scripts = [p.stem for p in (EXAMPLES / "papers").glob("*.py") if "__main__" in p.read_text(encoding="utf-8")]
    assert set(scripts) == {*PAPERS, *JUDGES, "all"}


def test_the_grid_of_figure_8(utias_folder: Path, run: Callable[..., str], tmp_path: Path) -> None:
    output = run(EXAMPLES / "figure_8_grid.py", "--save", str(tmp_path), str(utias_folder))
    assert "certified: cost 8.2812454" in output
    assert "The whole is determined." in output


def printed(name: str, folder: Path) -> str:
    """What an example prints that is run in a folder."""
    words = [sys.executable, str(EXAMPLES / name)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", ["one_call.py", "certified_init_then_refine.py"])
def test_an_example_is_short(name: str) -> None:
    assert len((EXAMPLES / name).read_text(encoding="utf-8").splitlines()) < 30


def test_one_call_leaves_the_outliers_out(tmp_path: Path) -> None:
    said = printed("one_call.py", tmp_path)
    assert said.startswith("Use these poses: ")
    assert "Outliers: 6 of 60 measurements were left out" in said
    assert "A point 0.80 m from camera, expressed in hand, is within" in said


def test_corners_give_the_pose_though_the_stated_intrinsics_are_off(tmp_path: Path) -> None:
    said = printed("from_corners.py", tmp_path)
    assert said.startswith("Use these poses: ")
    assert re.search(r"Refinement: from 2\d{3} corners .* with A's noise estimated", said)
    off_mm = re.search(r"The camera is ([\d.]+) mm from where it is", said)
    assert off_mm is not None
    assert float(off_mm[1]) < 0.5  # 6 mm by the poses


def test_certified_start_then_refinement_goes_on(tmp_path: Path) -> None:
    said = printed("certified_init_then_refine.py", tmp_path)
    assert "certified: cost 368.6" in said
    assert said.endswith(" 126.5 mm with the ruler.\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_vehicle_without_targets_needs_heights(tmp_path: Path) -> None:
    script = EXAMPLES / "vehicle_odometries.py"
    done = subprocess.run([sys.executable, str(script), str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    without, _, with_heights = done.stdout.partition("With heights:")
    assert "Do not use these poses: the heights of lidar_rear, camera_left and wheels over lidar_front" in without
    assert "Use these poses: the motions of all sensors agree" in with_heights
    assert all(float(off) < 40.0 for off in re.findall(r" is (\d+) mm and ", with_heights))
    assert (tmp_path / "with_heights" / "tf.yaml").exists()


def test_no_example_is_left_out() -> None:
    scripts = {path.stem for path in EXAMPLES.glob("*.py")} - {"figures"}
    assert scripts == set(RUNS) | {"figure_8_grid", "certified_init_then_refine", "from_corners", "one_call"} | {
        "vehicle_odometries"
    }


def test_committed_pictures_are_small_and_made_by_an_example() -> None:
    for picture in (EXAMPLES / "pictures").glob("*.png"):
        assert (EXAMPLES / f"{picture.stem}.py").is_file(), f"{picture.name}: nothing makes it"
        assert picture.stat().st_size < 150_000, f"{picture.name} is larger than 150 kB"
