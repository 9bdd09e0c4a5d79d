"""What a person reads about a refinement from corners: errors, intrinsics, boards, and what errors would do."""

from __future__ import annotations

import dataclasses
import io
import re

import pytest
from refined_corners import two_cameras
from rich.console import Console

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.reprojection_record import Consequence, Intrinsics
from gtsam_rwhec.report import print_corners
from gtsam_rwhec.report.corners_section import corners_section, errors_table, intrinsics_sentences, intrinsics_table
from gtsam_rwhec.report.report_blocks import Chart, Table
from gtsam_rwhec.report.shown_result import ShownResult


@pytest.fixture(scope="module")
def refined() -> Refined:
    return two_cameras()[2]


def printed(refined: Refined, width: int = 160, *, terminal: bool = False) -> str:
    stream = io.StringIO()
    print_corners(refined, Console(file=stream, width=width, force_terminal=terminal, color_system=None))
    return re.sub(r"\x1b\[[0-9;]*m", "", stream.getvalue())


def rows_of(table: Table) -> dict[str, tuple[str, ...]]:
    return {str(name): tuple(map(str, cells)) for name, *cells in table.rows}


def changed(refined: Refined, **of_cam_0: object) -> Refined:
    cam_0: Intrinsics = dataclasses.replace(refined.intrinsics["cam_0"], **of_cam_0)  # type: ignore[arg-type]
    return dataclasses.replace(refined, intrinsics={**refined.intrinsics, "cam_0": cam_0})


def test_it_is_a_section_of_the_page_and_nothing_without_corners(refined: Refined) -> None:
    section = corners_section(ShownResult.of_answer(refined))
    figures = [block for block in section.blocks if isinstance(block, Chart)]
    assert [figure.name for figure in figures] == ["intrinsics"]
    assert "cam_1" in figures[0].svg.in_page
    poses = dataclasses.replace(refined, reprojection=None, intrinsics={})
    assert printed(poses) == ""


@pytest.mark.parametrize("width", [50, 80, 160])
def test_nothing_is_cut_and_nothing_sticks_out(refined: Refined, width: int) -> None:
    text = printed(refined, width, terminal=True)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    words = re.sub(r"[\s,]+", " ", text)
    for name in ("cam_0 fx", "cam_1 p2", "0.612 px: A's noise estimated and sizes as stated (chosen)"):
        assert name in words


def test_errors_and_numbers_are_those_of_the_result(refined: Refined) -> None:
    assert refined.reprojection is not None
    (cells,) = (row[1:] for row in errors_table(refined.reprojection).rows if row[0] == "cam_1")
    of = refined.reprojection.sensors["cam_1"]
    assert cells[:3] == (str(of.images), str(of.corners), "0")
    numbers = [of.rms_px, of.held_out_mm, of.held_out_px, of.expected_px]
    assert [float(str(cell)) for cell in cells[3:]] == pytest.approx(numbers, abs=6e-4)
    rows = rows_of(intrinsics_table(refined))
    assert len(rows) == 16
    cam = refined.intrinsics["cam_0"]
    found, deviation, stated, known = (float(cell) for cell in rows["cam_0 fx"][:4])
    assert found == pytest.approx(cam.values[0], abs=0.06)
    assert deviation == pytest.approx(cam.standard_deviations[0], rel=0.06)
    for ending in ("x", "y", "k1", "k2", "p1", "p2"):  # points line up: as many decimals for each kind of parameter
        cells = [row[0] for name, row in rows.items() if name.endswith(ending)]
        assert len({len(cell.partition(".")[2]) for cell in cells}) == 1
    assert (stated, known) == pytest.approx((cam.stated[0], cam.stated_deviations[0]), abs=0.06)


def test_worse_predictions_than_expected_are_said(refined: Refined) -> None:
    assert refined.reprojection is not None
    of = refined.reprojection.sensors["cam_0"]
    for expected_px, is_said in ((0.5, True), (0.7, False), (None, False)):
        one = dataclasses.replace(of, held_out_px=1.0, expected_px=expected_px)
        found = dataclasses.replace(refined.reprojection, sensors={"cam_0": one})
        text = printed(dataclasses.replace(refined, reprojection=found))
        assert ("cam_0: images that were left out are predicted 2 times worse than expected." in text) is is_said


