"""What a person reads about a calibration, on terminals of any width and in files."""

from __future__ import annotations

import dataclasses
import io
import math
import re
from pathlib import Path

import gtsam
import numpy as np
import pytest
from places import DEMO
from rich.console import Console

import gtsam_rwhec as rw
from gtsam_rwhec.report import certificate_sentence, print_solution, sensor_table
from gtsam_rwhec.report.pose_table import pooled_residual
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import Cause
from gtsam_rwhec.solver.certificate import Basis
from gtsam_rwhec.solver.region import Region

NOISE = Noise(sigma_m=0.005, kappa=6000.0)


@pytest.fixture(scope="module")
def demo_solution() -> rw.Solution:
    """The demo's calibration."""
    return rw.solve(rw.read_csv(DEMO, sigma=0.005, kappa=6565.0))


def printed(solution: rw.Solution, width: int = 80, *, terminal: bool = False) -> str:
    """The report as printed, without colours."""
    stream = io.StringIO()
    console = Console(file=stream, width=width, force_terminal=terminal, color_system=None, highlight=False)
    print_solution(solution, console)
    return stream.getvalue()


def test_every_frame_has_its_pose_and_residuals(demo_solution: rw.Solution) -> None:
    lines = printed(demo_solution).splitlines()
    for name, pose in (*demo_solution.X.items(), *demo_solution.Y.items()):
        (line,) = [line for line in lines if line.startswith(f" {name} ")]
        cells = [float(cell) for cell in line.split()[1:]]
        np.testing.assert_allclose(cells[:3], pose.translation(), atol=0.51e-4)
        np.testing.assert_allclose(cells[3:6], np.degrees(pose.rotation().rpy()), atol=0.51e-2)
        residuals = [residual for pair, residual in demo_solution.residuals.items() if name in pair]
        assert cells[8] == sum(residual.number_of_measurements for residual in residuals)
        assert 5.0 < cells[6] < 12.0  # mm; sqrt(3) * 5 mm = 8.7 mm before the fit
        assert 0.5 < cells[7] < 1.2  # degrees; sqrt(3) * 0.5


def test_it_says_what_its_angles_and_units_are(demo_solution: rw.Solution) -> None:
    assert "R = Rz(yaw) Ry(pitch) Rx(roll)" in printed(demo_solution)
    roll, pitch, yaw = demo_solution.Y["cam_2"].rotation().rpy()
    rotation = gtsam.Rot3.Rz(yaw) * gtsam.Rot3.Ry(pitch) * gtsam.Rot3.Rx(roll)
    assert rotation.equals(demo_solution.Y["cam_2"].rotation(), 1e-12)


def test_the_whole_fits_a_terminal_of_80_columns(demo_solution: rw.Solution) -> None:
    text = printed(demo_solution, 80, terminal=True)
    assert max(len(line) for line in re.sub(r"\x1b\[[0-9;]*m", "", text).splitlines()) <= 80
    assert "…" not in text


@pytest.mark.parametrize("width", [20, 40, 60, 80, 120])
@pytest.mark.parametrize("scale", ["known", "per_target"])
def test_no_number_and_no_name_is_ever_cut(width: int, scale: rw.ScaleMode) -> None:
    known = ["target0"] if scale == "per_target" else []
    solution = rw.solve(general(3, 2, seed=5, noise=NOISE, scale=scale, known_sizes=known).problem)
    text = printed(solution, width)
    assert "…" not in text
    words = re.sub(r"[\s,]+", " ", text)
    for name, pose in (*solution.X.items(), *solution.Y.items()):
        assert name in words
        for number in pose.translation():
            assert f"{number:.4f}" in words
    if isinstance(solution.scale, dict):
        for number in solution.scale.values():
            assert f"{number:.5f}" in words


def test_a_file_gets_one_line_for_each_sentence(demo_solution: rw.Solution) -> None:
    (line,) = [line for line in printed(demo_solution).splitlines() if line.startswith("Certified globally optimal")]
    assert line == certificate_sentence(demo_solution.certificate)
    assert f"{demo_solution.certificate.cost:.10g}" in line
    assert f"{demo_solution.certificate.lower_bound:.10g}" in line


def test_unit_weights_are_called_relative(demo_solution: rw.Solution) -> None:
    assert "costs and covariances are relative" in printed(rw.solve(rw.read_csv(DEMO)))
    assert "relative." not in printed(demo_solution)


def test_where_no_noise_was_stated_the_residuals_are_to_be_looked_at(demo_solution: rw.Solution) -> None:
    line = "Look at the residuals, in mm and degrees, before you trust the poses: no noise was stated."
    assert printed(rw.solve(rw.read_csv(DEMO))).splitlines()[1] == line
    assert line not in printed(demo_solution)


