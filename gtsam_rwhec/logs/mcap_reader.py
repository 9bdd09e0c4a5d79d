"""Logs in MCAP: their topics, and their messages as records in the order of time.

log = open_log("run.mcap")
for topic in log.topics():
    print(topic.name, topic.schema, topic.count)
for record in log.records(["/tf", "/detections"]):
    ...
"""

from __future__ import annotations

import heapq
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal

import numpy as np

from gtsam_rwhec.errors import BudgetError, LogError, LogWarning, MessageError
from gtsam_rwhec.files.budgets import MIB, LogBudget
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.files.whole_files import checked_path
from gtsam_rwhec.logs.foxglove_messages import Decoder, decoder_for
from gtsam_rwhec.logs.mcap_file import Block, McapFile, Messages
from gtsam_rwhec.logs.records import Array, PoseRecord, PoseSeries, Record, Topic

OnBad = Literal["warn", "raise"]
#: At most this number of messages is decoded together.
SLICE = 4096
#: Messages that are decoded together have at most this many bytes, but for a single one of more.
SLICE_BYTES = MIB
#: The records of a slice take about this many times its bytes: a transform of 80 bytes becomes 600.
RECORDS_FOR_A_BYTE = 4
#: An error lists at most this many topics, since logs may have thousands.
MOST_NAMED = 50


def open_log(path: str | Path | Iterable[str | Path]) -> Log:
    """Open an MCAP file, several (a bag that was split), or a folder of them (a ROS 2 bag).

    Raises
    ------
    LogError
        A file cannot be read or is not MCAP, or there is none.
    FileFormatError
        An argument is no path.
    BudgetError
        A file asks for more memory or work than one of its size may (``files/budgets.py``).
    """
    given = [path] if isinstance(path, str | Path) or not isinstance(path, Iterable) else list(path)
    paths: list[Path] = []
    for each in map(checked_path, given):
        paths += sorted(each.glob("*.mcap")) if each.is_dir() else [each]
    if not paths:
        raise LogError(f"{', '.join(map(str, given)) or 'an empty list'}: no MCAP files there.")
    files: list[McapFile] = []
    try:
        files += map(McapFile, paths)
    except LogError:
        for file in files:
            file.close()
        raise
    return Log(files)


