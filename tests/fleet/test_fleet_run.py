"""Runs over small fleets: rows, sums that do not depend on who makes them, and nothing done twice."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import gtsam
import numpy as np
import pytest
from fleets import MadeFleet, write_fleet

import gtsam_rwhec as rw
from gtsam_rwhec import fleet
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.fleet.fleet_report import remarks_of
from gtsam_rwhec.fleet.fleet_rows import PARQUET_FILE, read_parquet
from gtsam_rwhec.fleet.fleet_run import planned_logs
from gtsam_rwhec.fleet.tasks import InProcess
from gtsam_rwhec.geometry.pose_covariances import error_of


class Backwards(InProcess):
    """Tasks in the opposite order, as another number of workers may end them; and it counts them."""

    def __init__(self) -> None:
        self.keys: list[str] = []

    def run(self, tasks: Iterable[fleet.Task]) -> Iterator[fleet.Receipt | fleet.Failed]:
        listed = sorted(tasks, key=lambda task: task.key, reverse=True)
        self.keys += [task.key for task in listed]
        return super().run(listed)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeFleet:
    """Three robots, of which two are at one site; one log of the first is no log."""
    folder = tmp_path_factory.mktemp("fleet")
    found = write_fleet(folder, 3, 2, images=12, tags=2, sites={"hall": (1, 2)})
    (folder / "logs" / "robot_000" / "night_01.mcap").write_bytes(b"not a log")
    return found


@pytest.fixture(scope="module")
def first(made: MadeFleet, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, fleet.FleetRun]:
    """The first run, and its output."""
    output = str(tmp_path_factory.mktemp("first"))
    return output, fleet.run(fleet.read_manifest(made.manifest), output)


def test_every_robot_has_a_row_with_its_poses(made: MadeFleet, first: tuple[str, fleet.FleetRun]) -> None:
    output, run = first
    assert [(row.unit, row.robot) for row in run.rows] == [
        ("robot_000", "robot_000"),
        ("hall", "robot_001"),
        ("hall", "robot_002"),
    ]
    for row in run.rows:
        assert row.status is rw.Status.CERTIFIED
        assert [frame.name for frame in row.frames] == ["cam_0", "tag_0", "tag_1"]
        assert row.covariance is not None
        assert row.covariance.shape == (18, 18)
        assert row.cpu_s > 0.0
        for i, frame in enumerate(row.frames):
            xi = error_of(gtsam.Pose3(made.truth[row.robot][frame.name]), frame.T)
            deviations = np.sqrt(np.diagonal(row.covariance)[6 * i : 6 * i + 6])
            assert (np.abs(xi) < 6.0 * deviations).all()
        written = rw.read_refined(Path(output) / str(row.result))
        name = "cam_0" if row.site is None else f"{row.robot}/cam_0"
        assert written.Y[name].matrix().tolist() == row.frames[0].T.tolist()
    alone, *at_site = run.rows
    assert [log.url for log in alone.failed_logs] == [str(made.logs["robot_000"][1])]
    assert "is not an MCAP file" in alone.failed_logs[0].reason
    assert alone.logs == 1
    assert 20 <= alone.measurements <= 24, "less the outliers"
    assert not run.is_fine
    assert [row.logs for row in at_site] == [2, 2]
    assert at_site[0].frames[1].T.tolist() == at_site[1].frames[1].T.tolist(), "the site's tags are shared"
    assert all(row.is_fine for row in at_site)
    assert fleet.read_fleet(output)[0].measurements_sha256 == alone.measurements_sha256
    table = read_parquet((Path(output) / PARQUET_FILE).read_bytes(), PARQUET_FILE)
    assert [row.measurements_sha256 for row in table] == [row.measurements_sha256 for row in run.rows]


def test_a_second_run_reads_receipts(made: MadeFleet, first: tuple[str, fleet.FleetRun]) -> None:
    output, run = first
    engine = Backwards()
    again = fleet.run(fleet.read_manifest(made.manifest), output, engine=engine)
    assert len(engine.keys) == 1, "only the log that failed is tried again"
    assert (again.new_tasks, again.earlier_tasks) == (0, 7)
    assert [row.measurements_sha256 for row in again.rows] == [row.measurements_sha256 for row in run.rows]


def test_who_does_what_when_changes_no_bit(made: MadeFleet, first: tuple[str, fleet.FleetRun], tmp_path: Path) -> None:
    """Half of the files were lost when everything was killed; the rest is made in another order."""
    output, run = first
    whole = [path for path in Path(output).glob("partials/*") if path.is_file()]
    (tmp_path / "partials").mkdir()
    for path in sorted(whole)[::2]:
        (tmp_path / "partials" / path.name).write_bytes(path.read_bytes())
    again = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path), engine=Backwards())
    assert [row.measurements_sha256 for row in again.rows] == [row.measurements_sha256 for row in run.rows]
    for before, after in zip(run.rows, again.rows, strict=True):
        for one, other in zip(before.frames, after.frames, strict=True):
            assert one.T.tobytes() == other.T.tobytes()


def test_a_calibration_of_each_night(made: MadeFleet, first: tuple[str, fleet.FleetRun]) -> None:
    output, _ = first
    manifest = fleet.read_manifest(made.manifest)
    nights = fleet.run(manifest, output, "day")
    assert nights.new_tasks == 2, "the logs are read already"
    assert [(row.unit, row.failure is None) for row in nights.rows] == [
        ("robot_000", False),
        ("robot_000@2026-11-01", True),
        ("hall@2026-11-01", True),
        ("hall@2026-11-02", True),
        ("hall@2026-11-01", True),
        ("hall@2026-11-02", True),
    ]


@pytest.mark.slow
def test_a_calibration_of_each_log(made: MadeFleet, first: tuple[str, fleet.FleetRun]) -> None:
    alone = fleet.run(fleet.read_manifest(made.manifest), first[0], "log")
    assert [row.unit for row in alone.rows if row.failure is None] == [
        "robot_000@night_00",
        "robot_001@night_00",
        "robot_001@night_01",
        "robot_002@night_00",
        "robot_002@night_01",
    ]
    assert {row.site for row in alone.rows if row.failure is None} == {None}


def test_a_log_is_the_same_from_another_working_folder(made: MadeFleet, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(made.manifest).parent
    keys = []
    for here, manifest in ((folder, "fleet.yaml"), (folder / "logs", "../fleet.yaml")):
        monkeypatch.chdir(here)
        logs = planned_logs(fleet.read_manifest(manifest))
        keys.append([log.task.key for log in logs if log.task is not None])
    assert keys[0] == keys[1]
    assert len(keys[0]) == 6


def test_a_log_that_ends_in_the_middle_is_remarked(tmp_path: Path) -> None:
    """Its measurements count as far as they are there; that it was cut is said, in the row and on the terminal."""
    made = write_fleet(tmp_path / "fleet", robots=1, logs=1)
    [[log]] = made.logs.values()
    log.write_bytes(log.read_bytes()[: int(0.9 * log.stat().st_size)])
    [row] = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out")).rows
    assert row.verdict is not None
    said = "\n".join(row.findings)
    assert "night_00.mcap" in said
    assert row.verdict is not rw.Verdict.USE or remarks_of([row])


def test_an_output_that_cannot_be_written_is_refused_before_any_log_is_read(made: MadeFleet, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    engine = Backwards()
    with pytest.raises(RwhecError, match=r"about\.json"):
        fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "file" / "out"), engine=engine)
    assert engine.keys == []
