"""Files by URL: written once and whole, listed, stamped, counted; what stores do wrong; no secret in any message."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from gtsam_rwhec.errors import StoreError, StoreInterruptedError
from gtsam_rwhec.fleet import stores
from gtsam_rwhec.fleet.stores import counted_bytes, shown, without_secrets

CONTENT = bytes(range(256)) * 16


@pytest.fixture(params=["disk", "memory"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A folder on disk, and one in a store of fsspec."""
    return str(tmp_path) if request.param == "disk" else f"memory://{tmp_path.name}"


def test_written_once(folder: str) -> None:
    url = f"{folder}/robot_1/partial.npz"
    assert not stores.exists(url)
    assert not stores.write_once(url, CONTENT)
    assert stores.exists(url)
    before = stores.stamp_of(url)
    assert stores.write_once(url, CONTENT)  # it is there
    assert stores.stamp_of(url) == before
    assert not stores.write_once(url, b"other")  # damaged: made good
    assert stores.read_bytes(url) == b"other"
    assert stores.stamp_of(url) != before


def test_listed(folder: str) -> None:
    for name in ("b/2.mcap", "a/1.mcap", "a/c/3.mcap", "a/notes.txt"):
        stores.write_once(f"{folder}/{name}", b"x")
    assert stores.listed(f"{folder}/*/*.mcap") == [f"{folder}/a/1.mcap", f"{folder}/b/2.mcap"]
    names = [url.removeprefix(folder) for url in stores.listed(f"{folder}/**/*.mcap")]
    assert names == ["/a/1.mcap", "/a/c/3.mcap", "/b/2.mcap"]
    assert stores.listed(f"{folder}/nothing/*") == []


def test_ranges_are_counted(folder: str) -> None:
    url = f"{folder}/log"
    stores.write_once(url, CONTENT)
    with counted_bytes() as count:
        assert stores.read_ranges(url, [(3, 10), (100, 100), (4000, 4096)]) == [CONTENT[3:10], b"", CONTENT[4000:]]
    assert count.count == 103
    assert stores.size_of(url) == 4096


def test_what_is_not_there(folder: str) -> None:
    with pytest.raises(StoreError, match=r"/no: it is not there|/no.*No such file"):
        stores.read_bytes(f"{folder}/no")
    stores.write_once(f"{folder}/log", CONTENT)
    with pytest.raises(StoreError, match=r"log has 4096 bytes, and 100 at most are expected"):
        stores.read_bytes(f"{folder}/log", most_bytes=100)


def test_a_disk_that_refuses(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StoreError, match="Not a directory"):
        stores.write_once(str(tmp_path / "file" / "a"), b"x")


def test_two_who_write_at_once(tmp_path: Path) -> None:
    contents = [bytes([i]) * 100_000 for i in range(4)]
    writers = [threading.Thread(target=stores.write_once, args=(str(tmp_path / "a"), each)) for each in contents]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert (tmp_path / "a").read_bytes() in contents
    assert os.listdir(tmp_path) == ["a"]


def test_a_store_that_nobody_knows() -> None:
    with pytest.raises(StoreError, match="nosuchstore"):
        stores.exists("nosuchstore://anna:s3cretword@a/b")


class Faulty(BaseHTTPRequestHandler):
    """Breaks off in the middle of an answer, or refuses, as the path says; it counts what it was asked."""

    asked: list[str] = []  # noqa: RUF012  (of the class: each request has an object of its own)
    protocol_version = "HTTP/1.1"

    def do_HEAD(self) -> None:
        if self.path.startswith("/refused"):
            self.send_error(403, f"denied for {self.path}")
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(CONTENT)))
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("ETag", '"abc"')
        self.end_headers()

    def do_GET(self) -> None:
        self.asked.append(self.path)
        if self.path.startswith("/refused"):
            self.send_error(403, f"denied for {self.path}")
            return
        start, end = 0, len(CONTENT)
        wanted = self.headers.get("Range")
        if wanted and not self.path.startswith("/no_ranges"):
            first, last = wanted.removeprefix("bytes=").split("-")
            start, end = int(first), int(last) + 1
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{end - 1}/{len(CONTENT)}")
        else:
            self.send_response(200)
        breaks_off = self.path.startswith("/always") or (self.path.startswith("/once") and len(self.asked) == 1)
        self.send_header("Content-Length", str(end - start))
        self.end_headers()
        self.wfile.write(CONTENT[start : (start + end) // 2 if breaks_off else end])
        self.close_connection = True

    def log_message(self, *arguments: object) -> None:
        """Say nothing."""


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(stores, "PAUSE_S", 0.001)
    monkeypatch.setattr(Faulty, "asked", [])
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), Faulty)
    thread = threading.Thread(target=httpd.serve_forever, args=(0.01,))
    thread.start()
    yield f"http://127.0.0.1:{httpd.server_port}"
    httpd.shutdown()
    thread.join()
    httpd.server_close()