def test_intrinsics_say_how_they_were_stated_and_what_the_images_do_not_tell(refined: Refined) -> None:
    agree = intrinsics_sentences(changed(refined, innovation_deviations=0.81, held_by_prior=()))[0]
    assert "the images agree with it (0.8 deviations off)" in agree
    held = changed(refined, stated_as="calibration", widened=3.2, innovation_deviations=7.0, held_by_prior=("k2", "p1"))
    assert intrinsics_sentences(held)[0] == (
        "cam_0: estimated, with a prior from what was stated (a calibration's); the images are 7.0 deviations "
        "off, so the prior was widened 3.2 times; the images do not determine k2, p1: only the prior holds them."
    )
    assert rows_of(intrinsics_table(held))["cam_0 k2"][-1] == "stated"
    assert rows_of(intrinsics_table(held))["cam_0 k1"][-1] == "images"
    unknown = changed(refined, stated_as="unknown", held_by_prior=("k2",))
    assert intrinsics_sentences(unknown)[0] == (
        "cam_0: no stated ones count, so the images alone tell them; the images do not determine k2: nothing else "
        "tells them."
    )
    assert rows_of(intrinsics_table(unknown))["cam_0 fx"][2:] == ("-", "-", "images")
    assert rows_of(intrinsics_table(unknown))["cam_0 k2"][2:] == ("-", "-", "nothing")
    exact = changed(refined, stated_as="exact", held_by_prior=refined.intrinsics["cam_0"].names)
    assert "they count as exact" in intrinsics_sentences(exact)[0]
    assert {row[-1] for name, row in rows_of(intrinsics_table(exact)).items() if "cam_0" in name} == {"stated"}


def test_a_camera_is_told_once_and_one_that_was_kept_is_told_too(refined: Refined) -> None:
    shared = changed(refined, shared_with=("cam_1",))
    assert [s.partition(":")[0] for s in intrinsics_sentences(shared) if "prior" in s] == ["cam_0, cam_1"]
    assert len(intrinsics_table(shared).rows) == 8
    kept = dataclasses.replace(refined, intrinsics={"cam_0": refined.intrinsics["cam_0"]})
    said = "cam_1: the intrinsics count as exact, as stated; they were not estimated."
    assert said in intrinsics_sentences(kept)


def test_a_camera_that_was_calibrated_from_a_corner_of_its_image_says_so(refined: Refined) -> None:
    assert refined.reprojection is not None
    seen = ((0.2, None, None),) + ((None,) * 3,) * 2
    sensors = {"cam_0": dataclasses.replace(refined.reprojection.sensors["cam_0"], regions_px=seen)}
    part = dataclasses.replace(refined, reprojection=dataclasses.replace(refined.reprojection, sensors=sensors))
    far = ((0.2, 0.4, 0.9), (0.3, 0.8, 2.0), (0.9, 2.0, 14.2))
    assert (
        "cam_0: projections are uncertain by up to 14 px in 3 of 9 parts of the image (rms over a part), and by 0.2 "
        "px in the best part; no corner was seen in 3 of these: take images with a target there, or do not use these "
        "parts."
    ) in intrinsics_sentences(changed(part, projection_px=far))
    for even in ((0.2, 0.4, 0.99), (0.3, 1.2, 1.4), (None, None, None)):
        said = intrinsics_sentences(changed(part, projection_px=(even,)))
        assert not any("uncertain" in sentence for sentence in said)


def test_a_steps_result_says_its_figures_and_where_a_report_is() -> None:
    _, corners, _ = two_cameras()
    with pytest.raises(OptionError, match=r'is a CornersRefined; give what rw.refine.*observations="corners"'):
        print_corners(corners)  # type: ignore[arg-type]
    assert f"cam_0 {corners.intrinsics['cam_0'].rms_px:.3f}" in str(corners)
    assert all(finding in str(corners) for finding in corners.findings)


def test_records_are_sentences(refined: Refined) -> None:
    assert refined.reprojection is not None
    text = str(refined.reprojection)
    number = sum(of.corners for of in refined.reprojection.sensors.values())
    assert text.startswith(f"The poses are refined from {number} corners in ")
    assert "The carriers' poses A were refined too; their noise, as the corners show it: " in text
    exact = dataclasses.replace(refined.reprojection, carrier_poses="exact")
    assert str(exact).endswith("The carriers' poses A count as exact.")
    board = str(refined.reprojection.boards["board"])
    scale = refined.scale["board"] if isinstance(refined.scale, dict) else refined.scale
    assert f"its stated size is {abs(100.0 * (scale - 1.0)):.3f} ± " in board
    assert ("too large" in board) is (scale > 1.0)
    moved = Consequence("cam_0", "1 pixel of cam_0's cx", 0.0351, 0.213)
    assert str(moved) == "1 pixel of cam_0's cx would move cam_0 by 0.21 mm and 0.035 degrees"
