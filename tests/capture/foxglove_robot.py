"""A robot with a Foxglove WebSocket: the messages of a log, sent by a real server of Foxglove's SDK."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import foxglove
from foxglove.websocket import Capability, ServerListener

from gtsam_rwhec.capture.sources import Message, messages_of_block
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.logs.mcap_reader import Log


def messages_of(path: Path) -> list[Message]:
    """All messages of a log by log time."""
    with open_log(path) as log:
        return _all(log)


def _all(log: Log) -> list[Message]:
    found = [each for file in log.files for block in file.blocks for each in messages_of_block(file, block)]
    return sorted(found, key=lambda message: message.received_ns)


def stamped(message: Message, stamp_ns: int) -> bytes:
    """The data of a message with another stamp, if it is JSON."""
    if message.channel.message_encoding != "json":
        return message.data
    content, time_ = json.loads(message.data), {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9}
    for part in [content, *content.get("transforms", ())]:
        if "timestamp" in part:
            part["timestamp"] = time_
    return json.dumps(content).encode()


@dataclass
class Received:
    """What a client published."""

    topic: str
    schema: str
    data: bytes


class Robot(ServerListener):
    """A context manager: the server runs inside it; ``send`` sends, and counts in `sent`."""

    def __init__(self, messages: Sequence[Message], port: int = 0, **options: Any) -> None:
        self.messages, self._options, self.port = messages, {"port": port, **options}, port
        self.sent: Counter[str] = Counter()
        self.received: list[Received] = []
        self.subscribed: Counter[str] = Counter()
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._of_clients: dict[int, Any] = {}
        #: Messages of topics with one message are sent to everyone who subscribes, as ROS does with latched ones.
        of_topic = Counter(message.channel.topic for message in messages)
        self._once = {m.channel.topic: m for m in messages if of_topic[m.channel.topic] == 1}
        for message in messages:
            topic, schema = message.channel.topic, message.schema
            if topic not in self._channels and schema is not None:
                described = foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
                encoding = message.channel.message_encoding
                self._channels[topic] = foxglove.Channel(
                    topic, schema=described, message_encoding=encoding, context=self._context
                )

    def __enter__(self) -> Robot:
        self._server = foxglove.start_server(
            context=self._context,
            server_listener=self,
            capabilities=[Capability.ClientPublish],
            **{"supported_encodings": ["cdr", "json"], **self._options},
        )
        self.port = self._server.port
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.stop()

    @property
    def address(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self.subscribed[channel.topic] += 1
        once = self._once.get(channel.topic)
        if once is not None:
            # The server knows the subscription once this returns.
            threading.Timer(0.2, lambda: self._channels[channel.topic].log(once.data)).start()

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        self._of_clients[channel.id] = channel

    def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
        channel = self._of_clients[client_channel_id]
        self.received.append(Received(channel.topic, channel.schema_name, bytes(data)))

    def wait_for_subscriptions(self, topics: Iterable[str], seconds: float = 20.0) -> None:
        until_s = time.monotonic() + seconds
        while not set(topics) <= set(self.subscribed):
            assert time.monotonic() < until_s, f"nobody subscribes to {set(topics) - set(self.subscribed)}"
            time.sleep(0.02)

    def send(self, speed: float = 1.0, *, as_now: bool = False, stop: threading.Event | None = None) -> None:
        """Send all messages once, in order and at their times; `as_now` stamps them with the time of their sending."""
        begun_ns, first_ns = time.time_ns(), self.messages[0].received_ns
        for message in self.messages:
            topic = message.channel.topic
            if topic in self._once:
                continue
            due_ns = begun_ns + round((message.received_ns - first_ns) / speed)
            if stop is not None and stop.is_set():
                return
            if (wait_ns := due_ns - time.time_ns()) > 0:
                time.sleep(1e-9 * wait_ns)
            self._channels[topic].log(stamped(message, due_ns) if as_now else message.data)
            self.sent[topic] += 1