class Log(AbstractContextManager["Log"]):
    """One or more MCAP files that `open_log` reads as one log. It is a context manager, which closes the files."""

    def __init__(self, files: list[McapFile]) -> None:
        self.files = files
        self._budget = LogBudget(sum(file.size for file in files))
        # By file, schema and encoding: thousands of channels may share one schema.
        self._decoders: dict[tuple[int, int, str], Decoder | str] = {}
        self.losses = [loss for file in files for loss in file.losses]
        if self.losses:
            warnings.warn("; ".join(self.losses), LogWarning, stacklevel=3)

    def __exit__(self, *raised: object) -> None:
        for file in self.files:
            file.close()

    def topics(self) -> tuple[Topic, ...]:
        """Every topic, by name. A topic with several schemas or encodings has one entry for each."""
        found: dict[tuple[str, str, str], Topic] = {}
        for number, file in enumerate(self.files):
            for channel in file.channels.values():
                schema = file.schemas.get(channel.schema_id)
                key = channel.topic, schema.name if schema else "", channel.message_encoding
                decoder = self._decoder(number, channel.id)
                span, before = file.spans.get(channel.id), found.get(key)
                known = [each for each in (span, before) if each is not None]
                firsts = [each.first_ns for each in known if each.first_ns is not None]
                lasts = [each.last_ns for each in known if each.last_ns is not None]
                count = sum(each.count for each in known)
                unreadable = decoder if isinstance(decoder, str) else ""
                found[key] = Topic(*key, count, min(firsts, default=None), max(lasts, default=None), unreadable)
        return tuple(found[key] for key in sorted(found))

    def topics_in_words(self) -> str:
        """The topics and their schemas, for messages. At most `MOST_NAMED` are named, as logs may have thousands."""
        return some([f"{topic.name} ({topic.schema})" for topic in self.topics()], MOST_NAMED) or "none"

    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records of all files by name; the last record of a name counts.

        They are found through a file's index, or, without one, by going through the file.
        """
        return {name: entries for file in self.files for name, entries in file.metadata().items()}

    def attachment(self, name: str) -> bytes | None:
        """The content that is attached under a name, or None if there is none. It is found as `metadata` is."""
        found = [data for file in self.files if (data := file.attachment(name)) is not None]
        return found[-1] if found else None

    def records(self, topics: Iterable[str] | None = None, on_bad: OnBad = "warn") -> Iterator[Record]:
        """Go through the log in the order of log time; without `topics`, all that can be read.

        Memory is bounded: only blocks of messages that overlap in time are open together. With ``on_bad="warn"``
        messages that cannot be read and damaged blocks are left out, and one `LogWarning` at the end says how many each
        topic lost, and the first fault; ``"raise"`` stops at the first fault.

        Raises
        ------
        LogError
            A topic is not in the log (the message has the log's topics) or cannot be read.
        BudgetError
            Too many bytes of chunks overlap in time; or the log asks for more memory or work than one of its size may.
        MessageError
            With ``on_bad="raise"``.
        """
        wanted = self._checked_topics(topics)
        bad = _Bad(on_bad)
        for file in self.files:
            file.spending.begin_pass()
        blocks = [(number, block) for number, file in enumerate(self.files) for block in file.blocks]
        blocks.sort(key=lambda entry: (entry[1].start_ns, entry[0]))
        # What is next by time: a block that is to be opened (False), or a record of one that is open (True).
        heap = [(block.start_ns, False, i) for i, (_, block) in enumerate(blocks)]
        waiting: dict[int, tuple[Record, Iterator[Record], int]] = {}
        open_bytes = 0
        while heap:
            _, is_open, i = heapq.heappop(heap)
            record: Record | None
            if is_open:
                record, records, size = waiting.pop(i)
                limit = heap[0][0] if heap else 1 << 64
                yield record
                for record in records:
                    if record.logged_ns >= limit:
                        break
                    yield record
                else:
                    record = None
            else:
                number, block = blocks[i]
                messages = self._opened(number, block, bad)
                if messages is None:
                    continue
                size = len(messages.data) + RECORDS_FOR_A_BYTE * min(len(messages.data), SLICE_BYTES)
                open_bytes += size
                if waiting and open_bytes > self._budget.open:
                    raise BudgetError(
                        f"{self.files[number].path}: {len(waiting) + 1} chunks overlap in time, which take "
                        f"{open_bytes} bytes together, and a log of {self._budget.size} bytes may take "
                        f"{self._budget.open}. Sort the log first (mcap sort)."
                    )
                records = self._records_of(number, messages, wanted, bad)
                del messages  # the generator keeps it for as long as it is needed
                record = next(records, None)
            if record is None:
                open_bytes -= size
            else:
                waiting[i] = record, records, size
                heapq.heappush(heap, (record.logged_ns, True, i))
            del record, records  # a block that is at its end must not wait for the next one to be opened
        bad.say()

    def records_logged_at(self, topics: Iterable[str], logged_ns: Iterable[int]) -> Iterator[Record]:
        """The records of some topics whose log time is one of these, in any order: only their blocks are opened.

        Leaves out without a warning what cannot be read, since `records` names it. Raises a LogError as `records`.
        """
        wanted, bad = self._checked_topics(topics), _Bad("warn")
        times = np.unique(np.fromiter(logged_ns, dtype=np.uint64))
        for number, file in enumerate(self.files):
            file.spending.begin_pass()
            for block in file.blocks:
                first = np.searchsorted(times, np.uint64(block.start_ns))
                end = np.searchsorted(times, np.uint64(block.end_ns), side="right")
                messages = self._opened(number, block, bad) if first < end else None
                if messages is not None:
                    some = np.flatnonzero(np.isin(messages.heads["log_time"], times))
                    yield from self._records_of(number, messages, wanted, bad, some)

    def poses(self, topic: str, parent: str | None = None, child: str | None = None) -> PoseSeries:
        """All poses of a topic (and of one pair of frames of it), sorted by their own stamps.

        Raises
        ------
        LogError
            As `records`; or the topic has no poses, or poses of several pairs of frames (the message has the pairs).
        """
        stamps: list[int] = []
        pairs: dict[tuple[str, str], None] = {}

        def transforms() -> Iterator[Array]:
            for record in self.records([topic]):
                if not isinstance(record, PoseRecord):
                    raise LogError(f"topic {topic} has no poses but {type(record).__name__}s")
                if parent in (None, record.parent) and child in (None, record.child):
                    pairs[record.parent, record.child] = None
                    stamps.append(record.stamp_ns)
                    yield record.T

        T: np.ndarray = np.fromiter(transforms(), np.dtype((np.float64, (4, 4))))
        if len(pairs) != 1:
            of = "; ".join(f"{a or '?'} to {b or '?'}" for a, b in list(pairs)[:20])
            raise LogError(f"topic {topic} has poses of {len(pairs)} pairs of frames ({of}); name parent and child")
        stamps_ns = np.array(stamps, dtype=np.int64)
        order = np.argsort(stamps_ns, kind="stable")
        return PoseSeries(stamps_ns[order], T[order], *next(iter(pairs)))

    def _checked_topics(self, topics: Iterable[str] | None) -> set[str] | None:
        if topics is None:
            return None
        wanted = {topics} if isinstance(topics, str) else set(topics)
        known = self.topics()
        for name in sorted(wanted - {topic.name for topic in known}):
            raise LogError(f"{self.files[0].path} has no topic {name}; it has: {self.topics_in_words()}.")
        for topic in known:
            if topic.name in wanted and topic.unreadable:
                raise LogError(f"{self.files[0].path}, topic {topic.name}: {topic.unreadable}.")
        return wanted

    def _decoder(self, number: int, channel_id: int) -> Decoder | str:
        """The function for a channel's messages, or the reason why there is none."""
        file = self.files[number]
        channel = file.channels.get(channel_id)
        if channel is None:
            return f"channel {channel_id} is not described in the file"
        key = number, channel.schema_id, channel.message_encoding
        if key not in self._decoders:
            try:
                self._decoders[key] = decoder_for(channel, file.schemas.get(channel.schema_id), file.spending)
            except BudgetError:
                raise
            except MessageError as error:
                self._decoders[key] = str(error)
        return self._decoders[key]

    def _opened(self, number: int, block: Block, bad: _Bad) -> Messages | None:
        """The messages of a block; None if it is damaged, which `bad` notes."""
        file = self.files[number]
        try:
            return file.open(block)
        except BudgetError:
            raise
        except LogError as error:
            bad.add(f"{file.path}", error)
            return None

    def _records_of(
        self, number: int, messages: Messages, wanted: set[str] | None, bad: _Bad, some: np.ndarray | None = None
    ) -> Iterator[Record]:
        """Records of one block, or of `some` of its messages, by log time. They are decoded a slice at a time."""
        file = self.files[number]
        log_time = messages.heads["log_time"]
        order = np.argsort(log_time, kind="stable") if some is None else some
        data = memoryview(messages.data)
        sizes = np.asarray(messages.end, dtype=np.int64) - np.asarray(messages.start, dtype=np.int64)
        for places in _slices(order, sizes):
            channels = messages.heads["channel"][places]
            read: dict[int, Sequence[Record]] = {}
            for channel_id in np.unique(channels).tolist():
                members = places[channels == channel_id].tolist()
                decoder = self._decoder(number, channel_id)
                if isinstance(decoder, str):
                    if channel_id not in file.channels:
                        bad.add(f"{file.path}", MessageError(decoder), len(members))
                    continue
                topic = file.channels[channel_id].topic
                if wanted is not None and topic not in wanted:
                    continue
                is_cdr = file.channels[channel_id].message_encoding == "cdr"
                if not is_cdr and len(members) == 1 and sizes[members[0]] > file.spending.budget.message:
                    fault = (
                        f"{file.path}, topic {topic}: a message of {sizes[members[0]]} bytes is beyond the limit of "
                        f"{file.spending.budget.message} for a log of {file.size} bytes"
                    )
                    bad.add(f"topic {topic}", MessageError(fault))
                    continue
                cut = [data[messages.start[i] : messages.end[i]] for i in members]
                results = decoder(topic, cut, log_time[members].tolist())
                file.spending.take_parts(sum(len(result) for result in results if not isinstance(result, str)))
                for i, result in zip(members, results, strict=True):
                    if isinstance(result, str):
                        bad.add(f"topic {topic}", MessageError(f"{file.path}, topic {topic}: {result}"))
                    else:
                        read[i] = result
            for i in places.tolist():
                yield from read.pop(i, ())


def _slices(order: np.ndarray, sizes: np.ndarray) -> Iterator[np.ndarray]:
    """Parts of `order` of at most `SLICE` messages and `SLICE_BYTES` bytes; a larger message is alone."""
    ends = np.cumsum(sizes[order])
    start = 0
    while start < len(order):
        before = int(ends[start - 1]) if start else 0
        end = int(np.searchsorted(ends, before + SLICE_BYTES, side="right"))
        end = max(start + 1, min(end, start + SLICE))
        yield order[start:end]
        start = end


class _Bad:
    """Counts and first faults of what could not be read in a log."""

    def __init__(self, on_bad: OnBad) -> None:
        self._on_bad = on_bad
        self._first: dict[str, LogError] = {}
        self._counts: dict[str, int] = {}

    def add(self, where: str, error: LogError, count: int = 1) -> None:
        if self._on_bad == "raise":
            raise error
        self._first.setdefault(where, error)
        self._counts[where] = self._counts.get(where, 0) + count

    def say(self) -> None:
        if self._first:
            parts = [f"{where}: {self._counts[where]} left out, the first: {e}" for where, e in self._first.items()]
            warnings.warn("; ".join(parts), LogWarning, stacklevel=3)
