"""What a person reads about a refined calibration: on terminals of any width, in files, where something is free."""

from __future__ import annotations

import dataclasses
import io
import math
import re
import warnings
from typing import Any

import gtsam
import numpy as np
import pytest
from rich.console import Console

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.refined import PairNoise
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report import print_refined
from gtsam_rwhec.report.covariance_report import (
    deviation_cells,
    legend,
    noise_table,
    outlier_sentence,
    refined_sentences,
    scale_and_offset_sentences,
)
from gtsam_rwhec.simulate import Motion, Noise, general

NOISE = Noise(sigma_m=0.005, kappa=0.5 / np.radians(0.5) ** 2)
HEADINGS = ["x m", "y m", "z m", "roll°", "pitch°", "yaw°", "±x mm", "±y mm", "±z mm", "±x°", "±y°", "±z°"]


def refined_of(problem: rw.Problem, **options: Any) -> rw.Refined:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rw.errors.RwhecWarning)
        return rw.refine(problem, rw.solve(problem), rw.RefineOptions(**options))


@pytest.fixture(scope="module")
def rig() -> rw.Refined:
    """Two sensors, three targets, two of whose sizes are unknown."""
    problem = general(3, 2, seed=5, noise=NOISE, scale="per_target", known_sizes=["target0"]).problem
    return refined_of(problem, noise="estimate")


@pytest.fixture(scope="module")
def planar() -> rw.Refined:
    """Turned about one axis only: something of every frame is free, and nothing of relative poses."""
    return refined_of(general(2, 2, seed=5, noise=NOISE, motion=Motion("planar")).problem)


def printed(refined: rw.Refined, width: int = 160, *, terminal: bool = False) -> str:
    """The report as printed, without colours."""
    stream = io.StringIO()
    console = Console(file=stream, width=width, force_terminal=terminal, color_system=None, highlight=False)
    print_refined(refined, console)
    return re.sub(r"\x1b\[[0-9;]*m", "", stream.getvalue())


def rows_under(text: str, title: str) -> list[str]:
    """Lines of the table that has this title, from its headings on."""
    lines = text[text.index(title) :].splitlines()[2:]
    return [line for line in lines[: next(i for i, line in enumerate(lines) if not line.strip())] if "──" not in line]


@pytest.mark.parametrize("width", [60, 80, 160])
@pytest.mark.parametrize("kind", ["rig", "planar"])
def test_nothing_is_cut_and_nothing_sticks_out(width: int, kind: str, request: pytest.FixtureRequest) -> None:
    refined: rw.Refined = request.getfixturevalue(kind)
    text = printed(refined, width, terminal=True)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    words = re.sub(r"[\s,]+", " ", text)
    for name, pose in (*refined.X.items(), *refined.Y.items()):
        assert name in words
        cells = deviation_cells(refined.covariance(name))
        for number in (*(f"{value:.4f}" for value in pose.translation()), *cells):
            assert f" {number} " in words


def test_a_number_stays_with_its_heading_on_a_narrow_terminal(rig: rw.Refined) -> None:
    lines = printed(rig, 40, terminal=True).splitlines()
    own = [line for line in lines if re.match(r"  [±xyzrpm]", line)]
    assert len(own) > 20
    for line in own:
        for piece in line.strip().removesuffix(",").split(", "):
            assert re.fullmatch(r"(±?[xyz] ?m{0,2}°?|roll°|pitch°|yaw°|moved mm|moved°) -?[\d.]+", piece), line


@pytest.mark.parametrize("title", ["Sensors in the frame", "Targets in the frame", "Other targets in the frame"])
def test_columns_are_aligned_under_their_headings(rig: rw.Refined, title: str) -> None:
    head, *rows = rows_under(printed(rig), title)
    for heading in HEADINGS:
        end = head.index(heading) + len(heading)
        for row in rows:
            assert row[end - 1] != " "
            assert row[end : end + 1] in ("", " ")


def test_cells_are_the_refined_numbers(rig: rw.Refined) -> None:
    text = printed(rig)
    for name, row in zip(rig.Y, rows_under(text, "Sensors in the frame")[1:], strict=True):
        label, *cells = row.split()
        assert label == name
        degrees, millimetres = rig.standard_deviations(name)
        np.testing.assert_allclose([float(cell) for cell in cells[6:9]], millimetres, atol=0.0051)
        np.testing.assert_allclose([float(cell) for cell in cells[9:12]], degrees, atol=0.00051)
        assert float(cells[12]) == pytest.approx(rig.moved[name].translation_mm, abs=0.0051)
        assert float(cells[13]) == pytest.approx(rig.moved[name].rotation_deg, abs=0.00051)
    (row,) = rows_under(text, "Other sensors in the frame of sensor0")[1:]
    pose, covariance = rig.relative("sensor0", "sensor1")
    np.testing.assert_allclose([float(cell) for cell in row.split()[1:4]], pose.translation(), atol=0.51e-4)
    assert tuple(row.split()[7:]) == deviation_cells(covariance)