def test_the_time_is_the_sum_of_the_stages(demo_solution: rw.Solution) -> None:
    (line,) = [line for line in printed(demo_solution).splitlines() if line.startswith("Time of")]
    assert f"Time of the certified solution alone: {sum(demo_solution.certificate.seconds.values()):.3f} s" in line
    for stage in demo_solution.certificate.seconds:
        assert stage in line


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.NotUniqueWarning")
def test_free_directions_are_printed_as_not_to_be_used() -> None:
    solution = rw.solve(general(2, 2, seed=5, motion="planar", noise=NOISE).problem)
    text = printed(solution)
    assert "Certified, but not unique" in text
    assert text.startswith("Do not use these poses: ")
    for direction in solution.identifiability.free_directions:
        assert f"  - Not determined: {direction}" in text


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.NotUniqueWarning")
def test_a_bound_with_a_region_claims_no_more() -> None:
    """The verdict comes first, and one short sentence says where the bound holds."""
    solution = rw.solve(general(2, 2, seed=5, motion="planar", scale="shared", noise=NOISE).problem)
    region = solution.certificate.region
    assert region is not None
    lines = printed(solution).splitlines()
    assert lines[0].startswith("Do not use these poses: ")
    (line,) = [line for line in lines if line.startswith("Certified, but not unique")]
    assert f"no answer within {region.distance} can cost less" in line
    assert line.endswith(
        f"up to noise. The bound holds for translations within {region.distance} of the answer's, and for unknown "
        f"scales within a factor of {region.factor}."
    )


def test_what_a_bound_is_not_about_is_said(demo_solution: rw.Solution) -> None:
    whole = certificate_sentence(demo_solution.certificate)
    assert "and no answer can cost less" in whole
    of_moments = certificate_sentence(dataclasses.replace(demo_solution.certificate, basis=Basis.MOMENTS))
    assert of_moments.startswith(whole)
    assert of_moments.endswith(
        " It is of the moments: the measurements were not kept, so the rounding of the sums is not in it."
    )
    region = certificate_sentence(dataclasses.replace(demo_solution.certificate, region=Region(300.0, 100.0)))
    assert "no answer within 300 m can cost less" in region


def test_a_gap_is_printed_with_its_reason(demo_solution: rw.Solution) -> None:
    certificate = dataclasses.replace(
        demo_solution.certificate,
        status=rw.Status.GAP,
        lower_bound=300.0,
        cause=Cause.NOT_TIGHT,
        figures={"relaxation_cost": 300.0},
    )
    sentence = certificate_sentence(certificate)
    assert sentence.startswith("Not certified: this answer costs 368.6")
    assert "cannot" not in sentence or "less than 300 " in sentence
    assert "the relaxation is not tight: its own optimum is 300, below the best answer's 368.6" in sentence


def test_a_failure_claims_no_bound(demo_solution: rw.Solution) -> None:
    certificate = dataclasses.replace(
        demo_solution.certificate, status=rw.Status.FAILED, lower_bound=-math.inf, cause=Cause.NO_BOUND
    )
    assert "inf" not in certificate_sentence(certificate)
    assert certificate_sentence(certificate).endswith("; no finite lower bound was found.")


def test_a_shared_scale_is_explained(utias_folder: Path) -> None:
    solution = rw.solve(rw.read_csv(utias_folder, scale="shared", sigma=1.0, kappa=1.0))
    assert "Scale: 1.025" in printed(solution)
    assert "measured lengths are 2.5" in printed(solution)


def test_unconnected_parts_are_named() -> None:
    text = printed(rw.solve(general(2, 2, seed=5, graph=[(0, 0), (1, 1)], noise=NOISE).problem))
    assert "2 unconnected parts" in text
    assert "  - sensor0, target0: Certified globally optimal" in text


def test_residuals_are_pooled_by_measurements() -> None:
    pooled = pooled_residual([rw.Residual(1, 3.0, 0.1), rw.Residual(3, 1.0, 0.3)])
    assert pooled.number_of_measurements == 4
    assert pooled.translation_rms_m == pytest.approx(math.sqrt((9.0 + 3.0) / 4.0))
    assert pooled.rotation_rms_rad == pytest.approx(math.sqrt((0.01 + 3 * 0.09) / 4.0))


def test_a_frame_without_measurements_has_no_residual(demo_solution: rw.Solution) -> None:
    table = sensor_table(dataclasses.replace(demo_solution, residuals={}))
    assert table.rows["cam_0"][-3:] == ("-", "-", "0")


def test_frame_names_are_not_taken_for_markup(demo_solution: rw.Solution) -> None:
    odd = dataclasses.replace(demo_solution, X={"[bold]tag[/]": demo_solution.X["tag_0"]})
    assert "[bold]tag[/]" in printed(odd)
