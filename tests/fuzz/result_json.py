"""Result files."""

from __future__ import annotations

from collections.abc import Iterable

from harness import Harness
from mutations import json_tree
from places import GOLDEN

from gtsam_rwhec.results import result_file


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
    """With a free direction and not refined, with scales, of one call, of a log, and from corners."""
    for path in sorted(GOLDEN.glob("result_*.json")):
        yield path.read_bytes()


HARNESS = Harness(read, seeds, json_tree)