def test_what_is_free_is_called_free(planar: rw.Refined) -> None:
    text = printed(planar)
    for line in rows_under(text, "Sensors in the frame")[1:] + rows_under(text, "Targets in the frame")[1:]:
        assert "free" in line.split()[7:10]
    for title in ("Other sensors in the frame of sensor0", "Other targets in the frame of target0"):
        (line,) = rows_under(text, title)[1:]
        assert "free" not in line
    assert "inf" not in text.replace("infinite", "")
    assert "nan" not in text
    for direction in planar.free_directions:
        assert f"Not determined: {direction}\n" in text
    assert [len(direction.frames) for direction in planar.free_directions] == [4]


def test_scales_of_targets_have_deviations(rig: rw.Refined) -> None:
    assert isinstance(rig.scale, dict)
    sentences = scale_and_offset_sentences(rig)
    for name in ("target1", "target2"):
        deviation = math.sqrt(rig.covariance(f"scale:{name}")[0, 0])
        value = f"{rig.scale[name]:.6f} ± {deviation:.6f}"
        assert f"Scale of {name} (measured / true length): {value}." in sentences
    assert not any("Scale of target0" in sentence for sentence in sentences)  # its size is known


def test_a_shared_scale_and_a_free_one() -> None:
    shared = refined_of(general(1, 1, seed=5, noise=NOISE, scale="shared").problem)
    deviation = math.sqrt(shared.covariance("scale")[0, 0])
    assert (
        scale_and_offset_sentences(shared)[0]
        == f"Scale (measured / true length): {shared.scale:.6f} ± {deviation:.6f}."
    )
    still = refined_of(
        general(1, 1, seed=5, noise=NOISE, scale="shared", motion=Motion("planar", extent_m=0.0)).problem
    )
    assert "± free." in scale_and_offset_sentences(still)[0]


def test_time_offsets_have_deviations() -> None:
    problem = rw.Problem()
    raw = general(1, 1, seed=5, noise=NOISE, number_of_measurements=60).problem.measurements("target0", "sensor0")
    A = np.array([gtsam.Pose3.Expmap(np.full(6, 0.02) * i).matrix() for i in range(60)]) @ raw.A[0]
    X, Y = gtsam.Pose3.Expmap(np.arange(6) / 5.0).matrix(), gtsam.Pose3.Expmap(np.arange(6) / -7.0).matrix()
    wobble = [gtsam.Pose3.Expmap(0.3 * np.sin(np.arange(6) + i / 3.0)).matrix() for i in range(60)]
    A = np.linalg.inv(np.array(wobble)) @ A
    B = [gtsam.Pose3(np.linalg.inv(Y) @ a @ X).retract(np.full(6, 1e-4) * (-1.0) ** i) for i, a in enumerate(A)]
    problem.add("target0", "sensor0", A, B, 0.001, 1e5, stamps_ns=np.arange(60) * 100_000_000)
    refined = refined_of(problem, time_offsets=True)
    (sentence,) = [s for s in scale_and_offset_sentences(refined) if s.startswith("Time offset")]
    offset, deviation = refined.time_offsets_s["sensor0"], math.sqrt(refined.covariance("time_offset:sensor0")[0, 0])
    assert sentence == (
        f"Time offset of sensor0: {1e3 * offset:+.3f} ± {1e3 * deviation:.3f} ms (a stamp of sensor0 + this = "
        "the carriers' time)."
    )


def test_noise_in_one_sentence_where_it_is_one(rig: rw.Refined, planar: rw.Refined) -> None:
    assert "Noise of B: 0.5° and 5 mm for each axis of a typical measurement, as given." in refined_sentences(planar)
    noise = next(iter(rig.noise.values()))
    assert (
        f"Noise of B: {math.degrees(noise.rotation_rad):.3g}° and {1e3 * noise.translation_m:.3g} mm for each axis of "
        "a typical measurement, "
        f"estimated from the residuals, with {noise.degrees_of_freedom[0]:.0f} and {noise.degrees_of_freedom[1]:.0f} "
        "degrees of freedom."
    ) in refined_sentences(rig)
    assert "Noise of B for each axis" not in printed(rig)


