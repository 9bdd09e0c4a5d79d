"""A session: takes where the robot stands still, undo, going on with what is there, and the command's own result."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Channel, Schema
from stations import stations
from synthetic_logs import BEGIN_NS, Message, detections, rig, tag, transform, write

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.capture import Accuracy, StoppingRule, sources
from gtsam_rwhec.capture.live_answer import next_pose, stop_decision
from gtsam_rwhec.capture.live_session import LiveOptions, Session, source_of
from gtsam_rwhec.capture.live_takes import TakeInfo, Takes
from gtsam_rwhec.errors import LogError, RwhecError
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.logs.mcap_writer import json_schema
from gtsam_rwhec.results.result_file import read_result
from gtsam_rwhec.rig import Rig, read_rig
from gtsam_rwhec.runs import solve_log
from gtsam_rwhec.runs.cleaning_stage import cleaned
from gtsam_rwhec.runs.detection_stage import detected
from gtsam_rwhec.runs.solving_stage import Calibrated


class Given(sources.Source):
    """A source of given messages, a block of them at once; it goes on when the test says so."""

    def __init__(self, rig: Rig, *blocks: Sequence[Message]) -> None:
        super().__init__("given", rig)
        self.blocks, self.go_on = blocks, asyncio.Event()

    async def messages(self) -> AsyncIterator[sources.Message]:
        self.is_connected, self.state = True, "given"
        for block in self.blocks:
            for one in block:
                schema = Schema(1, json_schema(one.schema), "jsonschema", one.schema)
                self.topics[one.topic] = one.schema
                channel = Channel(1, one.topic, one.encoding, {}, 1)
                data = json.dumps(one.content).encode() if one.data is None else one.data
                if self.wants(one.topic, one.schema):
                    yield sources.Message(channel, schema, one.logged_ns, data)
                    await asyncio.sleep(0)
            await self.go_on.wait()
            self.go_on.clear()


async def until(session: Session, condition: Any, seconds: float = 30.0) -> None:
    end_s = time.monotonic() + seconds
    while not condition(session):
        assert time.monotonic() < end_s, session.state()
        await asyncio.sleep(0.02)


def take_count(session: Session) -> int:
    return len(session.takes.all)


def words(session: Session) -> str:
    return "\n".join(each for _, _, each in session.state()["said"])


@asynccontextmanager
async def at_work(source: Given, folder: Path) -> AsyncIterator[Session]:
    """A session while it runs; at the end it is stopped, and has ended."""
    session = Session(source, source.rig, folder, LiveOptions())
    running = asyncio.create_task(session.run())
    yield session
    session._stopping.set()
    await running


def solved(log_path: Path | list[Path], rig_file: Rig) -> Calibrated:
    with open_log(log_path) as log:
        return solve_log(cleaned(detected(log, rig_file), rig_file), None)


def test_it_takes_by_itself_where_the_robot_stands_still_and_saves_what_calibrate_gives(tmp_path: Path) -> None:
    log = write(tmp_path / "stations.mcap", stations(7))
    options = LiveOptions(wanted=Accuracy(1e-6, 0.8), takes_when_still=True)
    rig_file = rig()

    async def run() -> Session:
        session = Session(source_of(str(log), rig_file, 2.5), rig_file, tmp_path / "out", options)
        answers = []
        task = asyncio.create_task(session.run())
        while not task.done():
            await asyncio.sleep(0.05)
            answers.append(session.state())
        await task
        assert any(state["answer"] and state["answer"]["verdict"] for state in answers)
        assert all(state["takes"]["count"] == 0 or state["cameras"][0]["received"] for state in answers)
        return session

    session = asyncio.run(run())
    assert 6 <= take_count(session) <= 7
    assert all(take.is_still for take in session.takes.all)
    out = tmp_path / "out"
    answer = solved(out / "recorded.mcap", read_rig(out / "rig.yaml"))
    saved = read_result(out / "calibration" / "result.json")
    assert saved.refined is not None
    for name, T in (answer.refined.X | answer.refined.Y).items():
        same = (saved.refined.X | saved.refined.Y)[name]
        assert np.array_equal(T.matrix(), same.matrix())
    assert (out / "calibration" / "report.html").is_file()
    assert session.answer is not None
    assert session.answer.proposal is not None
    assert session.answer.decision is not None
    assert not session.answer.decision.is_enough
    assert "0.001 mm at 0.8 m" in session.answer.decision.words


@pytest.mark.slow
def test_it_takes_no_more_by_itself_where_the_wanted_accuracy_is_reached(tmp_path: Path) -> None:
    log = write(tmp_path / "stations.mcap", stations(8))
    rig_file = rig()
    options = LiveOptions(wanted=Accuracy(1.0, 0.8), takes_when_still=True)
    session = Session(source_of(str(log), rig_file, 2.5), rig_file, tmp_path / "out", options)
    asyncio.run(session.run())
    assert session.answer is not None
    assert session.answer.decision is not None
    assert session.answer.decision.is_enough, session.answer.decision.words
    session.when_still = True  # as it is while more messages come
    session._end_if_enough()
    assert not session.when_still
    assert "takes no more by itself" in words(session)


def test_taken_undone_and_gone_on_with(tmp_path: Path) -> None:
    rig_file, messages = rig(), stations(2)

    async def first() -> None:
        source = Given(rig_file, messages[:100], messages[100:])
        async with at_work(source, tmp_path) as session:
            await until(session, lambda s: s.streams.number == 100)
            with pytest.raises(RwhecError, match="there is no take to undo"):
                await session.command("undo")
            with pytest.raises(RwhecError, match="there is no command 'jump'"):
                await session.command("jump")
            await session.command("take")
            source.go_on.set()
            await until(session, lambda s: take_count(s) == 1)
            with pytest.raises(LogError, match="another session"):
                Takes(tmp_path)
            (take,) = session.takes.all
            with open_log(take.path) as log:
                topics = {topic.name: topic.count for topic in log.topics()}
                assert topics["/cam_0/tags"] == topics["/cam_1/tags"] == 1
                assert topics["/live/cam_0/detections"] == 1
                assert topics["/tf"] >= 25
                assert log.losses == []
            await session.command("undo")
            assert not take.path.exists()
            assert "take 1 undone" in words(session)
            await session.command("take")
            source.go_on.set()  # nothing more comes, so nothing is taken

    asyncio.run(first())
    unfinished = tmp_path / "takes" / ".0001.mcap.1.part"
    unfinished.write_bytes(b"half")
    takes = Takes(tmp_path)
    assert takes.all == []
    assert not unfinished.exists()


def test_a_take_without_targets_and_one_of_another_time_are_refused(tmp_path: Path) -> None:
    rig_file = rig()
    stranger = tag(77, np.eye(4))

    def at(t: float, *tags: Any) -> list[Message]:
        stamp = BEGIN_NS + round(1e9 * t)
        poses = [transform(stamp + round(1e9 * dt), "base", "hand", np.eye(4)) for dt in (-0.1, 0.1)]
        return [poses[0], *(detections(f"/{each}/tags", stamp, each, tags) for each in ("cam_0", "cam_1")), poses[1]]

    async def run() -> Session:
        seen = tag(0, np.eye(4), corners_px=np.array([[0, 0], [9, 0], [9, 9], [0, 9.0]]))
        source = Given(rig_file, at(10, seen), at(11, stranger), at(12, seen), at(5, seen))
        async with at_work(source, tmp_path) as session:
            await until(session, lambda s: s.streams.number == 4)
            for reason in ("no camera sees a target that counts", "take 1", "a clock was set back"):
                await session.command("take")
                source.go_on.set()
                await until(session, lambda s, reason=reason: reason in words(s))
            assert take_count(session) == 1
            assert any("clock set back" in each for each in session.state()["counted"])
        return session

    asyncio.run(run())


def test_a_full_disk_is_said_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource")
    rig_file, messages = rig(), stations(1)

    async def run() -> None:
        source = Given(rig_file, messages[:60], messages[60:])
        async with at_work(source, tmp_path) as session:
            await until(session, lambda s: s.streams.number == 60)
            before = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (500, before[1]))
            try:
                await session.command("take")
                source.go_on.set()
                await until(session, lambda s: "not taken" in words(s))
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, before)
            assert "cannot be written: File too large" in words(session)
            assert list((tmp_path / "takes").glob("*.mcap")) == []

    asyncio.run(run())


def test_no_clock_is_looked_for_where_the_robot_stood_still(tmp_path: Path) -> None:
    waiting = rig(cam_0="detections: /cam_0/tags\n    time_offset: estimate")
    takes = Takes(tmp_path)
    takes.all = [TakeInfo(Path("1.mcap"), 1, is_still=True)]
    assert takes.rig_for(waiting).sensors["cam_0"].time_offset == 0.0
    takes.all.append(TakeInfo(Path("2.mcap"), 2, is_still=False))
    assert takes.rig_for(waiting).sensors["cam_0"].time_offset == "estimate"


def test_a_rig_file_of_another_robot_is_named(tmp_path: Path) -> None:
    other = rig(poses="{tf: [base, hand]}\n  noise: {rotation_deg: 1, translation_mm: 1}")
    stamp = BEGIN_NS

    async def run() -> None:
        source = Given(other, [transform(stamp, "world", "tool0", np.eye(4))])
        async with at_work(source, tmp_path) as session:
            await until(
                session, lambda s: any("is the rig file of this robot?" in each for each in s.state()["troubles"])
            )
            session._lacks_since_s -= 10.0
            lacking = session.state()["troubles"]
            assert any("no topic /cam_0/tags. Topics there: /tf (foxglove.FrameTransforms)" in each for each in lacking)

    asyncio.run(run())


CAMERA = Camera.of(640, 480, "plumb_bob", [[500, 0, 320], [0, 500, 240], [0, 0, 1]], [], "")


def test_before_anything_is_known_boards_are_brought_to_outlines_inside_the_image() -> None:
    described = rig()
    proposal, outlook = next_pose(None, described, dict.fromkeys(described.sensors, CAMERA), Accuracy(0.0005, 0.8))
    assert proposal is not None
    assert proposal.words.startswith("Bring the board where the outline is")
    for name, outlines in proposal.outlines.items():
        assert name in described.sensors
        for outline in outlines:
            assert (np.array(outline) > 0.0).all()
            assert (np.array(outline) < (640.0, 480.0)).all()
    decision = stop_decision(StoppingRule(Accuracy(0.0005, 0.8)), None, 1, outlook)
    assert decision is not None
    assert not decision.is_enough
    assert decision.words == outlook
    assert "The cell is known roughly" in outlook


def test_without_a_camera_nothing_is_proposed() -> None:
    assert next_pose(None, rig(), {}, None) == (None, "")
    assert stop_decision(None, None, 1, "") is None


def test_the_rule_and_the_planner_speak_of_one_calibration() -> None:
    simulation = rw.simulate.general(1, 1, seed=3, noise=rw.simulate.Noise(0.001, 1e5), number_of_measurements=25)
    calibration = rw.calibrate(simulation.problem)
    proposal, outlook = next_pose(calibration, rig(), {}, Accuracy(1.0, 0.8))
    assert proposal is not None
    assert proposal.words.startswith("Move ")
    decision = stop_decision(StoppingRule(Accuracy(1.0, 0.8)), calibration, 25, outlook)
    assert decision is not None
    assert decision.is_enough
    assert decision.words.startswith("Stop: ")


def test_the_pose_is_of_the_carrier_that_moves() -> None:
    simulation = rw.simulate.general(1, 1, seed=3, noise=rw.simulate.Noise(0.001, 1e5), number_of_measurements=25)
    calibration = rw.calibrate(simulation.problem)
    in_hand, beside = rig(), rig(poses="{tf: [hand, base]}")
    assert (in_hand.carriers.sensors, in_hand.carriers.targets) == ("hand", "base")
    frames = [next_pose(calibration, described, {}, None)[0] for described in (in_hand, beside)]
    assert [one.frame for one in frames if one is not None] == ["base", "hand"]
