"""The sections of numbers: verdict, who determines whom, proof, residuals, uncertainty, contributions, inputs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from places import REPOSITORY
from refinement_problems import rig
from shown_numbers import numbers_of, wrong_numbers

import gtsam_rwhec as rw
from gtsam_rwhec.report.contribution_section import contribution_section
from gtsam_rwhec.report.determined_section import determines_section
from gtsam_rwhec.report.inputs_section import inputs_section
from gtsam_rwhec.report.proof_section import proof_section
from gtsam_rwhec.report.report_blocks import Block, Chart, CopyText, Table, plain_text
from gtsam_rwhec.report.report_page import read_shown
from gtsam_rwhec.report.residual_section import image_figure, residuals_section
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.report.uncertainty_section import uncertainty_section
from gtsam_rwhec.report.verdict_section import verdict_section
from gtsam_rwhec.results.evidence import evidence_json
from gtsam_rwhec.results.image_errors import SeenCamera

GOLDEN = REPOSITORY / "tests" / "golden"


MADE_BY = {
    "verdict": verdict_section,
    "determines": determines_section,
    "proof": proof_section,
    "uncertainty": uncertainty_section,
    "inputs": inputs_section,
}


def tables(blocks: tuple[Block, ...]) -> dict[str, Table]:
    return {block.caption: block for block in blocks if isinstance(block, Table)}


def texts(blocks: tuple[Block, ...]) -> dict[str, str]:
    return {block.name: block.text for block in blocks if isinstance(block, CopyText)}


def test_every_number_of_the_page_is_that_of_the_json(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    files = {name: json.loads((folder / name).read_text(encoding="utf-8")) for name in ("result.json", "evidence.json")}
    assert len(numbers_of(page)) > 150
    assert list(wrong_numbers(page, files)) == []


def test_poses_are_shown_in_metres_and_degrees(shown: ShownResult) -> None:
    assert shown.result is not None
    (of_sensors,) = (
        table for title, table in tables(MADE_BY["verdict"](shown).blocks).items() if title.startswith("Sensors")
    )
    assert of_sensors.headings[:7] == ("sensor", "x m", "y m", "z m", "roll°", "pitch°", "yaw°")
    assert shown.result.refined is not None
    for name, *cells in of_sensors.rows:
        pose = shown.result.refined.Y[str(name)]
        written = [float(plain_text(cell)) for cell in cells[:6]]
        assert written[:3] == pytest.approx(pose.translation(), abs=6e-5)
        assert written[3:] == pytest.approx(np.degrees(pose.rotation().rpy()), abs=6e-3)


def test_without_evidence_inputs_say_why(folder: Path) -> None:
    shown = ShownResult.of((folder / "result.json").read_bytes(), None)
    assert any("no evidence.json" in str(block) for block in MADE_BY["inputs"](shown).blocks)


def test_copied_python_is_the_pose_to_the_last_bit(shown: ShownResult) -> None:
    assert shown.result is not None
    assert shown.result.refined is not None
    found: dict[str, dict[tuple[str, str], np.ndarray]] = {}
    exec(texts(MADE_BY["inputs"](shown).blocks)["poses"], found)
    for name, pose in shown.result.refined.Y.items():
        assert gtsam.Pose3(found["POSES"]["sensorcarrier", name]).equals(pose, 0.0)


def test_copied_texts_of_poses_that_are_not_to_be_used_say_so() -> None:
    tree = json.loads((GOLDEN / "result_corners.json").read_bytes())
    tree |= {"verdict": "do_not_use", "verdict_reason": "they are\nmade up"}
    shown = replace(read_shown(GOLDEN / "result_corners.json"), tree=tree)
    texts_of = texts(MADE_BY["inputs"](shown).blocks)
    assert len(texts_of) == 4
    for text in texts_of.values():
        head = text[:200]
        assert "Do not use these poses: they are" in head
        assert "\nmade up" not in head


def test_names_that_other_programs_cannot_read_are_said(folder: Path, shown: ShownResult) -> None:
    tree = json.loads((folder / "result.json").read_bytes())
    tree["sensors"][0]["child"] = "<script>alert(1)</script>"
    found = MADE_BY["inputs"](replace(shown, tree=tree, evidence=None))
    assert texts(found.blocks) == {}
    assert "other programs cannot read them: '<script>alert(1)</script>' cannot be" in str(found)


def test_options_that_are_not_the_default_and_seeds_are_shown(shown: ShownResult) -> None:
    found = tables(MADE_BY["inputs"](shown).blocks)
    assert found["Options that are not the default"].rows == (("sizes", "'known'"),)
    assert "Seeds of random numbers" in found


@pytest.mark.parametrize("name", sorted(path.stem for path in GOLDEN.glob("result_*.json")))
def test_results_of_all_kinds_have_all_sections(name: str) -> None:
    shown = read_shown(GOLDEN / f"{name}.json")
    for each in MADE_BY:
        made = MADE_BY[each](shown)
        assert made.name == each
        assert made.blocks or made.missing
    assert any("in the frame" in title for title in tables(MADE_BY["verdict"](shown).blocks))


def test_a_calibration_without_an_answer_is_shown() -> None:
    tree = {
        "format": "gtsam-rwhec result",
        "format_version": 1,
        "written_by": "gtsam-rwhec 0.1.0",
        "verdict": "do_not_use",
        "verdict_reason": "there is no answer with a positive scale. What to do: look at A",
        "verdict_grounds": ["no_scale"],
        "sensors": [],
        "targets": [],
        "conventions": {},
        "calibration": {"findings": [], "choices": [], "points": [], "noise": "", "outliers": "", "notes": []},
    }
    shown = ShownResult.of(json.dumps(tree).encode(), None)
    assert "Look at A." in str(MADE_BY["verdict"](shown))
    for each in MADE_BY:
        assert MADE_BY[each](shown).blocks or MADE_BY[each](shown).missing


def test_a_file_that_is_no_result_is_refused() -> None:
    for content in (b"{", b"[]", b'{"verdict": "do_not_use", "verdict_reason": "x"}'):
        with pytest.raises(rw.errors.FileFormatError, match="is not a result"):
            ShownResult.of(content, None)


def test_the_grid_counts_measurements_and_tells_how_each_pair_is_determined(shown: ShownResult) -> None:
    (grid,) = (table for title, table in tables(MADE_BY["determines"](shown).blocks).items() if "Figure 8" in title)
    assert shown.result is not None
    alone = shown.result.solution.identifiability.pairs
    targets = grid.headings[1:]
    for sensor, *cells in grid.rows:
        for target, cell in zip(targets, cells, strict=True):
            pair = alone[rw.Pair(target, str(sensor))]
            assert isinstance(cell, tuple)
            assert str(cell[0]).startswith("■" if pair.is_unique else "□")
            assert cell[1].value == pair.number_of_measurements  # type: ignore[union-attr]


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_a_free_direction_is_said_with_the_motion_that_settles_it(tmp_path: Path) -> None:
    problem = rig(targets=1, sensors=1).problem
    (pair,) = problem.pairs
    raw = problem.measurements(*pair)
    still = rw.Problem()
    A = np.tile(raw.A[0], (10, 1, 1))
    A[:, :3, 3] += np.random.default_rng(0).standard_normal((10, 3))
    still.add(*pair, A, A, 0.01, 1e4)
    calibration = rw.calibrate(still)
    rw.write_calibration(calibration, tmp_path / "result.json")
    rw.results.write_evidence(rw.results.evidence_of(still, calibration), tmp_path / "evidence.json")
    shown = read_shown(tmp_path / "result.json")
    said = str(MADE_BY["determines"](shown))
    assert "the motion did not turn. Turn the carriers" in said
    assert "Not determined" in str(MADE_BY["verdict"](shown))
    assert "No frame has a finite" in str(MADE_BY["uncertainty"](shown))


def test_uncertainty_has_charts_and_points_and_says_what_is_missing(shown: ShownResult) -> None:
    found = MADE_BY["uncertainty"](shown)
    assert {"deviations", "correlation"} <= {block.name for block in found.blocks if isinstance(block, Chart)}
    points = tables(found.blocks)["How far off a point is, mm, by its distance"]
    assert points.headings == ("sensor", "expressed in", "0.5 m", "1 m", "2 m", "targets at m", "there")
    assert len(points.rows) == 2
    said = str(found.blocks)
    assert "no clock offset was estimated" in said
    assert "the answer is not from corners" in said


def test_what_intrinsics_would_do_names_the_frame_that_moves_most() -> None:
    found = MADE_BY["uncertainty"](read_shown(GOLDEN / "result_corners.json"))
    table = tables(found.blocks)["What intrinsics would do"]
    consequences = json.loads((GOLDEN / "result_corners.json").read_bytes())["refined"]["reprojection"]["consequences"]
    assert consequences
    for cause, frame, millimetres, *_ in table.rows:
        most = max((row for row in consequences if row["cause"] == cause), key=lambda row: row["translation_mm"])
        assert frame == most["frame"]
        assert millimetres.value == most["translation_mm"]  # type: ignore[union-attr]


def test_residuals_are_as_large_as_the_noise_and_images_could_be_left_out(shown: ShownResult) -> None:
    assert "Residuals are as large as the noise that was found" in str(residuals_section(shown))
    assert "could be left out" in str(contribution_section(shown))


def test_each_question_has_its_chart(shown: ShownResult) -> None:
    blocks = (*residuals_section(shown).blocks, *contribution_section(shown).blocks)
    charts = {block.name for block in blocks if isinstance(block, Chart)}
    assert charts == {
        "residuals-by-pair",
        "residuals-by-time",
        "residuals-by-configuration",
        "residuals-against-noise",
        "contribution-curve",
    }


def test_without_evidence_the_sections_say_why(shown: ShownResult) -> None:
    bare = replace(shown, evidence=None)
    for section in (residuals_section(bare), contribution_section(bare)):
        assert section.missing == "the result has no evidence.json beside it."


def test_arrows_over_the_image_point_where_corners_are_off() -> None:
    rng = np.random.default_rng(5)
    x, y = rng.uniform(0.0, 640.0, 400), rng.uniform(0.0, 480.0, 400)
    camera = SeenCamera(
        sensor="cam", width=640, height=480, images=4, corners=400, cells=((400,),), share=1.0, rms_px=1.0,
        noise_px=0.1, at_optimum=True, x=tuple(x), y=tuple(y), dx=tuple(np.full(400, 0.25)), dy=tuple(np.zeros(400)),
    )  # fmt: skip
    assert "cam: longest 0.25 px" in image_figure((camera,)).in_page


def test_evidence_of_numbers_without_bounds_is_refused(shown: ShownResult, tmp_path: Path) -> None:
    """Found by damaging a file: 1e308 was read, and the page ended in a ValueError of its chart."""
    assert shown.evidence is not None
    tree = json.loads(evidence_json(shown.evidence))
    path = tmp_path / "evidence.json"
    for value, is_refused in ((1e308, True), (1e59, False)):
        tree["residuals"]["pairs"][0]["normalised"][0][0] = value
        path.write_text(json.dumps(tree), encoding="utf-8")
        if is_refused:
            with pytest.raises(rw.errors.FileFormatError, match="normalised"):
                rw.results.read_evidence(path)
        else:
            assert residuals_section(replace(shown, evidence=rw.results.read_evidence(path))).blocks
