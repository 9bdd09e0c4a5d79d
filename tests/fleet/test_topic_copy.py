"""Only what a rig needs of a log travels, and the pipeline's readers take the copy as it is."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.writer import IndexType
from mixed_log import TOPICS, write_mixed_log
from s3_server import BUCKET, KEY, SECRET, S3Server, forget_stores, s3_server

from gtsam_rwhec.errors import LogWarning, StoreError, StoreInterruptedError
from gtsam_rwhec.fleet import stores, topic_copy
from gtsam_rwhec.fleet.stores import counted_bytes
from gtsam_rwhec.fleet.topic_copy import Needed, local_copy_of_topics, needed_of
from gtsam_rwhec.logs import Log, open_log

URL = f"s3://{BUCKET}/robot_1/run.mcap"


@pytest.fixture(scope="module")
def server() -> Iterator[S3Server]:
    with s3_server() as running:
        yield running


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, server: S3Server) -> Path:
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    write_mixed_log(path, seconds=10, large_bytes=100_000)
    stores.write_once(URL, path.read_bytes())
    return path


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "PAUSE_S", 0.001)


def messages_of(path: Path, topics: tuple[str, ...]) -> list[tuple[str, int, bytes]]:
    """By the other reader, which goes from front to back and looks at no index."""
    with open(path, "rb") as stream:
        read = NonSeekingReader(stream).iter_messages(topics, log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in read]


def blocks_of(log: Log) -> int:
    """The messages of all blocks, opened and checked as the pipeline's reader does."""
    return sum(len(log.files[0].open(block).heads) for block in log.files[0].blocks)


def test_few_bytes_travel_and_the_copy_has_all(log: Path, server: S3Server, tmp_path: Path) -> None:
    server.sent = 0
    with counted_bytes() as count:
        copy = local_copy_of_topics(URL, TOPICS, tmp_path)
    needed = needed_of(str(log), log.stat().st_size, TOPICS)
    assert isinstance(needed, Needed)
    assert needed.chunk_bytes < 0.3 * log.stat().st_size
    assert count.count == server.sent  # counted here as they left the store
    assert needed.chunk_bytes < server.sent <= 1.05 * needed.chunk_bytes
    wanted = (*TOPICS, "/static")  # all transforms
    assert messages_of(copy, wanted) == messages_of(log, wanted)
    with open(copy, "rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    assert summary.chunk_indexes
    with open_log(copy) as taken, open_log(log) as all_of_it:
        assert taken.losses == []
        assert [topic.name for topic in taken.topics()] == [topic.name for topic in all_of_it.topics()]
        counts = {topic.name: topic.count for topic in taken.topics()}
        assert counts == {"/tf": 200, "/detections": 200, "/static": 1, "/camera": 0}
        assert set(taken.metadata()) == {"gtsam_rwhec.rig"}
        assert blocks_of(taken) >= 401
        assert 0 < len(taken.files[0].blocks) < len(all_of_it.files[0].blocks)


def test_files_on_disk_are_read_where_they_are_if_that_is_cheaper(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert local_copy_of_topics(str(log), TOPICS, tmp_path) == log
    monkeypatch.setattr(topic_copy, "SMALL", 0)
    with counted_bytes() as count:
        assert local_copy_of_topics(log.as_uri(), TOPICS, tmp_path) == tmp_path / "run.mcap"
    assert count.count < 0.3 * log.stat().st_size
    assert local_copy_of_topics(str(log), ("/camera",), tmp_path) == log


@pytest.mark.parametrize("kind", ["no index", "cut", "index of another file"])
def test_logs_without_a_good_index_are_read_whole(kind: str, server: S3Server, log: Path, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    if kind == "no index":
        write_mixed_log(path, seconds=1, large_bytes=1000, index=IndexType.NONE)
    elif kind == "cut":
        path.write_bytes(log.read_bytes()[:400_000])
    else:
        write_mixed_log(path, seconds=10, large_bytes=100_000)
        content = bytearray(path.read_bytes())
        needed = needed_of(str(path), len(content), TOPICS)
        assert isinstance(needed, Needed)
        content[needed.chunks[0].chunk_start_offset] ^= 0x40  # no chunk begins there
        path.write_bytes(content)
    url = f"s3://{BUCKET}/{kind}/calibration.mcap"
    stores.write_once(url, path.read_bytes())
    with pytest.warns(LogWarning, match=rf"{url}: .*; all of its {path.stat().st_size} bytes are read"):
        copy = local_copy_of_topics(url, TOPICS, tmp_path)
    assert copy == tmp_path / "log_calibration.mcap"  # the stages write a calibration.mcap beside it
    assert copy.read_bytes() == path.read_bytes()


@pytest.mark.usefixtures("quick")
def test_a_store_that_stops_half_way(log: Path, server: S3Server, tmp_path: Path) -> None:
    server.cut_after = 50_000  # the index comes, the chunks do not
    try:
        with pytest.raises(StoreInterruptedError) as told:
            local_copy_of_topics(URL, TOPICS, tmp_path)
    finally:
        server.cut_after = None
    assert f"{URL}: the store broke off or did not answer, 4 times" in str(told.value)
    assert "bytes came, stopped at byte" in str(told.value)
    assert list(tmp_path.iterdir()) == []  # nothing that looks like a log


@pytest.mark.usefixtures("quick")
def test_no_message_no_log_and_no_file_has_a_secret(
    log: Path,
    server: S3Server,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    caplog.set_level(logging.INFO)
    said = []
    for endpoint in ("http://127.0.0.1:9", f"http://anna:{SECRET}@127.0.0.1:9"):  # nobody listens
        monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
        forget_stores()
        with pytest.raises((StoreError, StoreInterruptedError)) as told:
            local_copy_of_topics(URL, TOPICS, tmp_path)
        said.append(str(told.value))
    monkeypatch.undo()
    forget_stores()
    with pytest.raises(StoreError, match="it is not there") as told:
        stores.read_bytes(f"s3://{BUCKET}/nothing")
    captured = capfd.readouterr()
    files = [path.read_text(encoding="utf-8", errors="replace") for path in tmp_path.rglob("*") if path.is_file()]
    assert "the store broke off or did not answer" in said[0]
    for words in (*said, str(told.value), caplog.text, captured.out, captured.err, *files):
        assert SECRET not in words
        assert KEY not in words


def test_parts_are_cut_out_of_common_requests() -> None:
    content = np.random.default_rng(0).bytes(100_000)
    places = [(0, 10_000), (10_100, 9_000), (40_000, 50), (40_060, 5_000), (50_000, 50_000)]
    assert [len(each[2]) for each in topic_copy._joined(places)] == [2, 1, 1, 1]
    with warnings.catch_warnings(action="error"):
        url = "memory://parts/log"
        stores.write_once(url, content)
        assert list(topic_copy._parts(url, places)) == [content[a : a + n] for a, n in places]