def test_a_store_that_breaks_off_once_is_asked_again(server: str) -> None:
    assert stores.read_bytes(f"{server}/once?sig=t0psecret") == CONTENT
    assert len(Faulty.asked) == 2


def test_a_store_that_stops_half_way(server: str) -> None:
    with pytest.raises(StoreInterruptedError) as told:
        stores.read_bytes(f"{server}/always/a.mcap?sig=t0psecret")
    assert isinstance(told.value, OSError)  # an engine tries the task again
    assert f"{server}/always/a.mcap?...: the store broke off or did not answer, 4 times" in str(told.value)
    assert "0 of 4096 bytes came, stopped at byte 0 of" in str(told.value)
    assert "t0psecret" not in str(told.value)
    assert len(Faulty.asked) == 4


def test_a_store_that_refuses(server: str) -> None:
    with pytest.raises(StoreError) as told:
        stores.read_ranges(f"{server}/refused?X-Amz-Signature=t0psecret&token=an0ther", [(0, 10)])
    assert not isinstance(told.value, StoreInterruptedError)
    assert "refused" in str(told.value)
    assert "Check the rights and the credentials" in str(told.value)
    assert "t0psecret" not in str(told.value)
    assert "an0ther" not in str(told.value)
    assert told.value.__cause__ is None
    assert told.value.__suppress_context__  # no traceback repeats the library's words
    assert len(Faulty.asked) == 1


def test_a_server_without_ranges_is_counted_for_what_it_sends(server: str) -> None:
    with counted_bytes() as count:
        assert stores.read_ranges(f"{server}/no_ranges", [(10, 20)]) == [CONTENT[10:20]]
    assert count.count == len(CONTENT)
    assert stores.stamp_of(f"{server}/no_ranges") == "4096-abc"


def test_a_server_that_nobody_reaches_is_not_a_file_that_is_not_there(server: str) -> None:
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(StoreInterruptedError, match="did not answer, 4 times") as told:
            stores.stamp_of(f"http://anna:s3cretword@127.0.0.1:{taken.getsockname()[1]}/a.mcap")
    assert "s3cretword" not in str(told.value)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("s3://bucket/robots/a.mcap", "s3://bucket/robots/a.mcap"),
        ("s3://bucket/robots/?.mcap", "s3://bucket/robots/?.mcap"),
        ("https://anna:s3cret@host:9000/a.mcap?X-Amz-Signature=ab12#c", "https://host:9000/a.mcap?..."),
        ("sftp://anna:p%40ss@host/a.mcap", "sftp://host/a.mcap"),
        ("/data/with@sign?/a.mcap", "/data/with@sign?/a.mcap"),
    ],
)
def test_urls_are_shown_without_them(url: str, words: str) -> None:
    assert shown(url) == words


@pytest.mark.parametrize(
    "said",
    [
        "Invalid request: AKIAIOSFODNN7EXAMPLE is not known",
        "GET https://host/a?X-Amz-Credential=abcdefgh&X-Amz-Signature=s1gnature&x=1 failed",
        "connecting to postgres://anna:s1gnature@host",
        "headers={'Authorization': 'Bearer s1gnature', 'Host': 'h'}",
        "secret_access_key = s1gnature",
        '{"aws_session_token": "s1gnature"}',
        "the key is 'quoted/and+more='",
        "the key is quoted%2Fand%2Bmore%3D",
        "user anna, password letmein99",
        "token of the environment: fromenvironment",
    ],
)
def test_words_are_without_them(said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SESSION_TOKEN", "fromenvironment")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "quoted/and+more=")
    clean = without_secrets(said, "https://anna:letmein99@host/a?sig=s1gnature")
    assert "***" in clean or "//host" in clean
    for secret in ("AKIAIOSF", "abcdefgh", "s1gnature", "quoted", "letmein99", "fromenvironment"):
        assert secret not in clean


def test_other_words_stay() -> None:
    said = "s3://bucket/keys/a.mcap: The specified key does not exist. (region: eu-1, token bucket empty)"
    assert without_secrets(said, "s3://bucket/keys/a.mcap") == said
