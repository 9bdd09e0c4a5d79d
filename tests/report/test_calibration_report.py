"""What a person reads about solutions, refinements and calibrations: all that their page says, at any width."""

from __future__ import annotations

import dataclasses
import io
import math
import re
from typing import Any

import numpy as np
import pytest
from places import DEMO, GOLDEN
from refinement_problems import copied, refined, rig
from rich.console import Console

import gtsam_rwhec as rw
from gtsam_rwhec.report import certificate_sentence, print_calibration, print_refined, print_solution
from gtsam_rwhec.report.calibration_report import deviation_cells, proof_line, scales_and_clocks
from gtsam_rwhec.report.choices_section import log_blocks
from gtsam_rwhec.report.report_blocks import Paragraph, Table, plain_text
from gtsam_rwhec.report.terminal_report import TerminalTable
from gtsam_rwhec.results.log_history import RemovalReason, TrackCount
from gtsam_rwhec.results.residual_evidence import pooled_residual
from gtsam_rwhec.simulate import Motion, Noise, general
from gtsam_rwhec.solver.certificate import Basis, Cause, Status
from gtsam_rwhec.solver.region import Region

NOISE = Noise(sigma_m=0.005, kappa=6000.0)


def test_a_standard_deviation_is_never_printed_as_zero() -> None:
    deviations = np.array([*np.radians([2.0, 0.0123, 0.0004]), 1e-3, 1.2e-5, 3.4e-6])
    assert deviation_cells(np.diag(deviations**2)) == ("1.00", "0.01", "0.003", "2.000", "0.012", "0.0004")


def printed(answer: Any, width: int = 160, *, terminal: bool = False, **options: Any) -> str:
    """All of the report, without colours."""
    stream = io.StringIO()
    console = Console(file=stream, width=width, force_terminal=terminal, color_system=None, highlight=False)
    if isinstance(answer, rw.Calibration):
        print_calibration(answer, console, verbose=True, **options)
    else:
        (print_refined if isinstance(answer, rw.Refined) else print_solution)(answer, console, **options)
    return re.sub(r"\x1b\[[0-9;]*m", "", stream.getvalue())


def row_of(text: str, name: str, heading: str = "") -> list[str]:
    """The cells of the first row of a name after a heading."""
    lines = text[text.index(heading) :].splitlines()
    return next(line for line in lines if line.startswith(f" {name} ")).split()[1:]


@pytest.fixture(scope="module")
def solution() -> rw.Solution:
    """The demo's certified solution."""
    return rw.solve(rw.read_csv(DEMO, sigma=0.005, kappa=6565.0))


@pytest.fixture(scope="module")
def scales() -> rw.Refined:
    """Two sensors, three targets, two of whose sizes are unknown."""
    problem = general(3, 2, seed=5, noise=NOISE, scale="per_target", known_sizes=["target0"]).problem
    return refined(problem, noise="estimate")


@pytest.fixture(scope="module")
def planar() -> rw.Refined:
    """Turned about one axis only: something of every frame is free."""
    return refined(general(2, 2, seed=5, noise=NOISE, motion=Motion("planar")).problem)


def test_every_frame_has_its_pose_and_residuals(solution: rw.Solution) -> None:
    text = printed(solution)
    for name, pose in (*solution.X.items(), *solution.Y.items()):
        cells = [float(cell) for cell in row_of(text, name)]
        np.testing.assert_allclose(cells[:3], pose.translation(), atol=0.51e-4)
        np.testing.assert_allclose(cells[3:6], np.degrees(pose.rotation().rpy()), atol=0.51e-2)
        mm, degrees, n = map(float, row_of(text, name, "Residuals of the certified answer"))
        assert n == sum(one.number_of_measurements for pair, one in solution.residuals.items() if name in pair)
        assert 5.0 < mm < 12.0  # sqrt(3) * 5 mm = 8.7 mm before the fit
        assert 0.5 < degrees < 1.2  # sqrt(3) * 0.5


def test_deviations_are_the_refined_ones(scales: rw.Refined) -> None:
    text = printed(scales)
    for name in scales.Y:
        degrees, millimetres = scales.standard_deviations(name)
        cells = [float(cell) for cell in row_of(text, name)]
        np.testing.assert_allclose(cells[6:9], millimetres, atol=0.0051)
        np.testing.assert_allclose(cells[9:12], degrees, atol=0.00051)


