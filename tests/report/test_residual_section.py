"""The sections of residuals and of what each image contributed: their numbers, words and charts."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.report.contribution_section import contribution_section
from gtsam_rwhec.report.report_blocks import Chart
from gtsam_rwhec.report.residual_section import image_figure, residuals_section
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.evidence import evidence_json
from gtsam_rwhec.results.image_errors import SeenCamera


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
