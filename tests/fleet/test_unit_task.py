"""A robot's calibration from its logs' measurements: what is kept of them; rig files and logs that disagree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fleets import rig_text, write_fleet
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec import fleet
from gtsam_rwhec.calibration import Finding, Ground
from gtsam_rwhec.fleet.partial_result import LogFacts, PairMeasurements, PartialResult, read_partial
from gtsam_rwhec.fleet.unit_problem import UnitProblem, check_rigs, disagreeing_logs
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.log_history import CleaningReport, DetectionReport
from gtsam_rwhec.rig import Rig, parse_rig
from gtsam_rwhec.simulate import Noise, general


@pytest.mark.slow
def test_clocks_of_several_logs_are_estimated_as_one(tmp_path: Path) -> None:
    """Rotations tell each log another offset; the poses of all tell one, with its deviation."""
    made = write_fleet(tmp_path, 1, 3, images=20, tags=2)
    rig = Path(made.rig)
    rig.write_text(rig.read_text(encoding="utf-8").replace("tags, ", "tags, time_offset: estimate, "), encoding="utf-8")
    (row,) = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out")).rows
    assert rw.Ground.COVARIANCE_DOUBTED not in row.grounds
    log = rw.results.read_result(tmp_path / "out" / str(row.result)).log
    assert log is not None
    (offset,) = log.time_offsets
    assert offset.sigma_s is not None
    assert abs(offset.offset_s) < 5.0 * offset.sigma_s < 0.005


def test_the_answer_is_from_corners(tmp_path: Path) -> None:
    made = write_fleet(tmp_path, 1, 2, images=12, tags=2)
    (row,) = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out")).rows
    assert row.failure is None, row.failure
    assert row.verdict is not rw.Verdict.DO_NOT_USE
    written = rw.read_refined(tmp_path / "out" / str(row.result))
    assert written.reprojection is not None
    assert abs(written.Y["cam_0"].translation() - made.truth["robot_000"]["cam_0"][:3, 3]).max() < 0.002


@pytest.mark.slow
def test_a_camera_that_moved_between_logs_is_said(tmp_path: Path) -> None:
    step = se3.expmap(np.array([[0.0, 0.003, 0.0, 0.002, 0.0, 0.001]]))[0]
    made = write_fleet(tmp_path, 2, 3, tags=2, seed=7, moved={(0, "cam_0"): (2, step)})
    moved, still = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out")).rows
    assert moved.grounds[0] is rw.Ground.COVARIANCE_DOUBTED
    assert "night_02.mcap puts it" in moved.reason
    assert still.verdict is rw.Verdict.USE


@pytest.mark.parametrize(
    ("sensor", "target", "named"),
    [
        ("wheels: {odometry: {topic: /odom}}", "", "wheels knows only its own motion"),
        ("lidar: {clouds: /points}", "  thing: {type: object}\n", "thing is an object in clouds"),
    ],
)
def test_a_robot_with_what_a_fleet_cannot_join_is_refused(sensor: str, target: str, named: str, tmp_path: Path) -> None:
    made = write_fleet(tmp_path, 1, 1, images=8, tags=1)
    rig = Path(made.rig)
    text = rig.read_text(encoding="utf-8").replace("targets:\n", f"  {sensor}\ntargets:\n{target}")
    rig.write_text(text, encoding="utf-8")
    (row,) = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out")).rows
    assert named in str(row.failure)


LOGS = ("monday.mcap", "tuesday.mcap", "wednesday.mcap")
PER_LOG = 20
CAMS = ["cam_0"]


def rig(text: str = "", **changed: float) -> Rig:
    return parse_rig(text or rig_text(CAMS, 2, **changed), "rig.yaml")  # type: ignore[arg-type]


def test_those_that_agree() -> None:
    more = rig(rig_text(["cam_0", "cam_1"], 3))
    check_rigs({"a": [("a.yaml", rig()), ("b.yaml", more)], "b": [("c.yaml", rig())]})


def test_a_targets_size() -> None:
    with pytest.raises(rw.errors.RigError, match=r"target tag_0 differs between a\.yaml and b\.yaml \(size_m: 0\.12 "):
        check_rigs({"a": [("a.yaml", rig())], "b": [("b.yaml", rig(size_m=0.1))]})


def test_a_cameras_intrinsics_within_a_robot_but_not_on_a_site() -> None:
    other = rig(focal=500.0)
    with pytest.raises(rw.errors.RigError, match=r"sensor cam_0 has other intrinsics in b\.yaml than in a\.yaml"):
        check_rigs({"a": [("a.yaml", rig()), ("b.yaml", other)]})
    check_rigs({"a": [("a.yaml", rig())], "b": [("b.yaml", other)]})


def test_the_carrier_of_targets_and_how_sizes_are_taken() -> None:
    text = rig_text(CAMS, 2).replace("base", "floor").replace("sizes: known", "sizes: estimate")
    with pytest.raises(rw.errors.RigError) as caught:
        check_rigs({"a": [("a.yaml", rig())], "b": [("s3://user:word@store/b.yaml", rig(text))]})
    assert "is base in a.yaml and floor in s3://store/b.yaml" in str(caught.value)
    assert "sizes is known in a.yaml and estimate in" in str(caught.value)
    assert "word" not in str(caught.value)


def findings(moved_m: float, seed: int) -> tuple[Finding, ...]:
    """What is found where the sensor is elsewhere in the last log."""
    made = general(2, 1, seed=seed, number_of_measurements=len(LOGS) * PER_LOG, noise=Noise(0.001, 1e4))
    problem, log_of = rw.Problem(), {}
    step = se3.expmap(np.array([[0.0, 0.0, 0.0, moved_m, 0.0, 0.0]]))[0]
    for pair in made.problem.pairs:
        raw = made.problem.measurements(*pair)
        log_of[pair] = np.repeat(np.arange(len(LOGS)), PER_LOG)
        B = np.where((log_of[pair] == 2)[:, None, None], np.linalg.inv(step) @ raw.B, raw.B)
        problem.add(*pair, raw.A, B)
    return disagreeing_logs(rw.calibrate(problem), UnitProblem(problem, None, (), None, log_of), LOGS)


@pytest.mark.parametrize("seed", range(3))
def test_logs_that_agree_are_not_doubted(seed: int) -> None:
    assert findings(0.0, seed) == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_sensor_that_moved_between_logs_is_named_with_the_log(seed: int) -> None:
    (found,) = findings(0.02, seed)
    assert found.ground is Ground.COVARIANCE_DOUBTED
    assert "the logs disagree" in found.words
    assert "wednesday.mcap puts it" in found.words


FACTS = LogFacts(
    url="log.mcap", begin_ns=0, end_ns=9, about="sensorcarrier", cameras={},
    detection=DetectionReport(sources=("log.mcap",), images={}, undecoded={}, tracks=(), strangers={}, corner_px={}),
    cleaning=CleaningReport(tracks=(), time_offsets_s={}, coarse_sigma_s={}), poses={"cam": 5},
)  # fmt: skip


def kept() -> PartialResult:
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (7, 1, 1))
    T[:, :3] = rng.normal(size=(7, 3, 4))
    root = rng.normal(size=(5, 6, 6))
    single = (root @ root.transpose(0, 2, 1)).astype(np.float32).astype(float)
    pixels = rng.uniform(0.0, 640.0, (5, 4, 2)).astype(np.float32).astype(float)
    pixels[0, 2] = np.nan
    stamps = 1_793_498_400_000_000_000 + np.array([0, 1, 5, 5, 9])
    one = PairMeasurements(stamps, T[:5], T[1:6], 0.5 * (single + single.transpose(0, 2, 1)), pixels)
    other = PairMeasurements(stamps[:2], T[:2], T[5:], None, None)
    return PartialResult(FACTS, {Pair("tag", "cam"): one, Pair("tag", "b"): other}, (stamps[:2], T[:2]))


def test_measurements_come_back_bit_for_bit() -> None:
    before = kept()
    found = read_partial(before.packed(), "file")
    assert found.facts == FACTS
    assert found.packed() == before.packed() == kept().packed()
    for pair, one in before.pairs.items():
        for name in ("stamps_ns", "A", "B", "covariances", "pixels"):
            np.testing.assert_array_equal(getattr(found.pairs[pair], name), getattr(one, name))
    assert found.path is not None
    assert before.path is not None
    np.testing.assert_array_equal(found.path[1], before.path[1])


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    content = kept().packed()
    for spoiled in (content[:-5], content[:40], b""):
        with pytest.raises(rw.errors.FileFormatError, match=r"^k\.partial .*run again"):
            read_partial(spoiled, "k.partial")
    made = write_fleet(tmp_path, 1, 1, images=8, tags=1, corners=False)
    output = tmp_path / "out"
    assert fleet.run(fleet.read_manifest(made.manifest), str(output)).rows[0].failure is None
    (file,) = output.glob("partials/*.partial")
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    for answer in output.glob("answers/*"):
        answer.unlink()
    (row,) = fleet.run(fleet.read_manifest(made.manifest), str(output)).rows
    assert "its checksum is not that of its receipt" in str(row.failure)
