"""Result files that contradict themselves: each is refused with its own message, and the place."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import DEMO

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.results.covariance_agreement import _check_covariance
from gtsam_rwhec.results.result_file import read_result
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(sigma_m=0.005, kappa=6000.0)
GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A refined calibration of two unconnected parts as text."""
    problem = general(2, 2, seed=5, noise=NOISE, graph=[(0, 0), (1, 1)]).problem
    path = tmp_path_factory.mktemp("good") / "refined.json"
    rw.write_refined(rw.refine(problem, rw.solve(problem)), path)
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def free(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A refined calibration with a free direction as text."""
    problem = general(1, 1, seed=5, noise=NOISE, motion="planar").problem
    path = tmp_path_factory.mktemp("good") / "free.json"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rw.errors.RwhecWarning)
        rw.write_refined(rw.refine(problem, rw.solve(problem)), path)
    return path.read_text(encoding="utf-8")


def refuse(text: str, change: Callable[[Any], object], said: str, path: Path) -> None:
    raw = json.loads(text)
    path.write_text(text, encoding="utf-8")
    rw.read_refined(path)
    change(raw)
    path.write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(FileFormatError, match=said) as caught:
        rw.read_refined(path)
    assert str(path) in str(caught.value)


def certificates(raw: Any, **fields: Any) -> None:
    """Change the certificate of the whole and of both parts; costs and bounds are halved for the parts."""
    certified = raw["certified"]
    certified["certificate"].update(fields)
    for part in certified["parts"]:
        part["certificate"].update(
            {name: value / 2.0 if isinstance(value, float) else value for name, value in fields.items()}
        )
    if "cost" in fields:
        certified["cost"] = fields["cost"]


def wholes(raw: Any) -> list[tuple[Any, dict[str, float]]]:
    """What has the cost of the whole, and what else changes there."""
    return [(raw["certified"], {}), (raw["certified"]["certificate"], {"lower_bound": 1.0})]


def twice(rows: list[Any], times: int = 1) -> None:
    rows.extend([rows[0]] * times)


CASES: dict[str, tuple[Callable[[Any], object], str]] = {
    "a cause without its figure": (
        lambda raw: certificates(raw, cause="not_tight", status="gap", figures={}),
        r"certificate\.figures: lacks relaxation_cost, of which the cause 'not_tight' speaks",
    ),
    "no region": (lambda raw: raw["certified"]["certificate"].pop("region"), r"certificate\.region: is missing"),
    "no basis in a part": (
        lambda raw: raw["certified"]["parts"][0]["certificate"].pop("basis"),
        r"parts\[0\]\.certificate\.basis: is missing",
    ),
    "another objective": (
        lambda raw: raw["certified"]["certificate"]["objective"].update(has_priors=True),
        r"\$\.certified\.certificate\.objective: must be what the parts make",
    ),
    "a bound far below the cost": (
        lambda raw: certificates(raw, cost=100.0, lower_bound=50.0),
        r"\$\.certified\.certificate\.status: 'certified', but the cost, 100\.0, is above the lower bound, 50\.0, by",
    ),
    "no bound": (
        lambda raw: certificates(raw, lower_bound=None),
        r"certificate\.status: 'certified', but the cost, .*, is above the lower bound, -inf",
    ),
    "a bound above the cost": (
        lambda raw: certificates(raw, cost=10.0, lower_bound=50.0),
        r"\$\.certified\.certificate\.lower_bound: 50\.0 is above the cost, 10\.0, of an answer",
    ),
    "a negative cost": (
        lambda raw: certificates(raw, cost=-10.0, lower_bound=-10.0),
        r"certificate\.cost: a sum of squares is not negative \(found -10\.0\)",
    ),
    "a negative tolerance": (
        lambda raw: certificates(raw, tolerance=-1.0),
        r"certificate\.tolerance: must be at least 0 \(found -1\.0\)",
    ),
    "a part with a bound far below its cost": (
        lambda raw: raw["certified"]["parts"][1]["certificate"].update(lower_bound=0.0),
        r"\$\.certified\.parts\[1\]\.certificate\.status: 'certified', but the cost",
    ),
    "a whole that is not the sum of its parts": (
        lambda raw: (
            raw["certified"]["certificate"].update(cost=1.0, lower_bound=1.0),
            raw["certified"].update(cost=1.0),
        ),
        r"\$\.certified\.certificate\.cost: must be .*, the sum of all parts \(found 1\.0\)",
    ),
    "a whole that is better than a part": (
        lambda raw: raw["certified"]["parts"][0]["certificate"].update(
            status="gap", cause="not_tight", figures={"relaxation_cost": 0.0}
        ),
        r"certificate\.status: must be 'gap', the worst of all parts \(found 'certified'\)",
    ),
    "two costs": (
        lambda raw: raw["certified"].update(cost=1.0),
        r"\$\.certified\.cost: must be .*, the cost of the certificate \(found 1\.0\)",
    ),
    "weights that are relative and are not": (
        lambda raw: raw["certified"].update(is_relative=True),
        r"\$\.certified\.is_relative: must be False, as in the certificate",
    ),
    "a known scale that is not 1": (
        lambda raw: raw["certified"].update(scale=2.0),
        r"\$\.certified\.scale: must be 1\.0 with scale_mode 'known' \(found 2\.0\)",
    ),
    "another scale mode": (
        lambda raw: raw.update(scale_mode="shared"),
        r"\$\.scale_mode: must be 'known', as in \$\.certified \(found 'shared'\)",
    ),
    "other grounds": (
        lambda raw: raw.update(verdict_grounds=["no_bound"]),
        r"\$\.verdict_grounds: the file says no_bound, but its content leads to none",
    ),
    "one pair twice": (
        lambda raw: twice(raw["certified"]["residuals"]),
        r"\$\.certified\.residuals\[2\]: the pair .*\"target0\", \"sensor0\".* is there twice; keep one",
    ),
    "one pair thousands of times": (
        lambda raw: twice(raw["refined"]["noise"], 5000),
        r"\$\.refined\.noise\[2\]: the pair .* is there twice; keep one",
    ),
    "a negative residual": (
        lambda raw: raw["certified"]["residuals"][0].update(translation_rms_m=-0.1),
        r"\$\.certified\.residuals\[target0-sensor0\]\.translation_rms_m: must be at least 0 \(found -0\.1\)",
    ),
    "a pair without measurements": (
        lambda raw: raw["certified"]["residuals"][0].update(number_of_measurements=0),
        r"number_of_measurements: must be at least 1 \(found 0\)",
    ),
    "two numbers of measurements": (
        lambda raw: raw["certified"]["residuals"][0].update(number_of_measurements=7),
        r"number_of_measurements: must be \d+, as in identifiability\.pairs \(found 7\)",
    ),
    "unique, and free": (
        lambda raw: raw["certified"]["identifiability"].update(
            free_directions=[{"kind": "twin", "reason": "symmetry", "frames": {}, "own_scales": {}}]
        ),
        r"certificate\.status: 'certified', but identifiability has 1 free directions",
    ),
    "a stronger claim than its parts": (
        lambda raw: raw["certified"]["parts"][1]["certificate"].update(basis="moments"),
        r"\$\.certified\.certificate\.basis: must be 'moments', the weakest of all parts \(found 'measurements'\)",
    ),
    "a part with a region, the whole without": (
        lambda raw: raw["certified"]["parts"][1]["certificate"].update(
            region={"radius_m": 300.0, "scale_factor": 100.0}
        ),
        r"\$\.certified\.certificate\.region: must be .*, radius_m 300\.0, scale_factor 100\.0",
    ),
    "a region without an answer in it": (
        lambda raw: certificates(raw, region={"radius_m": -1.0, "scale_factor": 100.0}),
        r"\$\.certified\.certificate\.region: its radius_m must be positive .*\(found -1\.0 and 100\.0\)",
    ),
    "a region without a scale in it": (
        lambda raw: certificates(raw, region={"radius_m": 300.0, "scale_factor": 0.5}),
        r"\$\.certified\.certificate\.region: .*scale_factor at least 1 \(found 300\.0 and 0\.5\)",
    ),
    "a negative variance": (
        lambda raw: raw["refined"]["joint"]["finite"][3].__setitem__(3, -1e-6),
        r"\$\.refined\.joint\.finite\[3\]\[3\]: a variance is not negative \(found -1e-06\)",
    ),
    "a covariance far beyond its variances": (
        lambda raw: [raw["refined"]["joint"]["finite"][i].__setitem__(j, 1.7e308) for i, j in ((0, 7), (7, 0))],
        r"\$\.refined\.joint\.finite: not positive semidefinite",
    ),
    "a difference that overflows": (
        lambda raw: [
            raw["refined"]["joint"]["finite"][i].__setitem__(j, x) for i, j, x in ((0, 7, 1.7e308), (7, 0, -1.7e308))
        ],
        r"\$\.refined\.joint\.finite\[0\]\[7\]: a covariance is symmetric",
    ),
    "free directions that cannot be squared": (
        lambda raw: raw["refined"]["joint"].update(free=[[1e200, -1e200] for _ in raw["refined"]["joint"]["unit"]]),
        r"\$\.refined\.joint\.free: its columns, the free directions, must be orthonormal",
    ),
    "a pair that is a number": (
        lambda raw: raw["certified"].update(residuals={"5": raw["certified"]["residuals"][0]}),
        r"\$\.certified\.residuals.*: rows with a target and a sensor were expected",
    ),
    "a pair of brackets": (
        lambda raw: raw["certified"].update(residuals={"[" * 19_000: raw["certified"]["residuals"][0]}),
        r"\$\.certified\.residuals.*: rows with a target and a sensor were expected",
    ),
    "a covariance that is not positive semidefinite": (
        lambda raw: [raw["refined"]["joint"]["finite"][i].__setitem__(j, 1.0) for i, j in ((0, 7), (7, 0))],
        r"\$\.refined\.joint\.finite: not positive semidefinite",
    ),
    "a frame's covariance that is not in the joint one": (
        lambda raw: raw["refined"]["frames"]["sensor0"]["covariance"][2].__setitem__(4, 1.0),
        r"\$\.refined\.frames\.sensor0\.covariance\[2\]\[4\]: must be .*, by \$\.refined\.joint \(found 1\.0\)",
    ),
    "a frame's infinite covariance": (
        lambda raw: raw["refined"]["frames"]["sensor0"]["covariance"][2].__setitem__(2, None),
        r"\$\.refined\.frames\.sensor0\.covariance: null must stand where the joint covariance is infinite",
    ),
    "a covariance of another shape": (
        lambda raw: raw["refined"]["frames"]["sensor0"]["covariance"].pop(),
        r"\$\.refined\.frames\.sensor0\.covariance: must be 6 x 6",
    ),
    "a smaller standard deviation": (
        lambda raw: raw["refined"]["frames"]["target1"]["standard_deviations_mm"].__setitem__(1, 1e-9),
        r"\$\.refined\.frames\.target1\.standard_deviations_mm: must be .*, by \$\.refined\.joint",
    ),
    "a negative standard deviation": (
        lambda raw: raw["refined"]["frames"]["target1"]["standard_deviations_deg"].__setitem__(1, -0.1),
        r"\$\.refined\.frames\.target1\.standard_deviations_deg: must not be negative \(found .*-0\.1",
    ),
    "negative noise": (
        lambda raw: raw["refined"]["noise"][1].update(rotation_rad=-1.0),
        r"\$\.refined\.noise\[target1-sensor1\]\.rotation_rad: must be at least 0 \(found -1\.0\)",
    ),
    "negative degrees of freedom": (
        lambda raw: raw["refined"]["noise"][1].update(degrees_of_freedom=[-1.0, 3.0]),
        r"degrees_of_freedom: must be at least 0",
    ),
    "a negative movement": (
        lambda raw: raw["refined"]["moved"]["target0"].update(rotation_deg=-1.0),
        r"\$\.refined\.moved\.target0\.rotation_deg: must be at least 0",
    ),
    "a negative number of steps": (
        lambda raw: raw["refined"].update(iterations=-1),
        r"\$\.refined\.iterations: must be at least 0 \(found -1\)",
    ),
    "a negative refined cost": (
        lambda raw: raw["refined"].update(cost=-1.0),
        r"\$\.refined\.cost: must be at least 0 \(found -1\.0\)",
    ),
    "more inliers than measurements": (
        lambda raw: raw["refined"]["inlier_counts"].append({"target": "target0", "sensor": "sensor0", "value": [9, 8]}),
        r"\$\.refined\.inlier_counts\[target0-sensor0\]: 9 inliers of 8 measurements",
    ),
    "other names": (
        lambda raw: [
            raw["targets"][0].update(child="moon"),
            *(raw["refined"][of].update(moon=raw["refined"][of].pop("target0")) for of in ("frames", "moved")),
            raw["refined"]["noise"][0].update(target="moon"),
            raw["refined"]["joint"]["slots"].update(moon=raw["refined"]["joint"]["slots"].pop("target0")),
        ],
        r"\$\.targets: must have the same names as \$\.certified\.targets",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_contradiction_is_refused(case: str, refined: str, tmp_path: Path) -> None:
    change, said = CASES[case]
    refuse(refined, change, said, tmp_path / "result.json")


FREE_CASES: dict[str, tuple[Callable[[Any], object], str]] = {
    "free directions that are not orthonormal": (
        lambda raw: raw["refined"]["joint"].update(
            free=[[2.0 * x for x in row] for row in raw["refined"]["joint"]["free"]]
        ),
        r"\$\.refined\.joint\.free: its columns, the free directions, must be orthonormal",
    ),
    "certified, and free": (
        lambda raw: certificates(raw, status="certified", cause="proven"),
        r"certificate\.status: 'certified', but identifiability has \d+ free directions",
    ),
    "finite along a free direction": (
        lambda raw: raw["refined"]["frames"]["sensor0"].update(covariance=[[1.0] * 6] * 6),
        r"\$\.refined\.frames\.sensor0\.covariance: null must stand where the joint covariance is infinite",
    ),
    "unique": (
        lambda raw: raw["certified"]["identifiability"].update(is_unique=True),
        r"\$\.certified\.identifiability\.is_unique: true, but there are free directions",
    ),
}


@pytest.mark.parametrize("case", FREE_CASES)
def test_a_contradiction_about_a_free_direction_is_refused(case: str, free: str, tmp_path: Path) -> None:
    change, said = FREE_CASES[case]
    refuse(free, change, said, tmp_path / "result.json")


@pytest.fixture(scope="module")
def of_log(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A refined calibration with what became of a log's measurements, as text."""
    problem = general(2, 1, seed=5, noise=NOISE).problem
    path = tmp_path_factory.mktemp("log") / "result.json"
    rw.write_refined(rw.refine(problem, rw.solve(problem)), path, read_result(GOLDEN / "result_version_3.json").log)
    return path.read_text(encoding="utf-8")


LOG_CASES: dict[str, tuple[Callable[[Any], object], str]] = {
    "a pair twice": (lambda raw: twice(raw["log"]["outliers"]), r"\$\.log\.outliers: '.*' is there twice; keep one"),
    "a size twice": (lambda raw: twice(raw["log"]["sizes"]), r"\$\.log\.sizes: '.*' is there twice; keep one"),
    "a track twice": (
        lambda raw: twice(raw["log"]["cleaning"]["tracks"]),
        r"\$\.log\.cleaning\.tracks: '.*' is there twice",
    ),
    "a contradiction that is not said": (
        lambda raw: raw["log"]["outliers"][0].update(left_out=10**6),
        r"\$\.log\.contradicted: must be .*, by \$\.log\.outliers \(found none\)",
    ),
    "a negative count": (
        lambda raw: raw["log"]["outliers"][0].update(left_out=-1),
        r"\$\.log\.outliers\[0\]\.left_out: .*greater than or equal to 0 \(found -1\)",
    ),
    "a negative size": (lambda raw: raw["log"]["sizes"][0].update(stated_m=-1.0), r"\.stated_m: .*greater than 0"),
    "a negative deviation": (
        lambda raw: raw["log"]["sizes"][0].update(sigma=-1.0),
        r"\.sigma: .*greater than or equal",
    ),
}


@pytest.mark.parametrize("case", LOG_CASES)
def test_a_contradiction_about_a_log_is_refused(case: str, of_log: str, tmp_path: Path) -> None:
    change, said = LOG_CASES[case]
    refuse(of_log, change, said, tmp_path / "result.json")


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_earlier_versions_are_still_read(version: int) -> None:
    result = read_result(GOLDEN / f"result_version_{version}.json")
    assert result.solution.certificate.is_optimal


def test_what_solves_certifies_and_writes_agrees(tmp_path: Path) -> None:
    """Every file is read back when it is written, so a check that is too strict would stop this."""
    for scale in ("known", "shared", "per_target"):
        problem = rw.read_csv(DEMO, scale=scale, sigma=0.005, kappa=6565.0)
        rw.write_refined(rw.refine(problem, rw.solve(problem)), tmp_path / "result.json")
        assert read_result(tmp_path / "result.json").refined is not None


def test_a_rows_last_digits_may_differ_where_its_variance_is_infinite_and_lengths_are_tiny() -> None:
    expected = np.diag([np.inf, 1e-22, 4e-22])
    expected[0, 1] = expected[1, 0] = 1.1178833517395231e-11
    expected[1, 2] = expected[2, 1] = 1e-22
    given = np.where(np.isfinite(expected), expected, np.nan)
    given[0, 1] = np.nextafter(given[0, 1], 0.0)
    _check_covariance(given, expected, "$.here")
    given[0, 1] *= 1.001
    with pytest.raises(ValueError, match=r"\$\.here\[0\]\[1\]: must be 1\.1178833517395231e-11, by"):
        _check_covariance(given, expected, "$.here")