def test_noise_by_sensor_and_by_pair_in_a_table(rig: rw.Refined) -> None:
    by_sensor = {pair: PairNoise(0.01 if pair[1] == "sensor0" else 0.02, 0.003, (40.0, 38.0)) for pair in rig.noise}
    text = printed(dataclasses.replace(rig, noise=by_sensor))
    assert "Noise of B: estimated from the residuals; see the table." in text
    assert [row.split() for row in rows_under(text, "Noise of B for each axis of a typical measurement")[1:]] == [
        ["sensor0", "0.573", "3", "40", "38"],
        ["sensor1", "1.15", "3", "40", "38"],
    ]
    by_pair = {pair: PairNoise(0.01 * (i + 1), 0.003, (math.inf, math.inf)) for i, pair in enumerate(rig.noise)}
    table = noise_table(dataclasses.replace(rig, noise=by_pair, noise_source="given"))
    assert table.kind == "pair"
    assert table.headings == ("±°", "±mm")
    assert table.rows["target1-sensor0"] == (f"{math.degrees(0.03):.3g}", "3")
    assert len(table.rows) == 6


def test_it_says_whether_the_carriers_are_taken_for_exact(rig: rw.Refined) -> None:
    (sentence,) = [s for s in refined_sentences(rig) if s.startswith("Noise of A")]
    assert sentence.startswith("Noise of A: none, the carriers' poses count as exact")
    assert legend(rig).endswith("moved: how far the refinement moved the pose.")
    noise = rw.CarrierNoise(rotation_rad=math.radians(0.3), translation_m=0.002)
    options = dataclasses.replace(rig.options, carrier_noise=noise)
    assert legend(dataclasses.replace(rig, options=options)).endswith("; it adds the noise of A.")
    sentences = refined_sentences(dataclasses.replace(rig, options=options))
    assert "Noise of A: 0.3° and 2 mm for each axis of the target carrier, as given." in sentences


def test_outliers_are_counted(rig: rw.Refined) -> None:
    counts = dict.fromkeys(rig.noise, (20, 20))
    assert outlier_sentence(counts) == "Outliers: none of 120 measurements."
    counts |= {Pair("target1", "sensor0"): (18, 20), Pair("target2", "sensor1"): (19, 20)}
    said = "Outliers: 3 of 120 measurements left out: target1-sensor0 2 of 20, target2-sensor1 1 of 20."
    assert outlier_sentence(counts) == said
    assert said in printed(dataclasses.replace(rig, inlier_counts=counts))
    assert "Outliers: " not in printed(rig)


def test_a_frame_that_its_measurements_contradict_is_marked_in_every_table(rig: rw.Refined) -> None:
    counts = dict.fromkeys(rig.noise, (20, 20)) | {pair: (3, 20) for pair in rig.noise if pair.target == "target2"}
    text = printed(dataclasses.replace(rig, inlier_counts=counts))
    assert text.count("target2 (!)") == 2
    assert "target1 (!)" not in text
    assert "(!): do not use this pose; 34 of 40 measurements of target2 contradict the answer." in text
    assert "(!)" not in printed(rig)


def test_cost_names_residual_and_loss(rig: rw.Refined) -> None:
    options = dataclasses.replace(rig.options, robust="cauchy")
    once = dataclasses.replace(rig, options=options, iterations=1, cost=12.0, initial_cost=13.5)
    assert (
        "Cost of the refinement: 13.5 before, 12 after 1 iteration (geodesic residual, cauchy loss). Do not compare it "
        "with the certified cost, which has other weights."
    ) in refined_sentences(once)


def test_a_fixed_frame_is_called_fixed() -> None:
    simulation = general(2, 2, seed=5, noise=NOISE)
    simulation.problem.fix("target0", simulation.X["target0"])
    rows = rows_under(printed(refined_of(simulation.problem)), "Targets in the frame")
    assert rows[1].split()[7:] == ["fixed"] * 6 + ["0.00", "0.000"]
    assert "fixed" not in rows[2]


def test_a_file_gets_one_line_for_each_sentence(rig: rw.Refined, planar: rw.Refined) -> None:
    for refined in (rig, planar):
        lines = printed(refined, 80).splitlines()
        for sentence in (*refined_sentences(refined), *(f"  - Not determined: {s}" for s in refined.free_directions)):
            assert sentence in lines


def test_frame_names_are_not_taken_for_markup(rig: rw.Refined) -> None:
    pair = Pair("[bold]t[/]", "[red]s[/]")
    odd = dataclasses.replace(rig, noise={pair: PairNoise(0.01, 0.01, (math.inf, math.inf))})
    counts = {pair: (1, 2)}
    assert "[bold]t[/]-[red]s[/] 1 of 2." in printed(dataclasses.replace(odd, inlier_counts=counts))
