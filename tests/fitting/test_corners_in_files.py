"""Result files of refinements from corners: intrinsics come back bit for bit, and damage is refused with its place."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_as_refined import made
from problems_of_corners import problem_of
from simulated_cells import CAMERA, cell

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.intrinsics_files import read_calibration_yaml, read_cameras
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.fitting.reprojection_record import Consequence, Reprojection, SensorReprojection, TriedModel
from gtsam_rwhec.results.result_file import read_result


@cache
def refined() -> rw.Refined:
    """A refinement with everything that files keep, also what is infinite or was not seen."""
    *_, found = made()
    assert found.reprojection is not None
    intrinsics = dict(found.intrinsics)
    first = intrinsics["cam_0"]
    width = len(first.names)
    intrinsics["cam_0"] = replace(
        first,
        stated_as="unknown",
        stated_deviations=(float("inf"),) * width,
        innovation_deviations=float("inf"),
        projection_px=((0.1, None), (1e-3, 0.30000000000000004)),
        projection_m=1.5,
    )
    reprojection: Reprojection = replace(
        found.reprojection,
        sensors={
            name: SensorReprojection(30, 720, 3, one.rms_px, 0.1, 0.07, ((None, 0.1), (0.2, 0.3)))
            for name, one in intrinsics.items()
        },
        tried=(TriedModel("intrinsics free", 0.1, 0.07, True), TriedModel("as stated", 0.4, 0.3, False)),
        consequences=(Consequence("cam_1", "cx off by 1 px", 0.04, 0.9),),
    )
    return replace(found, reprojection=reprojection, intrinsics=intrinsics)


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("good") / "refined.json"
    rw.write_refined(refined(), path)
    return path.read_text(encoding="utf-8")


def test_cameras_boards_and_errors_in_pixels_come_back_to_the_last_bit(text: str, tmp_path: Path) -> None:
    (tmp_path / "refined.json").write_text(text, encoding="utf-8")
    back, given = rw.read_refined(tmp_path / "refined.json"), refined()
    assert back.reprojection == given.reprojection
    assert back.intrinsics == given.intrinsics
    assert back.names == given.names
    np.testing.assert_array_equal(back.covariance(), given.covariance())
    np.testing.assert_array_equal(back.intrinsics["cam_1"].camera.K, given.intrinsics["cam_1"].camera.K)
    deviations = np.sqrt(np.diagonal(back.covariance("intrinsics:cam_1")))
    np.testing.assert_allclose(deviations, back.intrinsics["cam_1"].standard_deviations, rtol=1e-12)


def test_the_file_says_it_in_its_own_words(text: str) -> None:
    raw = json.loads(text)
    assert raw["refined"]["reprojection"]["rms_px"] == 0.1
    assert raw["refined"]["intrinsics"]["cam_0"]["names"][:5] == ["fx", "fy", "cx", "cy", "k1"]
    assert raw["refined"]["intrinsics"]["cam_0"]["stated_deviations"] == [None] * 8  # no prior: infinite
    assert raw["refined"]["intrinsics"]["cam_0"]["innovation_deviations"] is None
    assert "upper left pixel at (0, 0)" in raw["conventions"]["intrinsics"]


def test_an_error_of_no_number_is_not_written(tmp_path: Path) -> None:
    given = refined()
    assert given.reprojection is not None
    wrong = replace(given, reprojection=replace(given.reprojection, rms_px=float("nan")))
    with pytest.raises(FileFormatError, match=r"\$\.refined\.reprojection\.rms_px: must be finite \(found nan\)"):
        rw.write_refined(wrong, tmp_path / "refined.json")
    wrong = replace(given, reprojection=None)
    with pytest.raises(FileFormatError, match=r"intrinsics: has cam_0, cam_1, but the sensors are none"):
        rw.write_refined(wrong, tmp_path / "refined.json")
    assert not (tmp_path / "refined.json").exists()


def test_files_for_others_have_the_estimated_intrinsics(text: str, tmp_path: Path) -> None:
    (tmp_path / "refined.json").write_text(text, encoding="utf-8")
    *_, corners, _ = made()
    wide = replace(CAMERA, width=640)
    texts = []
    for answer in (refined(), rw.read_refined(tmp_path / "refined.json"), corners):
        frames = rw.rig.frames_of_refined(answer, {"cam_0": wide}, sensor_carrier="base", target_carrier="hand")
        texts.append([path.read_text(encoding="utf-8") for path in rw.rig.export_all(frames, tmp_path)])
    assert texts[0] == texts[1] == texts[2]
    read = read_cameras(tmp_path / "cameras.opencv.yaml")
    for name, intrinsics in refined().intrinsics.items():
        np.testing.assert_array_equal(read[name].K, intrinsics.camera.K)
        np.testing.assert_array_equal(read[name].D, intrinsics.camera.D)
        of_ros = (tmp_path / "camera_info" / f"{name}.yaml").read_text(encoding="utf-8")
        fx, k1 = intrinsics.standard_deviations[0], intrinsics.standard_deviations[4]
        assert f"# {name}, on base: intrinsics estimated from the corners, standard deviations fx {fx:.2g}, " in of_ros
        assert f" px, k1 {k1:.2g}, " in of_ros
        assert read_calibration_yaml(tmp_path / "camera_info" / f"{name}.yaml").width == 1920
    assert "what was stated holds k1, k2, not the images" in of_ros


def test_exact_intrinsics_are_not_called_estimated() -> None:
    one = refined().intrinsics["cam_1"]
    exact = replace(one, standard_deviations=(1e-5,) * 8, stated_as="exact")
    frames = rw.rig.frames_of_refined(replace(refined(), intrinsics={"cam_1": exact}), {"cam_0": CAMERA})
    assert frames.camera_origins == {"cam_1": "as stated, which count as exact"}
    assert frames.cameras["cam_0"] is CAMERA


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.WeightsWarning")
@pytest.mark.parametrize(
    ("options", "more"),
    [
        (rw.CornerOptions(stated="calibration", shared=(("cam_0", "cam_1"),)), set()),
        (rw.CornerOptions(stated="calibration", size_share=0.02), {"scale:board"}),
        (rw.CornerOptions(stated="unknown", warp_m=1e-3, corners_m=3e-4), {"shape:board"}),
    ],
    ids=["one camera for both", "a size that counted as known", "no intrinsics, a bent board"],
)
def test_every_refinement_from_corners_is_kept(options: rw.CornerOptions, more: set[str], tmp_path: Path) -> None:
    problem = problem_of(
        cell(5, images=20, stated="calibration", carrier=(5e-4, 2e-4), shape=(0.01, 0, 0)).observations
    )
    answer = rw.refine(problem, rw.solve(problem), rw.RefineOptions(observations="corners"), corners=options)
    rw.write_refined(answer, tmp_path / "refined.json")
    back = rw.read_refined(tmp_path / "refined.json")
    assert (back.reprojection, back.intrinsics) == (answer.reprojection, answer.intrinsics)
    assert set(back.names) == {"board", "cam_0", "cam_1", "intrinsics:cam_0", "intrinsics:cam_1"} | more
    np.testing.assert_array_equal(back.covariance(), answer.covariance())


def test_corners_may_estimate_a_size_that_was_known_before(text: str, tmp_path: Path) -> None:
    raw, path = json.loads(text), tmp_path / "refined.json"
    assert raw["scale_mode"] == "per_target"
    raw["certified"].update(scale=1.0, scale_mode="known")
    path.write_text(json.dumps(raw), encoding="utf-8")
    assert rw.read_refined(path).scale == refined().scale
    found(raw).update(boards={})
    path.write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(
        FileFormatError, match=r"scale_mode: must be 'known', as in \$\.certified \(found 'per_target'\)"
    ):
        rw.read_refined(path)


def camera(raw: Any, name: str = "cam_1") -> Any:
    return raw["refined"]["intrinsics"][name]


def found(raw: Any) -> Any:
    return raw["refined"]["reprojection"]


CASES: dict[str, tuple[Callable[[Any], object], str]] = {
    "a number is missing": (lambda raw: camera(raw)["values"].pop(), r"cam_1\.values: 7 numbers for 8 names"),
    "no focal length": (
        lambda raw: camera(raw)["names"].__setitem__(0, "f"),
        r"cam_1\.names: must be fx, fy, .* \(found f, fy",
    ),
    "no camera": (lambda raw: camera(raw)["values"].__setitem__(0, -5.0), r"cam_1\.values: no camera has .* fx = -5"),
    "no model": (lambda raw: camera(raw).update(model="tilted"), r"cam_1\.values: no camera .* 'tilted' is not supp"),
    "no size": (lambda raw: camera(raw).update(width=0), r"cam_1\.values: no camera .* image size is 0 x 1080"),
    "no sensor": (
        lambda raw: raw["refined"]["intrinsics"].update(moon=camera(raw)),
        r"refined\.intrinsics: has moon, but the sensors are cam_0, cam_1",
    ),
    "a negative deviation": (
        lambda raw: camera(raw)["stated_deviations"].__setitem__(2, -1.0),
        r"cam_1\.stated_deviations: must not be negative",
    ),
    "no rows": (
        lambda raw: raw["refined"]["joint"]["slots"].pop("intrinsics:cam_1"),
        r"rows may neither overlap nor be left out|slots have",
    ),
    "rows without values": (
        lambda raw: raw["refined"]["intrinsics"].pop("cam_1"),
        r"unknowns that have no value: intrinsics:cam_1",
    ),
    "held": (lambda raw: camera(raw).update(held_by_prior=["k9"]), r"held_by_prior: has k9, but the parameters are fx"),
    "no rms": (lambda raw: found(raw).pop("rms_px"), r"refined\.reprojection\.rms_px: Field required"),
    "a negative size": (
        lambda raw: found(raw).update(corner_px=-0.1),
        r"corner_px: must not be negative \(found -0\.1",
    ),
    "no target": (
        lambda raw: found(raw)["boards"].update(moon=found(raw)["boards"]["board"]),
        r"reprojection\.boards: has moon, but the targets are board",
    ),
    "uneven regions": (
        lambda raw: found(raw)["sensors"]["cam_1"]["regions_px"][1].pop(),
        r"sensors\.cam_1\.regions_px: rows of different lengths",
    ),
    "a negative region": (
        lambda raw: camera(raw, "cam_0")["projection_px"].__setitem__(1, [-1.0, None]),
        r"cam_0\.projection_px: must not be negative",
    ),
    "nothing chosen": (
        lambda raw: found(raw)["tried"][0].update(is_chosen=False),
        r"reprojection\.tried: one model is chosen",
    ),
    "of no frame": (
        lambda raw: found(raw)["consequences"][0].update(frame="moon"),
        r"consequences\[0\]\.frame: has moon, but the frames are",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_damage_is_refused_with_its_place(case: str, text: str, tmp_path: Path) -> None:
    change, said = CASES[case]
    raw = json.loads(text)
    change(raw)
    path = tmp_path / "refined.json"
    path.write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(FileFormatError, match=said) as caught:
        read_result(path)
    assert str(path) in str(caught.value)
