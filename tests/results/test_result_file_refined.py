"""Result files of refined calibrations: poses and covariances come back, infinite ones too; damage is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from refinement_problems import copied, refined

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.fitting.refinement_from_poses import movements
from gtsam_rwhec.simulate import Motion, Noise, general

NOISE = Noise(sigma_m=0.005, kappa=0.5 / np.radians(0.5) ** 2)


def with_outliers() -> rw.Problem:
    """A quarter of one pair's measurements wrong; a shared scale."""

    def wrong(pair: rw.Pair, raw: rw.Measurements) -> np.ndarray:
        B = raw.B.copy()
        if pair == ("target1", "sensor0"):
            B[::4] = B[::4] @ gtsam.Pose3.Expmap(np.full(6, 0.8)).matrix()
        return B

    return copied(general(2, 2, seed=5, noise=NOISE, scale="shared", number_of_measurements=30).problem, B=wrong)


def fixed() -> rw.Problem:
    simulation = general(2, 2, seed=5, noise=NOISE)
    simulation.problem.fix("target0", simulation.X["target0"])
    return simulation.problem


KINDS: dict[str, Callable[[], rw.Refined]] = {
    "known scale": lambda: refined(general(2, 2, seed=5, noise=NOISE).problem),
    "scales of targets": lambda: refined(
        general(3, 2, seed=5, noise=NOISE, scale="per_target", known_sizes=["target0"]).problem, noise="estimate"
    ),
    "outliers": lambda: refined(with_outliers(), noise="estimate", robust="gnc"),
    "something free": lambda: refined(general(2, 2, seed=5, noise=NOISE, motion=Motion("planar")).problem),
    "fixed frame": lambda: refined(fixed()),
    "time offsets": lambda: refined(
        general(1, 2, seed=5, noise=NOISE, motion=Motion(wobble_m=0.1)).problem, time_offsets=True
    ),
    "motions": lambda: refined(general(0, 2, seed=5, odometry=20, odometry_noise=NOISE).problem),
}


@pytest.mark.parametrize("kind", KINDS)
def test_poses_and_covariances_come_back(kind: str, tmp_path: Path) -> None:
    answer = KINDS[kind]()
    rw.write_refined(answer, tmp_path / "refined.json")
    back = rw.read_refined(tmp_path / "refined.json")
    for poses, others in ((answer.X, back.X), (answer.Y, back.Y)):
        assert list(poses) == list(others)
        for name, pose in poses.items():
            np.testing.assert_array_equal(others[name].matrix(), pose.matrix())
            np.testing.assert_allclose(back.covariance(name), answer.covariance(name), rtol=1e-12)
    np.testing.assert_allclose(back.covariance(), answer.covariance(), rtol=1e-9, atol=1e-20)
    np.testing.assert_array_equal(back.joint.finite, answer.joint.finite)
    np.testing.assert_array_equal(back.joint.free, answer.joint.free)
    for name in (
        *("scale", "scale_mode", "time_offsets_s", "noise_source", "noise", "cost", "initial_cost", "iterations"),
        *("inlier_counts", "free_directions", "names", "degrees_of_freedom"),
    ):
        assert getattr(back, name) == getattr(answer, name), name
    assert back.moved == movements(answer.solution, back.X, back.Y)  # from the certified poses in the file
    if len(answer.Y) > 1:
        pose, covariance = back.relative("sensor0", "sensor1")
        assert pose.equals(answer.relative("sensor0", "sensor1")[0], 1e-15)
        np.testing.assert_allclose(covariance, answer.relative("sensor0", "sensor1")[1], rtol=1e-9, atol=1e-20)
    assert back.contains("sensor0", answer.Y["sensor0"])


