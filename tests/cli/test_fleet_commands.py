"""``gtsam-rwhec fleet watch``: exit statuses, the stream, the page, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from given_commands import command
from robot_nights import failed_night, robot_nights

from gtsam_rwhec.fleet import rows_json, rows_parquet

sys.path.insert(0, str(Path(__file__).parents[1] / "fleet"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A quiet fleet as an output of a run, and a robot that moved as Parquet."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "quiet").mkdir()
    quiet = [row for name in ("arm_0", "arm_1", "arm_2") for row in robot_nights(name, 12)]
    (folder / "quiet" / "fleet.json").write_bytes(rows_json([*quiet, failed_night("arm_0", 12)]))
    moved = robot_nights("arm_moved", 18, moved_at=14)
    (folder / "moved.parquet").write_bytes(rows_parquet(moved))
    return folder


def test_quiet_robots_give_status_0(runs: Path) -> None:
    status, said = command("fleet", "watch", runs / "quiet")
    assert status == 0
    assert said.startswith("Nothing moved by more than chance: 3 robots, 36 nights.")
    assert "1 nights say nothing and are left out: arm_0 2024-10-16 (no log was read)" in said


def test_as_a_process_it_streams_events_and_gives_status_1(runs: Path, tmp_path: Path) -> None:
    page = tmp_path / "drift.html"
    arguments = ["fleet", "watch", runs / "quiet", runs / "moved.parquet", "--stream", "-", "-o", page]
    done = subprocess.run(
        [sys.executable, "-m", "gtsam_rwhec", *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert [event["event"] for event in events] == ["watch", "no_answer", "alarm", "end"]
    assert (events[2]["robot"], events[2]["first_changed"][:10]) == ("arm_moved", "2024-10-18")
    assert done.stderr.startswith("Moved by more than chance: 1 of 4 robots, 54 nights: arm_moved.")
    html = page.read_text(encoding="utf-8")
    assert "arm_moved: cam moved between 2024-10-17 and 2024-10-18" in html


def test_alarms_before_a_day_do_not_count(runs: Path, tmp_path: Path) -> None:
    events = tmp_path / "events.jsonl"
    status, said = command(
        "fleet", "watch", runs / "moved.parquet", "--since", "2024-10-20", "--stream", events, "--every-night"
    )
    assert (status, said.split(":")[0]) == (0, "Nothing moved by more than chance since 2024-10-20")
    names = [json.loads(line)["event"] for line in events.read_text().splitlines()]
    assert (names.count("night"), names.count("alarm")) == (18, 1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing_here"], "nothing_here/fleet.json"),
        (["quiet", "--since", "yesterday"], "'yesterday' is no day; give one as 2026-11-23"),
        (["quiet", "--nights-between-false-alarms", "3"], "give 50 to 100000"),
        (["quiet/fleet.json", "-o", "quiet/fleet.json"], "the command reads it"),
    ],
)
def test_what_cannot_be_watched_is_said(
    runs: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(runs)
    status, said = command("fleet", "watch", *arguments)
    assert status == 2
    assert words in said


def test_robots_without_any_answer_give_status_2(tmp_path: Path) -> None:
    (tmp_path / "fleet.json").write_bytes(rows_json([failed_night("arm", 1)]))
    status, said = command("fleet", "watch", tmp_path)
    assert (status, said.split(":")[0]) == (2, "Nothing was watched")
