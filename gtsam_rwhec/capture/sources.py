"""Where messages come from while the robot stands there: what all sources share, logs replayed, and files that grow."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mcap.records import Channel, Schema

from gtsam_rwhec.errors import BudgetError, LogError
from gtsam_rwhec.files.budgets import MIB, Spending
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs.foxglove_messages import Decoder, decoder_for
from gtsam_rwhec.logs.mcap_file import Block, GrowingFile, McapFile
from gtsam_rwhec.logs.mcap_index import MAGIC
from gtsam_rwhec.logs.mcap_reader import open_log
from gtsam_rwhec.logs.mcap_writer import LogWriter
from gtsam_rwhec.logs.records import TF_TOPICS, TRANSFORM_SCHEMAS, Record
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.topics_of_rig import check_topics, named_topics, wanted_topics

#: Seconds between two looks at a file or a folder.
POLL_S = 0.1
#: A message of a stream is decoded with the budget of a log of so many bytes.
AS_OF_A_LOG = 64 * MIB
#: A message names at most this many topics.
MOST_NAMED = 50


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """A message as it came, not decoded."""

    channel: Channel
    schema: Schema | None
    received_ns: int  #: by the clock of who received it; of a log, the log time
    data: bytes


@dataclass
class Trouble:
    """What came and could not be used, of one kind; ``str()`` is a sentence."""

    what: str
    first: str  #: the first of them, in words
    count: int = 0

    def __str__(self) -> str:
        return f"{self.what}: {self.count}; the first: {self.first}"


class Source(ABC):
    """Where messages come from. `messages` gives those that a rig file needs, and waits for more."""

    #: Whether everything that comes was taken at rest, with its own pose: images in a folder.
    is_at_rest = False
    #: Whether it has an end, as a log has that is replayed.
    is_finite = False
    #: Whether keys that are pressed at the terminal are commands; else standard input is the source's.
    reads_keys = True
    #: Whether somebody says where the robot stands: `give_pose`.
    takes_poses = False

    def __init__(self, name: str, rig: Rig) -> None:
        self.name, self.rig = name, rig
        self.state = "not connected yet"  #: in words
        self.is_connected = False
        self.topics: dict[str, str] = {}  #: the schema of every topic that is there, by name
        self.troubles: dict[str, Trouble] = {}  #: what could not be used, by kind
        self.received: Counter[str] = Counter()  #: messages by topic
        self._wanted = frozenset(wanted_topics(rig))

    @abstractmethod
    def messages(self) -> AsyncIterator[Message]:
        """The messages of the rig file's topics as they come; what cannot be used is in `troubles`.

        Raises
        ------
        LogError
            The source cannot be read, and waiting will not help.
        """

    async def publish(self, topic: str, frame: str, T: Array, stamp_ns: int) -> None:
        """Send a pose T_frame_proposed (4, 4), metres, to whoever listens there.

        Raises
        ------
        LogError
            The source takes no messages; the message says why.
        """
        raise LogError(f"{self.name} takes no messages: a pose is published to a Foxglove WebSocket (ws://...) only")

    def give_pose(self, line: str) -> None:
        """Say where the robot stands now: x y z qx qy qz qw of T_parent_child in metres, or the 16 numbers of a matrix.

        Raises
        ------
        LogError, FileFormatError
            The source has poses of its own; or the line is none.
        """
        raise LogError(f"{self.name} has poses of its own; they are typed beside a camera of this machine only")

    def wants(self, topic: str, schema: str) -> bool:
        """Whether the rig file needs a topic."""
        return topic in self._wanted or (self.rig.carriers.poses.topic is None and is_of_transforms(topic, schema))

    def messages_of(self, file: McapFile, block: Block, of: str) -> Iterator[Message]:
        """The messages of a file's block by log time; a damaged block counts as a part ``of`` its kind of file."""
        try:
            yield from messages_of_block(file, block)
        except BudgetError:
            raise
        except LogError as error:
            self.say(f"damaged parts of the {of}", str(error))

    def say(self, what: str, first: str) -> None:
        """Count what could not be used."""
        self.troubles.setdefault(what, Trouble(what, first)).count += 1

    def missing(self) -> list[str]:
        """What the rig file needs and the source does not have, a sentence each; they list what there is."""
        lacking = [
            f"{self.rig.source.place(path)}: {self.name} has no topic {topic}"
            for path, topic in named_topics(self.rig)
            if topic not in self.topics
        ]
        poses = self.rig.carriers.poses
        has_poses = any(is_of_transforms(*each) for each in self.topics.items())
        if poses.topic is not None and poses.topic not in self.topics:
            lacking.append(f"{self.rig.source.place(('carriers', 'poses'))}: {self.name} has no topic {poses.topic}")
        elif poses.topic is None and not has_poses:
            lacking.append(f"{self.rig.source.place(('carriers', 'poses'))}: {self.name} has no topic of transforms")
        named = [f"{topic} ({schema})" for topic, schema in sorted(self.topics.items())]
        there = some(named, MOST_NAMED) or "none"
        return [f"{words}. Topics there: {there}" for words in lacking]


