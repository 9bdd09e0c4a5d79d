"""Result files that contradict themselves: each is refused, and the message has the place and what is wrong there."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from places import DEMO, GOLDEN
from refinement_problems import refined

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.results.result_file import parse_result, read_result, result_json
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(sigma_m=0.005, kappa=6000.0)
Change = Callable[[Any], object]


@pytest.fixture(scope="module")
def files() -> dict[str, str]:
    """Refined calibrations: of two unconnected parts, with a free direction, of a log, and from corners."""
    parts = general(2, 2, seed=5, noise=NOISE, graph=[(0, 0), (1, 1)]).problem
    free = general(1, 1, seed=5, noise=NOISE, motion="planar").problem
    texts = {name: result_json(refined(problem)).decode() for name, problem in (("parts", parts), ("free", free))}
    return texts | {name: (GOLDEN / f"result_{name}.json").read_text() for name in ("log", "corners")}


def certificates(raw: Any, **fields: Any) -> None:
    """Change the certificate of the whole and of both parts; costs and bounds are halved for the parts."""
    certified = raw["certified"]
    certified["certificate"].update(fields)
    for part in certified["parts"]:
        halved = {name: value / 2.0 if isinstance(value, float) else value for name, value in fields.items()}
        part["certificate"].update(halved)


def of_first_part(**fields: Any) -> Change:
    return lambda raw: raw["certified"]["parts"][0]["certificate"].update(fields)


def of_joint(*values: tuple[int, int, float]) -> Change:
    return lambda raw: [raw["refined"]["joint"]["finite"][i].__setitem__(j, x) for i, j, x in values]


def twice(rows: list[Any], times: int = 1) -> None:
    rows.extend([rows[0]] * times)


def renamed(raw: Any) -> None:
    raw["targets"][0].update(child="moon")
    raw["refined"]["frames"].update(moon=raw["refined"]["frames"].pop("target0"))
    raw["refined"]["noise"][0].update(target="moon")
    raw["refined"]["joint"]["slots"].update(moon=raw["refined"]["joint"]["slots"].pop("target0"))


def intrinsics(raw: Any) -> Any:
    return raw["refined"]["intrinsics"]["cam_0"]


def reprojection(raw: Any) -> Any:
    return raw["refined"]["reprojection"]


#: Which file, what is changed in it, the place that the message names, and a word of it.
CASES: dict[str, tuple[str, Change, str, str]] = {
    "a cause without its figure": (
        "parts", lambda raw: certificates(raw, cause="not_tight", status="gap", figures={}), "figures", "not_tight"
    ),
    "another status than the cause's": ("parts", of_first_part(cause="not_tight"), "parts[0].certificate", "gap"),
    "no region": ("parts", lambda raw: raw["certified"]["certificate"].pop("region"), "certificate.region", "missing"),
    "no basis": ("parts", lambda raw: raw["certified"]["certificate"].pop("basis"), "certificate.basis", "missing"),
    "an impossible region": (
        "parts", of_first_part(region={"radius_m": -1.0, "scale_factor": 100.0}), "certificate.region", "positive"
    ),
    "another objective": (
        "parts", lambda raw: raw["certified"]["certificate"]["objective"].update(has_priors=True), "objective", "parts"
    ),
    "a bound far below the cost": (
        "parts", lambda raw: certificates(raw, cost=100.0, lower_bound=50.0), "status", "above the lower bound"
    ),
    "no bound": ("parts", lambda raw: certificates(raw, lower_bound=None), "certificate.status", "-inf"),
    "a bound above the cost": (
        "parts", lambda raw: certificates(raw, cost=10.0, lower_bound=50.0), "certificate", "impossible"
    ),
    "a negative cost": (
        "parts", lambda raw: certificates(raw, cost=-10.0, lower_bound=-10.0), "certificate", "impossible"
    ),
    "a negative tolerance": ("parts", lambda raw: certificates(raw, tolerance=-1.0), "certificate", "impossible"),
    "no sum of its parts": (
        "parts", lambda raw: raw["certified"]["certificate"].update(cost=1.0, lower_bound=1.0), "cost", "sum"
    ),
    "better than a part": (
        "parts", of_first_part(status="gap", cause="not_tight", figures={"relaxation_cost": 0.0}), "status", "gap"
    ),
    "a stronger claim than a part's": ("parts", of_first_part(basis="moments"), "certificate.basis", "moments"),
    "a fact twice": ("parts", lambda raw: raw["certified"].update(cost=1.0), "certified.cost", "unknown"),
    "poses twice": ("parts", lambda raw: raw["refined"].update(sensors=raw["sensors"]), "refined.sensors", "unknown"),
    "a known scale that is not 1": ("parts", lambda raw: raw["certified"].update(scale=2.0), "certified.scale", "1.0"),
    "another scale mode": ("parts", lambda raw: raw.update(scale_mode="shared"), "$.scale_mode", "known"),
    "other grounds": ("parts", lambda raw: raw.update(verdict_grounds=["no_bound"]), "$.verdict", "no_bound"),
    "another verdict": ("parts", lambda raw: raw.update(verdict="care"), "$.verdict", "use"),
    "one pair twice": ("parts", lambda raw: twice(raw["certified"]["residuals"]), "residuals[2]", "twice"),
    "one pair thousands of times": (
        "parts", lambda raw: twice(raw["refined"]["noise"], 5000), "refined.noise[2]", "twice"
    ),
    "a negative residual": (
        "parts",
        lambda raw: raw["certified"]["residuals"][0].update(translation_rms_m=-0.1), "translation_rms_m", "-0.1",
    ),
    "certified, and free": (
        "free", lambda raw: certificates(raw, status="certified", cause="proven"), "certificate.status", "free"
    ),
    "unique, and free": (
        "free", lambda raw: raw["certified"]["identifiability"].update(is_unique=True), "is_unique", "free"
    ),
    "a negative variance": ("parts", of_joint((3, 3, -1e-6)), "joint.finite[3][3]", "-1e-06"),
    "far beyond its variances": ("parts", of_joint((0, 7, 1.7e308), (7, 0, 1.7e308)), "joint.finite", "semidefinite"),
    "a difference that overflows": (
        "parts", of_joint((0, 7, 1.7e308), (7, 0, -1.7e308)), "joint.finite[0][7]", "symmetric"
    ),
    "not positive semidefinite": ("parts", of_joint((0, 7, 1.0), (7, 0, 1.0)), "joint.finite", "semidefinite"),
    "free directions that cannot be squared": (
        "parts",
        lambda raw: raw["refined"]["joint"].update(free=[[1e200, -1e200] for _ in raw["refined"]["joint"]["unit"]]),
        "joint.free", "orthonormal",
    ),
    "free directions that are not orthonormal": (
        "free",
        lambda raw: [row.__setitem__(0, 2.0 * row[0]) for row in raw["refined"]["joint"]["free"]],
        "joint.free", "orthonormal",
    ),
    "rows left out": ("parts", lambda raw: raw["refined"]["joint"]["slots"].update(target0=[1, 7]), "slots", "overlap"),
    "an unknown without rows": (
        "parts", lambda raw: raw["refined"]["joint"]["slots"].pop("target0"), "slots", "target0"
    ),
    "rows of nothing": (
        "parts", lambda raw: raw["refined"]["joint"]["slots"].update({"scale:moon": [0, 1]}), "slots", "moon"
    ),
    "a pair that is a number": (
        "parts",
        lambda raw: raw["certified"].update(residuals={"5": raw["certified"]["residuals"][0]}), "residuals", "sensor",
    ),
    "a pair of brackets": (
        "parts",
        lambda raw: raw["certified"].update(residuals={"[" * 19_000: raw["certified"]["residuals"][0]}),
        "residuals", "sensor",
    ),
    "negative noise": ("parts", lambda raw: raw["refined"]["noise"][1].update(rotation_rad=-1.0), "rotation_rad", "-1"),
    "negative freedom": (
        "parts",
        lambda raw: raw["refined"]["noise"][1].update(degrees_of_freedom=[-1.0, 3.0]), "degrees_of_freedom", "-1",
    ),
    "a negative number of steps": ("parts", lambda raw: raw["refined"].update(iterations=-1), "iterations", "-1"),
    "a negative refined cost": ("parts", lambda raw: raw["refined"].update(cost=-1.0), "refined.cost", "-1.0"),
    "more inliers than measurements": (
        "parts",
        lambda raw: raw["refined"]["inlier_counts"].append({"target": "target0", "sensor": "sensor0", "value": [9, 8]}),
        "inlier_counts", "9 inliers of 8",
    ),
    "other names": ("parts", renamed, "$.targets", "names"),
    "a strange frame": ("parts", lambda raw: raw["refined"]["frames"].update(x=raw["refined"]["frames"]["target0"]),
                        "refined.frames", "must have"),
    "a pair of the log twice": ("log", lambda raw: twice(raw["log"]["outliers"]), "log.outliers", "twice"),
    "a size twice": ("log", lambda raw: twice(raw["log"]["sizes"]), "log.sizes", "twice"),
    "a track twice": ("log", lambda raw: twice(raw["log"]["cleaning"]["tracks"]), "log.cleaning.tracks", "twice"),
    "most measurements left out": (
        "log", lambda raw: raw["log"]["outliers"][0].update(left_out=10**6), "$.verdict", "do_not_use"
    ),
    "a negative count": ("log", lambda raw: raw["log"]["outliers"][0].update(left_out=-1), "left_out", "-1"),
    "a negative size": ("log", lambda raw: raw["log"]["sizes"][0].update(stated_m=-1.0), "stated_m", "greater"),
    "a negative deviation": ("log", lambda raw: raw["log"]["sizes"][0].update(sigma=-1.0), "sigma", "greater"),
    "intrinsics without corners": (
        "corners", lambda raw: raw["refined"].update(reprojection=None), "refined.intrinsics", "cam_0"
    ),
    "errors of no sensor": (
        "corners",
        lambda raw: reprojection(raw)["sensors"].update(moon=reprojection(raw)["sensors"]["cam_0"]), "sensors", "moon",
    ),
    "too few parameters": ("corners", lambda raw: intrinsics(raw).update(names=["fx"]), "names", "4"),
    "shared with nobody": (
        "corners", lambda raw: intrinsics(raw).update(shared_with=["moon"]), "shared_with", "moon"
    ),
    "a board's number twice": (
        "corners", lambda raw: twice(reprojection(raw)["boards"]["board"]["names"]), "boards.board", "one entry"
    ),
    "a negative number of corners": (
        "corners", lambda raw: reprojection(raw)["sensors"]["cam_0"].update(corners=-1), "corners", "-1"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_contradiction_is_refused(case: str, files: dict[str, str]) -> None:
    which, change, place, word = CASES[case]
    raw = json.loads(files[which])
    change(raw)
    with pytest.raises(FileFormatError) as caught:
        parse_result(json.dumps(raw).encode(), "here.json")
    said = str(caught.value)
    assert said.startswith("here.json is not a valid result: $.")
    assert place in said
    assert word in said


def test_what_is_not_contradicted_is_read(files: dict[str, str]) -> None:
    for content in files.values():
        assert parse_result(content.encode(), "here.json").refined is not None


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
def test_what_solves_certifies_and_writes_agrees(scale: rw.ScaleMode, tmp_path: Path) -> None:
    """Every file is read back when it is written, so a check that is too strict would stop this."""
    problem = rw.read_csv(DEMO, scale=scale, sigma=0.005, kappa=6565.0)
    rw.write_refined(rw.refine(problem, rw.solve(problem)), tmp_path / "result.json")
    assert read_result(tmp_path / "result.json").refined is not None
