"""The page's server: who is refused, what nonsense is answered, and two pages at once; and the terminal's display."""

from __future__ import annotations

import asyncio
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Channel, Schema
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from stations import SQUARE, stations
from synthetic_logs import BEGIN_NS, detections, rig, tag, write

from gtsam_rwhec.capture.live_server import PageServer, finite
from gtsam_rwhec.capture.live_session import COMMANDS, LiveOptions, Session, source_of
from gtsam_rwhec.capture.live_terminal import drawn, show_on_terminal
from gtsam_rwhec.capture.sources import Message
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.terminal import SafeConsole


@pytest.fixture
def session(tmp_path: Path) -> Session:
    log = write(tmp_path / "log.mcap", stations(1))
    return Session(source_of(str(log), rig(), 1.0), rig(), tmp_path / "out", LiveOptions())


@pytest.fixture
def server(session: Session) -> PageServer:
    made = PageServer(session)
    yield made
    made._socket.close()


@pytest.fixture
def client(server: PageServer) -> TestClient:
    return TestClient(server.app, base_url=f"http://127.0.0.1:{server.port}")


def origin(server: PageServer) -> dict[str, str]:
    return {"origin": f"http://127.0.0.1:{server.port}"}


def socket(server: PageServer) -> str:
    return f"{server.address.replace('http', 'ws')}socket"


def test_the_page_and_nothing_else_is_served(server: PageServer, client: TestClient) -> None:
    page = server.address.removeprefix(f"http://127.0.0.1:{server.port}")
    for name, kind in (("", "text/html"), ("live.js", "text/javascript"), ("live.css", "text/css")):
        found = client.get(page + name)
        assert found.status_code == 200
        assert found.headers["content-type"].startswith(kind)
        assert "default-src 'none'" in found.headers["content-security-policy"]
        assert found.headers["referrer-policy"] == "no-referrer"
    climbing = ("../live_server.py", "%2e%2e/%2e%2e/pyproject.toml", "..%2f..%2frig.yaml", "/etc/passwd")
    for name in (*climbing, "live.html", "page/live.js"):
        assert client.get(page + name).status_code in (403, 404)


def test_who_has_no_token_or_comes_by_another_name_is_refused(server: PageServer, client: TestClient) -> None:
    page = server.address.removeprefix(f"http://127.0.0.1:{server.port}")
    for path in ("/", "/live.js", "/wrong/", f"{page[:-2]}/", "//", "/socket"):
        found = client.get(path)
        assert found.status_code == 403
        assert "token" in found.text
    assert client.get(page, headers={"host": "evil.example"}).status_code == 403
    assert client.get(page, headers={"host": f"localhost:{server.port}"}).status_code == 200
    assert client.get(page, headers={"host": "[::1]:80"}).status_code == 200
    for headers in ({}, {"origin": "http://evil.example"}, {"origin": "null"}):
        with pytest.raises(WebSocketDisconnect), client.websocket_connect(socket(server), headers=headers):
            pass
    with (
        pytest.raises(WebSocketDisconnect),
        client.websocket_connect(socket(server).replace(server._token, "x" * 32), headers=origin(server)),
    ):
        pass


def heard(page: Any, wanted: str) -> dict[str, Any]:
    """The next message with this field."""
    while wanted not in (said := json.loads(page.receive_text())):
        pass
    return said


def test_nonsense_is_answered_and_two_pages_are_shown_the_same(
    session: Session, server: PageServer, client: TestClient
) -> None:
    where = socket(server)
    with client.websocket_connect(where, headers=origin(server)) as one:
        assert heard(one, "takes")["takes"]["count"] == 0
        for nonsense in ("{", "[]", "7", '{"do": "rm -rf"}', '{"do": ["take"]}', "x" * 5000, "[" * 900, "\x00", "null"):
            one.send_text(nonsense)
            assert "the page sent" in heard(one, "error")["error"]
        one.send_bytes(b"\xff" * 10)
        assert "the page sent bytes" in heard(one, "error")["error"]
        one.send_text('{"do": "undo"}')
        assert "there is no take to undo" in heard(one, "error")["error"]
        one.send_text('{"take_at": "0 0 0 0 0 0 1"}')
        assert "has poses of its own" in heard(one, "error")["error"]
        with client.websocket_connect(where, headers=origin(server)) as other:
            assert heard(other, "takes")["takes"]["when_still"] is False
            one.send_text('{"do": "when_still"}')
            assert heard(one, "takes")["takes"]["when_still"] is True
            assert heard(other, "takes")["takes"]["when_still"] is True
    assert session.when_still


def test_a_port_that_is_taken_is_named(session: Session, server: PageServer) -> None:
    with pytest.raises(LogError, match="give another --port or --host"):
        PageServer(session, port=server.port)


def test_numbers_that_json_does_not_know_are_left_out() -> None:
    assert finite({"a": [float("inf"), 1.5, float("nan")], "b": (1, "x", None, True)}) == {
        "a": [None, 1.5, None], "b": [1, "x", None, True],
    }  # fmt: skip


def test_the_terminal_shows_the_same(session: Session) -> None:
    state = session.state() | {"troubles": ["a trouble"], "counted": ["lost: 2; the first: \x1b[31m"]}
    written = io.StringIO()
    SafeConsole(file=written, width=100).print(drawn(state))
    for expected in ("cam_0", "cam_1", "0 takes", "a trouble", "lost: 2", *COMMANDS.values()):
        assert expected in written.getvalue()
    assert "\x1b[31m" not in written.getvalue()


def test_what_happens_is_printed_once_until_the_end(session: Session) -> None:
    written = io.StringIO()

    async def run() -> None:
        session.say("the first")
        showing = asyncio.create_task(show_on_terminal(session, SafeConsole(file=written, width=100), draws=False))
        await asyncio.sleep(0.4)
        session.say("the second", "bad")
        session.ended = True
        await showing

    asyncio.run(run())
    assert [line.split(" ", 1)[1] for line in written.getvalue().splitlines()] == ["the first", "the second"]


def test_a_page_gets_the_next_picture_once_it_has_drawn_the_last(session: Session, server: PageServer) -> None:
    def see(t: float) -> None:
        sent = detections(
            "/cam_0/tags", BEGIN_NS + round(1e9 * t), "cam_0", [tag(0, np.eye(4), corners_px=SQUARE[:, :2])]
        )
        schema = Schema(1, b"{}", "jsonschema", sent.schema)
        message = Message(
            Channel(1, sent.topic, "json", {}, 1), schema, sent.logged_ns, json.dumps(sent.content).encode()
        )
        (seen,) = session.streams.take_in(message)
        session.streams.looked(seen)

    client = TestClient(server.app, base_url=f"http://127.0.0.1:{server.port}")
    with client.websocket_connect(socket(server), headers=origin(server)) as page:
        received: list[Any] = []

        def until(kind: str) -> Any:
            while kind not in (one := page.receive()):
                received.append(one)
            return one[kind]

        see(0.0)
        page.send_text('{"do": "when_still"}')
        first = until("bytes")
        assert json.loads(first[4 : 4 + int.from_bytes(first[:4], "little")])["targets"][0]["name"] == "tag_0"
        see(1.0)
        see(2.0)
        received.clear()
        page.send_text('{"do": "nothing"}')
        while "error" not in json.loads(until("text")):
            pass
        assert not any("bytes" in one for one in received)
        page.send_text('{"drawn": "cam_0"}')
        assert until("bytes")
