"""A session while the robot stands there: what comes is looked at, takes are written and calibrated, and shown.

Everything but detection and calibration runs in one event loop; whoever shows the session reads `state` and `pictures`
when `changed` says so, and gives `command`s.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from loky import ProcessPoolExecutor, cpu_count
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Judgement, Verdict
from gtsam_rwhec.capture.accuracy import Accuracy
from gtsam_rwhec.capture.live_answer import Answer, answer_of, calibrated
from gtsam_rwhec.capture.live_streams import Seen, SensorStream, Stillness, StillOptions, Streams
from gtsam_rwhec.capture.live_takes import CALIBRATION, RECORDED, RIG_FILE, TAKES, Takes
from gtsam_rwhec.capture.sources import FollowedFile, ReplayedLog, Source, is_of_transforms
from gtsam_rwhec.capture.sources_camera import PREFIX, STANDARD_INPUT, CameraSource
from gtsam_rwhec.capture.sources_folder import FolderSource
from gtsam_rwhec.capture.sources_foxglove import FoxgloveSource
from gtsam_rwhec.detect.many_images import ONE_THREAD, quiet_on_one_thread
from gtsam_rwhec.errors import LogError, RwhecError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs.mcap_index import MAGIC
from gtsam_rwhec.rig import Rig

#: Seconds: between two looks at what is pending; until a take that is not complete is given up; until a source that
#: lacks topics is said to lack them.
TICK_S, GIVE_UP_S, LACKS_AFTER_S = 0.1, 10.0, 3.0
#: A take waits for the images of a camera unless none came for so many seconds before.
QUIET_S = 3.0
#: What people can ask of a session, and the key for each.
COMMANDS = {"take": "t", "when_still": "w", "undo": "u", "save": "s", "stop": "q"}
#: At most this many of the last things that happened are shown.
MOST_SAID = 30
#: A pose is another one if it is this far from the last take's: metres, or radians.
NEW_M, NEW_RAD = 0.005, 0.01


@dataclass(frozen=True)
class LiveOptions:
    """Options of a session."""

    wanted: Accuracy | None = None  #: the accuracy that is wanted
    still: StillOptions = field(default_factory=StillOptions)
    #: Whether it takes by itself from the start, wherever the robot stands still at a new pose.
    takes_when_still: bool = False
    publish: str = ""  #: the topic on which poses are proposed; empty for none


@dataclass
class _Pending:
    """A take that waits for an image of each camera, and for poses."""

    after: int  #: images that came after this message
    by_itself: bool  #: whether the robot standing still asked for it
    begun_s: float = field(default_factory=time.monotonic)
    found: dict[str, Seen] = field(default_factory=dict)
    needed: frozenset[str] | None = None  #: the sensors; None: all that have images now


def _is_other_pose(T: Array, other: Array) -> bool:
    step = se3.logmap(se3.inverse(T[None]) @ other[None])[0]
    return float(np.linalg.norm(step[3:])) > NEW_M or float(np.linalg.norm(step[:3])) > NEW_RAD


class Session:
    """A session; `run` ends when it is stopped. Raises `LogError` where its folder cannot be used."""

    def __init__(self, source: Source, rig: Rig, folder: Path, options: LiveOptions) -> None:
        self.source, self.rig, self.options = source, rig, options
        of_clouds = [name for name, sensor in rig.sensors.items() if sensor.clouds is not None]
        if of_clouds:
            place = rig.source.place(("sensors", of_clouds[0], "clouds"))
            raise LogError(f"{place}: a session looks at images and detections; calibrate a log or folder of clouds")
        self.takes = Takes(folder)
        if source.is_at_rest and self.takes.all:
            raise LogError(f"{folder} has takes, and all images of {source.name} would be taken again; give another -o")
        self.streams = Streams(source, rig, options.still)
        self._still = Stillness(False, "no poses have come yet")
        self.when_still = options.takes_when_still or source.is_at_rest
        self.answer: Answer | None = None
        self.judgement: Judgement | None = None  #: of the last calibration that was saved
        self.ended = False
        self.viewers: set[asyncio.Event] = set()  #: set whenever there is something new to show
        self.said_count = 0  #: things that happened so far
        self._said: deque[tuple[str, str, str]] = deque(maxlen=MOST_SAID)
        self._pending: _Pending | None = None
        self._taken_T: Array | None = None  # the carriers' pose at the last take
        self._busy = ""  # what is being written, in words
        self._changes = self._saved = 0  # takes and undone ones so far, and at the last calibration that was saved
        self._failure: BaseException | None = None
        self._lacks_since_s = time.monotonic()
        self._tasks: set[asyncio.Task[None]] = set()
        self._answer_due, self._stopping = asyncio.Event(), asyncio.Event()
        self._writing, self._saving = asyncio.Lock(), asyncio.Lock()
        self._threads = ThreadPoolExecutor(cpu_count(), initializer=quiet_on_one_thread)
        self._process: ProcessPoolExecutor | None = None
        if self.takes.all:
            self.say(f"going on with {len(self.takes.all)} takes in {folder / TAKES}")
            self._changes += 1
            self._answer_due.set()

    async def run(self) -> None:
        """Run until somebody stops it. Raises `LogError` where the source cannot be read at all."""
        for work in (self._follow(), self._tick(), self._answer_takes()):
            self._begin(work)
        try:
            await self._stopping.wait()
            if self._failure is not None:
                raise self._failure
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            if self._process is not None:
                self._process.shutdown(wait=False, kill_workers=True)
            self._threads.shutdown(wait=False, cancel_futures=True)

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        """Start a task; if it fails the session ends with its error."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._task_ended)

    def _task_ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception() is not None:
            self._failure = self._failure or task.exception()
            self._stopping.set()

    # -- what people ask ------------------------------------------------------------------------------------------

    async def command(self, name: str) -> None:
        """Do what somebody asks; one of `COMMANDS`. A RwhecError says why it cannot be done."""
        if self.ended or self._stopping.is_set():
            raise RwhecError("the session has ended")
        if name == "take":
            self._pending = self._pending or _Pending(self.streams.number, by_itself=False)
        elif name == "when_still":
            self.when_still = not self.when_still
        elif name == "undo":
            await self._undo()
        elif name == "save":
            self._begin(self._save())
        elif name == "stop":
            self._begin(self._stop())
        else:
            raise RwhecError(f"there is no command {name[:40]!r}; there are {', '.join(COMMANDS)}")
        self.touch()

    async def take_at(self, pose: str) -> None:
        """Take the next images as seen from a pose that somebody typed. A RwhecError says why it cannot be done."""
        self.source.give_pose(pose)
        await self.command("take")

    def say(self, words: str, kind: str = "") -> None:
        """Add to what is shown of what happened; `kind` is empty, ``good`` or ``bad``."""
        self.said_count += 1
        self._said.append((time.strftime("%H:%M:%S"), kind, words))
        self.touch()

    def touch(self) -> None:
        """Let those who show the session look again."""
        for viewer in self.viewers:
            viewer.set()

    # -- what is shown --------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything that is shown, but for the pictures."""
        streams, takes = self.streams, self.takes.all
        return {
            "source": {
                "name": self.source.name,
                "is_connected": self.source.is_connected,
                "state": self.source.state,
                "takes_poses": self.source.takes_poses,
            },
            "cameras": [self._camera(stream) for stream in streams.sensors.values()],
            "still": {"is_still": self._still.is_still, "words": str(self._still)},
            "takes": {
                "count": len(takes),
                "pending": self._pending is not None and not self._pending.by_itself,
                "when_still": self.when_still,
                "is_saved": self._saved == self._changes,
            },
            "answer": None if self.answer is None else asdict(self.answer),
            "verdict": Verdict(self.answer.verdict).words if self.answer is not None and self.answer.verdict else "",
            "is_answering": self._answer_due.is_set(),
            "wanted": None if self.options.wanted is None else asdict(self.options.wanted),
            "troubles": [*self._lacking(), *streams.troubles()],
            "counted": [str(trouble) for trouble in self.source.troubles.values()],
            "said": list(self._said)[::-1],
            "busy": self._busy,
            "folder": str(self.takes.folder.resolve()),
            "ended": self.ended,
        }

    def _camera(self, stream: SensorStream) -> dict[str, Any]:
        seen = stream.latest
        topic = self.rig.sensors[stream.sensor].images or self.rig.sensors[stream.sensor].detections or ""
        return {
            "name": stream.sensor,
            "received": self.source.received[topic],
            "looked": stream.looked,
            "skipped": stream.skipped,
            "targets": {} if seen is None else {record.id: record.reason for record in seen.records},
            "fault": stream.fault or ("" if seen is None else seen.fault),
            "is_quiet": time.monotonic() - stream.received_s > QUIET_S,
        }

    def _lacking(self) -> list[str]:
        """What the source does not have, once it had time to say what it has."""
        if not self.source.is_connected:
            return [f"{self.source.name}: {self.source.state}"]
        missing = self.source.missing()
        if not missing:
            self._lacks_since_s = time.monotonic()
        return missing if time.monotonic() - self._lacks_since_s > LACKS_AFTER_S else []

    # -- what comes -----------------------------------------------------------------------------------------------

    async def _follow(self) -> None:
        try:
            async for message in self.source.messages():
                if self.source.is_at_rest and is_of_transforms(message.channel.topic, ""):
                    await self._nothing_pending()  # an instant after the other
                for seen in self.streams.take_in(message):
                    self._look_ended(seen)
                self._look()
        except RwhecError as error:
            if not self.streams.number:
                raise
            self.say(str(error), "bad")  # what was taken can still be saved
        self.say(self.source.state)
        await self._nothing_pending()
        if self.source.is_finite and self.options.takes_when_still:
            await self._stop()  # nobody needs to be there

    async def _nothing_pending(self) -> None:
        while self._pending is not None or any(each.is_looked_at for each in self.streams.sensors.values()):
            await asyncio.sleep(TICK_S)

    def _look(self) -> None:
        """Search images that wait, in threads."""
        for stream, work in self.streams.next_to_look_at():
            self._begin(self._look_at(stream, work))

    async def _look_at(self, stream: SensorStream, work: Callable[[], Seen]) -> None:
        seen = await asyncio.get_running_loop().run_in_executor(self._threads, work)
        self._look_ended(seen)
        await asyncio.sleep(max(0.0, stream.rests_until_s - time.monotonic()))
        self._look()

    def _look_ended(self, seen: Seen) -> None:
        self.streams.looked(seen)
        self.touch()
        if self.source.is_at_rest:
            self._ask_for_instant(seen)
        if self._pending is not None and seen.number > self._pending.after:
            self._pending.found.setdefault(seen.sensor, seen)

    def _ask_for_instant(self, seen: Seen) -> None:
        """Let the images of one instant of a folder be a take; they were all taken at rest."""
        topics = self.source.instants[seen.stamp_ns]  # type: ignore[attr-defined]
        sensors = frozenset(name for name, each in self.rig.sensors.items() if each.images in topics)
        if self.when_still and (self._pending is None or self._pending.needed is None):
            self._pending = _Pending(-1, by_itself=True, needed=sensors)

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(TICK_S)
            self.streams.read_poses()
            self._still = self.streams.stillness()
            if self.when_still and not self.source.is_at_rest:
                self._ask_when_still()
            if self._pending is not None:
                await self._go_on_with_take(self._pending)
            self.touch()

    # -- takes ----------------------------------------------------------------------------------------------------

    def _ask_when_still(self) -> None:
        """Ask for a take where the robot stands still, and has moved since the last one."""
        end = self.streams.latest_pose_ns
        if self._pending is not None or end is None or not self._still.is_still:
            return
        T = self.streams.pose_at(end)
        if T is not None and (self._taken_T is None or _is_other_pose(self._taken_T, T)):
            self._pending = _Pending(self.streams.number, by_itself=True)

    async def _go_on_with_take(self, pending: _Pending) -> None:
        """Write the take if all has come that it needs; give it up if that takes too long."""
        quiet_s = pending.begun_s - QUIET_S
        needed = pending.needed or frozenset(n for n, of in self.streams.sensors.items() if of.received_s > quiet_s)
        seen = list(pending.found.values())
        is_late = time.monotonic() - pending.begun_s > GIVE_UP_S
        if seen and (needed <= pending.found.keys() or is_late):
            why = self._why_not(seen, pending)
            knows_poses = all(self.streams.pose_at(self.streams.carriers_stamp(each)) is not None for each in seen)
            if not why and not knows_poses:
                if not is_late:
                    return
                why = "the carriers' poses at its images did not come"
            self._pending = None
            if why:
                if not pending.by_itself or self.source.is_at_rest:
                    self.say(f"not taken: {why}", "bad")
                return
            await self._write_take(seen)
        elif is_late:
            self._pending = None
            if not pending.by_itself:
                self.say("not taken: no image came that could be searched", "bad")

    def _why_not(self, seen: list[Seen], pending: _Pending) -> str:
        """Why images are no take; empty where they are."""
        if not any(each.counts for each in seen):
            reasons = sorted({f"{record.id} {record.reason}" for each in seen for record in each.records})
            return f"no camera sees a target that counts{f' ({chr(44).join(reasons)})' if reasons else ''}"
        stamps = [self.streams.carriers_stamp(each) for each in seen]
        if self.takes.all and min(stamps) <= self.takes.all[-1].stamp_ns:
            behind_s = 1e-9 * (self.takes.all[-1].stamp_ns - min(stamps))
            return (
                f"its stamp is {behind_s:.1f} s before the last take's: a clock was set back. Wait until it has caught "
                "up, undo, or begin another session with another folder (-o)"
            )
        if pending.by_itself and not self.source.is_at_rest and not self._is_still_at(seen):
            return "the robot moved"
        return ""

    def _is_still_at(self, seen: list[Seen]) -> bool:
        stamps = (self.streams.carriers_stamp(each) for each in seen)
        return self.source.is_at_rest or all(self.streams.stillness(stamp).is_still for stamp in stamps)

    async def _write_take(self, seen: list[Seen]) -> None:
        stamp = max(self.streams.carriers_stamp(each) for each in seen)
        is_still = self.source.takes_poses or self._is_still_at(seen)  # who types a pose says that it stands there
        messages = self.streams.of_take(seen)
        records = {each.sensor: each.records for each in seen}
        self._busy = "writing the take"
        try:
            async with self._writing:
                await asyncio.to_thread(self.takes.add, messages, records, stamp, is_still=is_still)
        except RwhecError as error:
            self.when_still = False
            self.say(f"not taken: {error} Make room, and take again.", "bad")
            return
        finally:
            self._busy = ""
        self._taken_T, self._changes = self.streams.pose_at(stamp), self._changes + 1
        count = sum(not record.reason for each in seen for record in each.records)
        moving = "" if is_still else "; the robot moved, so clocks and exposure count"
        self.say(f"take {len(self.takes.all)}: {count} targets in {len(seen)} images{moving}", "good")
        self._answer_due.set()

    async def _undo(self) -> None:
        async with self._writing:
            undone = await asyncio.to_thread(self.takes.undo)
        if undone is None:
            raise RwhecError("there is no take to undo")
        self.say(f"take {len(self.takes.all) + 1} undone")
        self._changes += 1
        self._answer_due.set()

    # -- answers --------------------------------------------------------------------------------------------------

    async def _answer_takes(self) -> None:
        while True:
            await self._answer_due.wait()
            paths = self.takes.paths
            if not paths:
                self.answer = None
            else:
                rig = self.takes.rig_for(self.rig)
                with self._said_if_killed():
                    self.answer = await self._in_process(answer_of, paths, rig, self.options.wanted)
            if self.takes.paths == paths:
                self._answer_due.clear()
            self._end_if_enough()
            self.touch()
            await self._publish()

    def _end_if_enough(self) -> None:
        """Take no more by itself where the wanted accuracy is reached."""
        decision = None if self.answer is None else self.answer.decision
        if decision is not None and decision.is_enough and self.when_still and not self.source.is_at_rest:
            self.when_still = False
            self.say(f"{decision.words} It takes no more by itself.", "good")

    async def _in_process(self, function: Callable[..., Any], *arguments: Any) -> Any:
        if self._process is None:
            self._process = ProcessPoolExecutor(1, env=ONE_THREAD)
        return await asyncio.wrap_future(self._process.submit(function, *arguments))

    async def _publish(self) -> None:
        if self.options.publish and self.answer is not None and self.answer.proposal is not None:
            proposal = self.answer.proposal
            try:
                await self.source.publish(self.options.publish, proposal.frame, np.array(proposal.T), time.time_ns())
            except RwhecError as error:
                self.say(str(error), "bad")

    # -- the end --------------------------------------------------------------------------------------------------

    async def _save(self) -> None:
        """Write the log of all takes, and calibrate from it as the command does."""
        if not self.takes.all:
            self.say("there is no take to save", "bad")
            return
        async with self._saving:
            changes, self._busy = self._changes, "saving: calibrating from the recorded log"
            self.touch()
            try:
                async with self._writing:
                    recorded, rig = await asyncio.to_thread(self.takes.record, self.rig)
                with self._said_if_killed():
                    self.judgement = await self._in_process(calibrated, recorded, rig, self.takes.folder / CALIBRATION)
                    self._saved = changes
                    self.say(f"saved: {RECORDED}, {RIG_FILE} and {CALIBRATION}/. {self.judgement}", "good")
            except RwhecError as error:
                self.say(f"no calibration was saved: {error}", "bad")
            finally:
                self._busy = ""
                self.touch()

    @contextmanager
    def _said_if_killed(self) -> Iterator[None]:
        try:
            yield
        except BrokenProcessPool as error:
            self._process = None
            self.say(f"the process that calibrates was ended from outside, for want of memory perhaps: {error}", "bad")

    async def _stop(self) -> None:
        self._pending, self.when_still = None, False
        while self._answer_due.is_set():  # that of the last take is shown at the end
            await asyncio.sleep(TICK_S)
        async with self._saving:
            is_saved = self._saved == self._changes
        if not is_saved:
            await self._save()
        self.ended = True
        self.touch()
        self._stopping.set()


