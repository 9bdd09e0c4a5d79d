"""Result files."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path

from harness import Harness, scratch
from mutations import json_tree

from gtsam_rwhec.calibration.stages import calibrate
from gtsam_rwhec.fitting import refined, refinement
from gtsam_rwhec.results import result_file
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import solution as certified_solution

GOLDEN = Path(__file__).resolve().parents[1] / "golden"


def read(data: bytes) -> None:
    """The file, what it says in words, and the verdict on it."""
    result = result_file.parse_result(data, "fuzzed.json")
    str(result.solution.certificate)
    for direction in result.solution.identifiability.free_directions:
        str(direction)
    str(result.judgement)
    if result.refined is not None:
        for intrinsics in result.refined.intrinsics.values():
            assert intrinsics.camera.width == intrinsics.stated_camera.width == intrinsics.width
    if result.calibration is not None:
        for said in (*result.calibration.choices, *result.calibration.points, *result.calibration.findings):
            str(said)


def seeds() -> Iterable[bytes]:
    """Certified, with a free direction, with scales, refined, and of one call; of a log, and from corners."""
    folder = scratch()
    noise = Noise(0.005, 6000.0)
    problems = [
        general(1, 1, seed=1, noise=noise, number_of_measurements=8).problem,
        general(1, 1, seed=1, noise=noise, motion="planar", number_of_measurements=8).problem,
        general(
            2, 1, scale="per_target", seed=1, noise=noise, number_of_measurements=8, known_sizes=("target0",)
        ).problem,
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for problem in problems:
            solution = certified_solution.solve(problem)
            result_file.write_solution(solution, folder / "a.json")
            yield (folder / "a.json").read_bytes()
        better: refined.Refined = refinement.refine(problems[0], certified_solution.solve(problems[0]))
        calibrations = [calibrate(problem) for problem in problems[:2]]
    result_file.write_refined(better, folder / "b.json")
    yield (folder / "b.json").read_bytes()
    for calibration in calibrations:
        yield result_file.result_json(calibration)
    for name in ("log", "corners"):
        yield (GOLDEN / f"result_{name}.json").read_bytes()


HARNESS = Harness(read, seeds, json_tree)
