"""The page of a session: a server on this machine, with a token in its address.

Refused is who does not know the token, who came by another name of this machine (so that no other site's name can be
pointed here), and a page of another site that opens the socket. There are few files, which are asked for by name: no
path is looked up on the disk.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import json
import secrets
import socket
import struct
import time
from importlib.resources import files
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from gtsam_rwhec.capture.live_session import COMMANDS, Session
from gtsam_rwhec.capture.live_streams import Seen
from gtsam_rwhec.errors import LogError, RwhecError
from gtsam_rwhec.files.terminal_text import brief

#: The page's files, and their types.
FILES = {
    "": ("live.html", "text/html"),
    "live.js": ("live.js", "text/javascript"),
    "live.css": ("live.css", "text/css"),
}
#: Nothing comes from elsewhere, nothing tells others the address, and no page shows this one.
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
#: Seconds between two states for a page. Pictures go at once.
STATE_S = 0.2
#: Bytes of the longest message of a page.
LONGEST_ASKED = 1000


class PageServer:
    """Serves the page of a session at `address`: a `host` of this machine, and a port, of which 0 is a free one.

    Raises `LogError` where the port is taken, or the host is not one of this machine's.
    """

    def __init__(self, session: Session, host: str = "127.0.0.1", port: int = 0) -> None:
        self._session, self._host, self._token = session, host, secrets.token_urlsafe(24)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host, port))
            self._socket.listen()  # a browser may come before the server does
        except OSError as error:
            self._socket.close()
            raise LogError(
                f"{host}, port {port}: no page can be served there ({error.strerror}); give another --port or --host"
            ) from error
        self.port = int(self._socket.getsockname()[1])
        routes = [
            Route("/{token}/", self._file),
            Route("/{token}/{name}", self._file),
            WebSocketRoute("/{token}/socket", self._page),
        ]
        self.app: ASGIApp = self._guarded(Starlette(routes=routes))

    @property
    def address(self) -> str:
        """The address of the page, with its token."""
        host = socket.gethostname() if self._host in ("0.0.0.0", "::") else self._host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self._token}/"

    async def serve(self) -> None:
        """Serve until the session has ended, and its pages know it."""
        config = uvicorn.Config(
            self.app, log_config=None, access_log=False, lifespan="off", ws="websockets-sansio", ws_max_size=1 << 16,
            server_header=False, timeout_graceful_shutdown=2,
        )  # fmt: skip
        server = uvicorn.Server(config)
        serving = asyncio.create_task(server.serve(sockets=[self._socket]))
        try:
            while not self._session.ended and not serving.done():
                await asyncio.sleep(STATE_S)
            await asyncio.sleep(2 * STATE_S)  # the last state is on its way
        finally:
            server.should_exit = True
            await serving

    def _guarded(self, app: ASGIApp) -> ASGIApp:
        async def guard(scope: Scope, receive: Receive, send: Send) -> None:
            if scope["type"] not in ("http", "websocket"):
                return
            why = self._why_not(HTTPConnection(scope), is_socket=scope["type"] == "websocket")
            if not why:
                await app(scope, receive, send)
            elif scope["type"] == "http":
                await PlainTextResponse(why, 403, HEADERS)(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1008, "reason": why})

        return guard

    def _why_not(self, asked: HTTPConnection, *, is_socket: bool) -> str:
        """Why a request is refused, in words; empty where it is not."""
        token = asked.scope["path"].split("/")[1]
        if not hmac.compare_digest(token.encode(), self._token.encode()):
            return "refused: the address needs the token that the command has printed"
        host = asked.headers.get("host", "")
        if not _is_of_this_machine(host, self._host):
            return "refused: this name is not of the machine that the command has printed"
        if is_socket and asked.headers.get("origin") != f"http://{host}":
            return "refused: the page of another site"
        return ""

    async def _file(self, request: Request) -> Response:
        known = FILES.get(request.path_params.get("name", ""))
        if known is None:
            return PlainTextResponse("there is no such file", 404, HEADERS)
        content = files("gtsam_rwhec.capture").joinpath("page", known[0]).read_bytes()
        return Response(content, media_type=known[1], headers=HEADERS)

    async def _page(self, page: WebSocket) -> None:
        """One page: what it asks is done, and what is new is sent to it, as fast as it takes it."""
        await page.accept()
        changed, drawing = asyncio.Event(), set[str]()
        changed.set()
        self._session.viewers.add(changed)
        showing = asyncio.create_task(self._show(page, changed, drawing))
        try:
            while True:
                sensor = await self._asked(page, await page.receive())
                if sensor is not None:
                    drawing.discard(sensor)
                    changed.set()
        except (WebSocketDisconnect, RuntimeError):  # the page was closed, maybe while it was answered
            return
        finally:
            self._session.viewers.discard(changed)
            showing.cancel()
            await asyncio.gather(showing, return_exceptions=True)

    async def _asked(self, page: WebSocket, message: Any) -> str | None:
        """Do what a page asks; the sensor whose picture it has drawn, if it says that."""
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", 1000))
        text = message.get("text")
        try:
            if text is None or len(text) > LONGEST_ASKED:
                raise RwhecError("the page sent bytes, or too much, in place of a command")
            said = json.loads(text)
            if isinstance(said, dict) and isinstance(said.get("drawn"), str):
                return str(said["drawn"])
            if isinstance(said, dict) and isinstance(said.get("take_at"), str):
                await self._session.take_at(said["take_at"])
                return None
            if not isinstance(said, dict) or said.get("do") not in (*COMMANDS,):
                raise RwhecError(f"the page sent {brief(text)} in place of one of {', '.join(COMMANDS)}")
            await self._session.command(said["do"])
        except (RwhecError, RecursionError) as error:
            await page.send_text(json.dumps({"error": str(error)}))
        except json.JSONDecodeError as error:
            await page.send_text(json.dumps({"error": f"the page sent no JSON: {error}"}))
        return None

    async def _show(self, page: WebSocket, changed: asyncio.Event, drawing: set[str]) -> None:
        """Send what is new; the next picture of a camera once the page has drawn the last one, so that none wait."""
        numbers: dict[str, int] = {}
        last, last_s = "", 0.0
        while True:
            await changed.wait()
            changed.clear()
            for sensor, stream in self._session.streams.sensors.items():
                is_new = stream.latest is not None and numbers.get(sensor) != stream.latest.number
                if stream.latest is not None and is_new and sensor not in drawing:
                    numbers[sensor] = stream.latest.number
                    drawing.add(sensor)
                    await page.send_bytes(_picture(stream.latest))
            if (wait_s := last_s + STATE_S - time.monotonic()) > 0.0:
                if not changed.is_set():
                    asyncio.get_running_loop().call_later(wait_s, changed.set)
                continue
            state = json.dumps(finite(self._session.state()))
            last_s = time.monotonic()
            if state != last:
                last = state
                await page.send_text(state)


def _is_of_this_machine(host: str, told: str) -> bool:
    """Whether a Host header names this machine: an address, localhost, its own name, or what the user said."""
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    name = name.strip("[]").lower()
    if name in ("localhost", told.lower(), socket.gethostname().lower()):
        return True
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def _picture(seen: Seen) -> bytes:
    """A picture for the page: the length of its head, the head in JSON, and the JPEG or PNG (or none)."""
    head = {
        "sensor": seen.sensor,
        "received_ms": 1e-6 * seen.message.received_ns,
        "seen_ms": 1e3 * seen.at_s,
        "size": seen.size,
        "targets": [
            {
                "name": record.id,
                "reason": record.reason,
                "corners": [] if record.corners_px is None else record.corners_px.round(1).tolist(),
                "is_tag": record.corners_px is not None and len(record.corners_px) == 4,
            }
            for record in seen.records
        ],
    }
    text = json.dumps(finite(head)).encode()
    return struct.pack("<I", len(text)) + text + seen.picture


def finite(value: Any) -> Any:
    """The same for JSON, which knows no infinity: None in its place."""
    if isinstance(value, float):
        return value if value - value == 0.0 else None
    if isinstance(value, dict):
        return {str(key): finite(each) for key, each in value.items()}
    return [finite(each) for each in value] if isinstance(value, (list, tuple)) else value