def source_of(name: str, rig: Rig, speed: float | None = None, poses: str = STANDARD_INPUT) -> Source:
    """The source of a name: ``ws://HOST:PORT``, ``camera:0``, a folder, an MCAP file that grows, or one to replay.

    A file that its recorder has closed, and any with a speed, is replayed. Beside a camera of this machine ``poses`` is
    a file of lines that grows, or "-", standard input.

    Raises
    ------
    LogError
        There is no such source, or the rig file does not fit it.
    """
    if name.startswith(("ws://", "wss://")):
        return FoxgloveSource(name, rig)
    if name.startswith(PREFIX):
        return CameraSource(name, rig, poses)
    path = Path(name)
    if path.is_dir() and rig.carriers.poses.frames is not None:
        return FolderSource(name, rig)
    if path.is_dir() or speed is not None or _is_closed(path):
        return ReplayedLog(path, rig, speed or 1.0)
    if path.suffix.lower() != ".mcap":
        raise LogError(f"{name} is no source: give ws://HOST:PORT, camera:0, an MCAP file, or a folder of images")
    return FollowedFile(path, rig)


def _is_closed(path: Path) -> bool:
    """Whether a file ends as an MCAP file does that its recorder has closed."""
    try:
        with path.open("rb") as stream:
            size = stream.seek(0, 2)
            stream.seek(max(size - len(MAGIC), len(MAGIC)))  # one begins with the same bytes
            return stream.read() == MAGIC
    except OSError:
        return False