@pytest.mark.parametrize("width", [40, 60, 80, 160])
@pytest.mark.parametrize("kind", ["solution", "scales", "planar"])
def test_nothing_is_cut_and_nothing_sticks_out(width: int, kind: str, request: pytest.FixtureRequest) -> None:
    answer = request.getfixturevalue(kind)
    text = printed(answer, width, terminal=True)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    words = re.sub(r"[\s,]+", " ", text)
    for name, pose in (*answer.X.items(), *answer.Y.items()):
        assert name in words
        for number in pose.translation():
            assert f" {number:z.4f} " in words


def test_a_number_stays_with_its_heading_on_a_narrow_terminal() -> None:
    table = Table.of("Poses", "sensor", [f"h{i}" for i in range(9)], {"cam": tuple(f"{i}.12345" for i in range(9))})
    stream = io.StringIO()
    Console(file=stream, width=40).print(TerminalTable(table))
    assert [len(re.findall(r"h\d \d\.12345", line)) for line in stream.getvalue().splitlines()[1:4]] == [3, 3, 3]


def test_signs_differ_without_their_shapes_too() -> None:
    table = Table("Grid", ("sensor", "tag"), (("a", "■ 3"), ("b", "□ 2"), ("c", "·")))
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    Console(file=stream, width=40).print(TerminalTable(table, tight=True))
    stream.seek(0)
    assert [re.findall(r"[#o.]", line) for line in stream.read().splitlines()[-3:]] == [["#"], ["o"], ["."]]


def test_a_sentence_is_one_line_in_a_file(solution: rw.Solution) -> None:
    (line,) = [line for line in printed(solution, 80).splitlines() if "Cost of the answer" in line]
    assert f"{solution.certificate.cost:.8g}" in line
    (line,) = [line for line in printed(solution).splitlines() if "Time of" in line]
    assert all(stage in line for stage in solution.certificate.seconds)


def test_weights_that_were_not_stated_are_said(solution: rw.Solution) -> None:
    relative = printed(rw.solve(rw.read_csv(DEMO)))
    assert "no noise was stated" in relative
    assert "no statistical meaning" in relative
    assert "no noise was stated" not in printed(solution)


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.NotUniqueWarning")
def test_free_directions_come_with_their_cures(planar: rw.Refined) -> None:
    for answer in (rw.solve(general(2, 2, seed=5, motion="planar", noise=NOISE).problem), planar):
        text = printed(answer)
        assert text.startswith("Do not use these poses: ")
        free = answer.free_directions if isinstance(answer, rw.Refined) else answer.identifiability.free_directions
        assert free
        assert all(f"Not determined: {direction}" in text for direction in free)
    assert "free" in row_of(text, "sensor0")[6:9]
    assert "nan" not in text
    assert "inf" not in text.replace("infinite", "").replace("information", "")


def test_unconnected_parts_are_named() -> None:
    text = printed(rw.solve(general(2, 2, seed=5, graph=[(0, 0), (1, 1)], noise=NOISE).problem))
    assert "2 unconnected parts" in text
    assert re.search(r"(sensor0, target0|target0, sensor0) +certified", text)


def test_names_are_not_taken_for_markup(solution: rw.Solution) -> None:
    raw = rw.Problem()
    B = general(1, 1, seed=5, noise=NOISE).problem.measurements("target0", "sensor0")
    raw.add("[bold]tag[/]", "cam", B.A, B.B, sigma=0.005, kappa=6000.0)
    assert "[bold]tag[/]" in printed(rw.solve(raw))


def test_what_a_bound_is_about_is_said(solution: rw.Solution) -> None:
    certificate = solution.certificate
    whole = certificate_sentence(certificate)
    assert whole.startswith("Certified globally optimal")
    assert f"{certificate.cost:.10g}" in whole
    of_moments = certificate_sentence(dataclasses.replace(certificate, basis=Basis.MOMENTS))
    assert of_moments.startswith(whole)
    assert "moments" in of_moments
    region = certificate_sentence(dataclasses.replace(certificate, region=Region(300.0, 100.0)))
    assert "no answer within 300 m can cost less" in region
    gap = dataclasses.replace(
        certificate, status=rw.Status.GAP, cause=Cause.NOT_TIGHT, lower_bound=300.0, figures={"relaxation_cost": 300.0}
    )
    assert certificate_sentence(gap).startswith("Not certified")
    failed = dataclasses.replace(certificate, status=rw.Status.FAILED, cause=Cause.NO_BOUND, lower_bound=-math.inf)
    assert "inf" not in certificate_sentence(failed)