def is_of_transforms(topic: str, schema: str) -> bool:
    """Whether a topic has transforms of the tree of frames."""
    return topic.rpartition("/")[2] in TF_TOPICS or schema in TRANSFORM_SCHEMAS


def messages_of_block(file: McapFile, block: Block) -> Iterator[Message]:
    """The messages of a file's block by log time. Raises `LogError` where it is damaged."""
    found = file.open(block)
    for i in np.argsort(found.heads["log_time"], kind="stable").tolist():
        channel = file.channels.get(int(found.heads["channel"][i]))
        if channel is not None:
            data = bytes(found.data[found.start[i] : found.end[i]])
            yield Message(channel, file.schemas.get(channel.schema_id), int(found.heads["log_time"][i]), data)


def written_messages(write: Callable[[LogWriter], None]) -> list[Message]:
    """What somebody writes to a log, as its messages."""
    with TemporaryDirectory() as temporary:
        path = Path(temporary) / "instant.mcap"
        with LogWriter(path) as out:
            write(out)
        with open_log(path) as log:
            return [message for block in log.files[0].blocks for message in messages_of_block(log.files[0], block)]


class ReplayedLog(Source):
    """A recorded log, replayed at a speed; 2 is twice as fast as it was recorded."""

    is_finite = True

    def __init__(self, path: Path, rig: Rig, speed: float) -> None:
        super().__init__(str(path), rig)
        self.path, self.speed = path, speed
        with open_log(path) as log:
            self.topics = {topic.name: topic.schema for topic in log.topics()}
            check_topics(log, rig)
            if any("carriers.poses" in words for words in self.missing()):
                raise LogError("; ".join(self.missing()))

    async def messages(self) -> AsyncIterator[Message]:
        """The log's messages at their times."""
        self.is_connected, self.state = True, f"replaying at {self.speed:g} times its speed"
        with open_log(self.path) as log:
            blocks = sorted(
                ((file, block) for file in log.files for block in file.blocks), key=lambda each: each[1].start_ns
            )
            for file in log.files:
                file.spending.begin_pass()
            begun_s, first_ns = time.monotonic(), min((block.start_ns for _, block in blocks), default=0)
            for file, block in blocks:
                for message in self.messages_of(file, block, "log"):
                    due_s = begun_s + 1e-9 * (message.received_ns - first_ns) / self.speed
                    await asyncio.sleep(max(0.0, due_s - time.monotonic()))
                    if self.wants(message.channel.topic, message.schema.name if message.schema else ""):
                        yield message
        self.state = "the log is at its end"


class FollowedFile(Source):
    """An MCAP file that a recorder is still writing."""

    def __init__(self, path: Path, rig: Rig) -> None:
        super().__init__(str(path), rig)
        self.path = path

    async def messages(self) -> AsyncIterator[Message]:
        """The messages that the file has, and those that come."""
        while not (self.path.is_file() and self.path.stat().st_size >= len(MAGIC)):
            self.state = "waiting for the file"
            await asyncio.sleep(POLL_S)
        file = GrowingFile(self.path)
        try:
            self.is_connected = True
            while not file.is_ended:
                self.state = "following the file"
                for block in file.new_blocks():
                    for message in self.messages_of(file, block, "file"):
                        schema = message.schema.name if message.schema else ""
                        self.topics[message.channel.topic] = schema
                        if self.wants(message.channel.topic, schema):
                            yield message
                    await asyncio.sleep(0)
                await asyncio.sleep(POLL_S)
            self.state = "the recorder has closed the file"
        finally:
            file.close()


class Reader:
    """Messages to records; what cannot be read is counted in the source's `troubles`."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._spending = Spending(Path(source.name), AS_OF_A_LOG)
        # By the schema and its encodings: a server that comes back describes its channels anew.
        self._decoders: dict[tuple[str, str, bytes, str], Decoder | str] = {}

    def __call__(self, messages: Sequence[Message]) -> list[tuple[Message, Sequence[Record]]]:
        """Messages of one channel with their records; those that cannot be read are left out."""
        topic, decoder = messages[0].channel.topic, self._decoder(messages[0].channel, messages[0].schema)
        self._source.received[topic] += len(messages)
        read: Sequence[Sequence[Record] | str] = [str(decoder)] * len(messages)
        if not isinstance(decoder, str):
            self._spending.begin_pass()
            try:
                read = decoder(topic, [each.data for each in messages], [each.received_ns for each in messages])
            except BudgetError as error:
                read = [str(error)] * len(messages)
        known = []
        for message, records in zip(messages, read, strict=True):
            if isinstance(records, str):
                self._source.say(f"topic {topic}, messages that cannot be read", records)
            else:
                known.append((message, records))
        return known

    def _decoder(self, channel: Channel, schema: Schema | None) -> Decoder | str:
        named = ("", "", b"") if schema is None else (schema.name, schema.encoding, schema.data)
        key = (*named, channel.message_encoding)
        if key not in self._decoders:
            try:
                self._decoders[key] = decoder_for(channel, schema, self._spending)
            except LogError as error:
                self._decoders[key] = str(error)
        return self._decoders[key]