def test_the_certified_solution_is_in_the_same_file(tmp_path: Path) -> None:
    answer = KINDS["outliers"]()
    rw.write_refined(answer, tmp_path / "refined.json")
    rw.write_solution(answer.solution, tmp_path / "solution.json")
    back = rw.read_solution(tmp_path / "refined.json")
    rw.write_solution(back, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "solution.json").read_bytes()
    raw = json.loads((tmp_path / "refined.json").read_bytes())
    assert [pose["child"] for pose in raw["certified"]["sensors"]] == list(answer.solution.Y)
    assert raw["sensors"] != raw["certified"]["sensors"]  # at the top are the poses to use, the refined ones
    assert not {"sensors", "targets"} & raw["refined"].keys()
    assert answer.inlier_counts["target1", "sensor0"] == (22, 30)


def test_infinite_is_null(tmp_path: Path) -> None:
    answer = KINDS["something free"]()
    rw.write_refined(answer, tmp_path / "refined.json")
    text = (tmp_path / "refined.json").read_text(encoding="utf-8")
    assert "Infinity" not in text
    assert "NaN" not in text
    for name, frame in json.loads(text)["refined"]["frames"].items():
        degrees, millimetres = answer.standard_deviations(name)
        for written, known in (
            (frame["standard_deviations_deg"], degrees),
            (frame["standard_deviations_mm"], millimetres),
            (np.array(frame["covariance"], dtype=object).ravel(), answer.covariance(name).ravel()),
        ):
            assert [value is None for value in written] == np.isinf(known).tolist()
        assert None in frame["standard_deviations_mm"]


def test_a_solution_that_was_not_refined_is_refused(tmp_path: Path) -> None:
    rw.write_solution(rw.solve(general(1, 1, seed=5, noise=NOISE).problem), tmp_path / "solution.json")
    with pytest.raises(FileFormatError, match=r"was not refined\. Read it with read_solution, or refine"):
        rw.read_refined(tmp_path / "solution.json")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda raw: raw["refined"]["joint"]["finite"].pop(), "slots have 24 rows"),
        (lambda raw: raw["refined"]["joint"]["finite"][3].pop(), "$.refined.joint.finite: rows of different lengths"),
        (lambda raw: raw["refined"]["joint"]["unit"].__setitem__(3, 0.0), "$.refined.joint.unit[3]"),
        (lambda raw: raw["refined"]["joint"]["free"].pop(), "slots have 24 rows"),
        (lambda raw: raw["sensors"][0].pop("translation_m"), "$.sensors[0].translation_m"),
        (lambda raw: raw["refined"].update(speed=1), "$.refined.speed"),
        (lambda raw: raw["refined"]["noise"][1].update(degrees_of_freedom=[1.0]), "degrees_of_freedom"),
        (lambda raw: raw["refined"]["noise"][1].update(sensor="moon"), "have no pose: moon"),
        (lambda raw: raw.pop("refined"), "$.certified.sensors: unknown field"),
    ],
)
def test_damage_is_refused_with_its_place(damage: Callable[[Any], object], said: str, tmp_path: Path) -> None:
    assert_refused("known scale", damage, said, tmp_path / "refined.json")


def assert_refused(kind: str, damage: Callable[[Any], object], said: str, path: Path) -> None:
    rw.write_refined(KINDS[kind](), path)
    raw = json.loads(path.read_text(encoding="utf-8"))
    damage(raw)
    path.write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(FileFormatError) as caught:
        rw.read_refined(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda raw: raw["scale"].pop("target1"), "but the targets are target0, target1, target2"),
        (lambda raw: raw["scale"].update(moon=1.0), "scale has target0, target1, target2, moon"),
        (lambda raw: raw["certified"]["scale"].pop("target1"), "but the targets are target0, target1, target2"),
        (lambda raw: raw["refined"]["joint"]["slots"].pop("scale:target1"), "that have no rows: scale:target1"),
    ],
)
def test_every_target_has_its_scale(damage: Callable[[Any], object], said: str, tmp_path: Path) -> None:
    assert_refused("scales of targets", damage, said, tmp_path / "refined.json")


def test_a_missing_offset_is_refused(tmp_path: Path) -> None:
    def damage(raw: Any) -> None:
        raw["refined"]["joint"]["slots"].pop("time_offset:sensor1")

    assert_refused("time offsets", damage, "that have no rows: time_offset:sensor1", tmp_path / "refined.json")