def test_scales_and_clocks_have_deviations(scales: rw.Refined) -> None:
    assert isinstance(scales.scale, dict)
    one, two = scales_and_clocks(scales)  # the size of target0 is known
    for name, sentence in (("target1", one), ("target2", two)):
        deviation = math.sqrt(scales.covariance(f"scale:{name}")[0, 0])
        assert f"{name} (measured / true length): {scales.scale[name]:.6f} ± {deviation:.6f}" in sentence
    still = general(1, 1, seed=5, noise=NOISE, scale="shared", motion=Motion("planar", extent_m=0.0)).problem
    assert "± free." in scales_and_clocks(refined(still))[0]


def test_noise_outliers_and_cost_are_said(scales: rw.Refined) -> None:
    text = printed(scales)
    assert "Noise of B, estimated from the residuals" in text
    assert "Noise of A: none" in text
    noise = rw.CarrierNoise(rotation_rad=math.radians(0.3), translation_m=0.002)
    stated = dataclasses.replace(scales, options=dataclasses.replace(scales.options, carrier_noise=noise))
    assert "0.3° and 2 mm" in printed(stated)
    assert f"to {scales.cost:.6g} after" in text
    counts = dict.fromkeys(scales.noise, (20, 20)) | {
        pair: (3, 20) for pair in scales.noise if pair.target == "target2"
    }
    text = printed(dataclasses.replace(scales, inlier_counts=counts))
    assert "34 of 120 measurements left out" in text
    assert "target2 (!)" in text
    assert "target1 (!)" not in text


def test_a_fixed_frame_is_called_fixed() -> None:
    simulation = general(2, 2, seed=5, noise=NOISE)
    simulation.problem.fix("target0", simulation.X["target0"])
    assert row_of(printed(refined(simulation.problem)), "target0")[6:] == ["fixed"] * 6


def test_a_calibration_says_its_choices_with_their_evidence() -> None:
    calibration = rw.calibrate(rig().problem)
    text = printed(calibration)
    assert text.startswith(str(calibration.judgement))
    assert all(f"  - {choice}" in text for choice in calibration.choices)
    assert all(fact.removeprefix("data cannot tell: ") in text for fact in calibration.cannot_tell)


def test_a_misreading_is_said_first_and_there_are_no_covariances() -> None:
    calibration = rw.calibrate(copied(rig().problem, A=lambda pair, raw: np.linalg.inv(raw.A)))
    text = printed(calibration)
    assert text.startswith("Do not use these poses: ")
    assert str(calibration.misreadings[0]) in text
    assert "±x mm" not in text
    assert "turn the carriers" not in text


def test_too_few_measurements_are_said_once_for_all_directions() -> None:
    raw, few = rig(1, 1).problem.measurements("target0", "sensor0"), rw.Problem()
    few.add("target0", "sensor0", raw.A[:2], raw.B[:2])
    stream = io.StringIO()
    print_calibration(rw.calibrate(few), Console(file=stream, width=200))
    assert stream.getvalue().count("Not determined") == 1


def test_residuals_are_pooled_by_measurements() -> None:
    pooled = pooled_residual([rw.Residual(1, 3.0, 0.1), rw.Residual(3, 1.0, 0.3)])
    expected = math.sqrt((9.0 + 3.0) / 4.0), math.sqrt((0.01 + 3 * 0.09) / 4.0)
    assert (pooled.translation_rms_m, pooled.rotation_rms_rad) == pytest.approx(expected)


def test_a_count_of_a_log_has_no_unit() -> None:
    """ "rotation off the pair's consensus (rad): 2" read as an angle of 2 rad."""
    log = rw.results.read_result(GOLDEN / "result_log.json").log
    assert log is not None
    track = TrackCount(target="tag", sensor="cam", used=5, removed={RemovalReason.ROTATION_OFF: 2})
    cleaning = log.cleaning.model_copy(update={"tracks": (track,)})
    blocks = log_blocks(log.model_copy(update={"cleaning": cleaning}))
    said = [plain_text(block.words) for block in blocks if isinstance(block, Paragraph)]
    assert "Removed in cleaning: rotation off the pair's consensus: 2 (2 of tag-cam)." in said


def test_the_proof_is_one_line_beside_the_verdict(solution: rw.Solution) -> None:
    proven = solution.certificate
    words = proof_line(proven)
    assert re.fullmatch(r"Proven: no other answer fits these measurements better \(gap \de-\d+\)\.", words)
    assert "others fit as well" in proof_line(dataclasses.replace(proven, status=Status.CERTIFIED_NOT_UNIQUE))
    assert not proof_line(dataclasses.replace(proven, status=Status.GAP))
