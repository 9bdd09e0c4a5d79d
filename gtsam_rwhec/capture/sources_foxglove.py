"""Messages of a Foxglove WebSocket, as foxglove_bridge has it on a robot; and poses that are sent back to it.

The protocol is https://github.com/foxglove/ws-protocol (docs/spec.md). Servers know it by one of two names.
"""

from __future__ import annotations

import asyncio
import base64
import json
import struct
import time
from collections.abc import AsyncIterator
from typing import Any

from mcap.records import Channel, Schema
from scipy.spatial.transform import Rotation
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidURI
from websockets.typing import Subprotocol

from gtsam_rwhec.capture.sources import Message, Source
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.budgets import CHUNK, SCHEMA
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs.mcap_writer import json_schema
from gtsam_rwhec.rig import Rig

#: The names of the protocol: of the bridges up to 2024, and of Foxglove's SDK and the bridges made with it.
SUBPROTOCOLS = [Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1")]
#: Seconds before the first try to connect again, and the most.
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 5.0
#: At most this many channels are described.
MOST_CHANNELS = 10_000
#: A binary message begins with the opcode, the number of the subscription and the time.
_HEAD = struct.Struct("<BIQ")
_MESSAGE_DATA = 1
#: Opcodes of binary messages, and operations in text, that say nothing of messages.
_OTHER_OPCODES = (2, 3, 4)
_OTHER_OPS = frozenset({
    "removeStatus", "parameterValues", "advertiseServices", "unadvertiseServices", "connectionGraphUpdate",
    "serviceCallFailure", "playbackState",
})  # fmt: skip
#: The encoding of schemas that goes with one of messages, where a server does not say it.
_SCHEMA_ENCODINGS = {"json": "jsonschema", "cdr": "ros2msg", "protobuf": "protobuf"}
#: The number of the channel of this client.
_OWN_CHANNEL = 1


class FoxgloveSource(Source):
    """The messages that a server sends; it is asked again where the connection is lost."""

    def __init__(self, name: str, rig: Rig) -> None:
        super().__init__(name, rig)
        self._socket: ClientConnection | None = None
        self._channels: dict[int, tuple[Channel, Schema | None]] = {}
        self._encodings: tuple[str, ...] = ()  #: in which the server takes messages
        self._published = ""  #: the topic that this client advertised to this server

    async def messages(self) -> AsyncIterator[Message]:
        """The server's messages; ends never."""
        wait_s = FIRST_WAIT_S
        while True:
            try:
                async with connect(
                    self.name, subprotocols=SUBPROTOCOLS, max_size=CHUNK, proxy=None, compression=None
                ) as socket:
                    self._begin(socket)
                    wait_s = FIRST_WAIT_S
                    async for frame in socket:
                        message = await self._message(frame)
                        if message is not None:
                            yield message
                self._end("the server closed the connection")
            except InvalidURI as error:
                raise LogError(f"{self.name} is no address of a WebSocket: {error}. Give ws://HOST:PORT") from error
            except InvalidHandshake as error:
                self._end(f"no Foxglove WebSocket answers ({error}); is it foxglove_bridge that listens there?")
            except ConnectionClosed as error:
                self._end(f"the connection was lost ({error})")
            except (OSError, TimeoutError) as error:
                words = error.strerror or str(error) if isinstance(error, OSError) else "no answer"
                self._end(f"no connection ({words}); does foxglove_bridge run there, and is the port open?")
            await asyncio.sleep(wait_s)
            wait_s = min(2.0 * wait_s, LONGEST_WAIT_S)

    async def publish(self, topic: str, frame: str, T: Array, stamp_ns: int) -> None:
        """Send a pose: ``geometry_msgs/msg/PoseStamped`` where the server takes CDR, else ``foxglove.PoseInFrame``."""
        if self._socket is None:
            raise LogError(f"{self.name}: the pose was not published, as there is no connection now")
        encoding = next((each for each in ("cdr", "json") if each in self._encodings), None)
        if encoding is None:
            raise LogError(
                f"{self.name} takes no messages of clients (in cdr or json; it takes: "
                f"{', '.join(self._encodings) or 'none'}). foxglove_bridge needs the capability clientPublish"
            )
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        position, time_ = T[:3, 3].tolist(), divmod(stamp_ns, 10**9)
        if encoding == "cdr":
            schema, data = "geometry_msgs/msg/PoseStamped", _pose_stamped(frame, time_, [*position, x, y, z, w])
        else:
            schema = "foxglove.PoseInFrame"
            pose = {"position": dict(zip("xyz", position, strict=True)), "orientation": dict(x=x, y=y, z=z, w=w)}
            stamp = dict(zip(("sec", "nsec"), time_, strict=True))
            data = json.dumps({"timestamp": stamp, "frame_id": frame, "pose": pose}).encode()
        try:
            if self._published != topic:
                channel = {"id": _OWN_CHANNEL, "topic": topic, "encoding": encoding, "schemaName": schema}
                if encoding == "json":
                    channel |= {"schema": json_schema(schema).decode(), "schemaEncoding": "jsonschema"}
                await self._socket.send(json.dumps({"op": "advertise", "channels": [channel]}))
                self._published = topic
            await self._socket.send(struct.pack("<BI", _MESSAGE_DATA, _OWN_CHANNEL) + data)
        except ConnectionClosed as error:
            raise LogError(f"{self.name}: the pose was not published, as the connection was lost") from error

    def _begin(self, socket: ClientConnection) -> None:
        self._socket, self._channels, self._encodings, self._published = socket, {}, (), ""
        self.topics.clear()
        self.is_connected, self.state = True, f"connected ({socket.subprotocol})"

    def _end(self, words: str) -> None:
        if self.is_connected:
            self.say("connections that were lost", words)
        self._socket, self.is_connected = None, False
        self.state = f"{words}; trying again"

    async def _message(self, frame: str | bytes) -> Message | None:
        """The message in a frame; None for a frame of another kind. Rubbish is counted."""
        if isinstance(frame, str):
            await self._heard(frame)
            return None
        if frame[:1] and frame[0] in _OTHER_OPCODES:
            return None
        if len(frame) < _HEAD.size or frame[0] != _MESSAGE_DATA:
            self.say("binary messages that are not of the protocol", f"{len(frame)} bytes, {brief(frame[:16])}")
            return None
        _, number, _ = _HEAD.unpack_from(frame)
        described = self._channels.get(number)
        if described is None:
            self.say("messages of channels that were not asked for", f"number {number}")
            return None
        return Message(*described, time.time_ns(), frame[_HEAD.size :])

    async def _heard(self, text: str) -> None:
        try:
            said = json.loads(text)
            op = said["op"]
            if op == "advertise":
                await self._advertised(said["channels"])
            elif op == "serverInfo":
                takes = "clientPublish" in said["capabilities"]
                self._encodings = tuple(map(str, said.get("supportedEncodings") or ())) if takes else ()
            elif op == "unadvertise":
                for number in said["channelIds"]:
                    gone = self._channels.pop(number, None)
                    if gone is not None:
                        self.topics.pop(gone[0].topic, None)
            elif op == "status":
                if said["level"] in (1, 2):
                    self.say("warnings of the server", brief(said["message"], 300))
            elif op not in _OTHER_OPS:
                raise ValueError("an unknown op")
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
            self.say("texts that are not of the protocol", brief(text))

    async def _advertised(self, channels: Any) -> None:
        """Subscribe to those that the rig file needs; a subscription has the number of its channel."""
        asked = []
        for each in channels:
            try:
                number, channel, schema = _described(each)
                if len(self.topics) >= MOST_CHANNELS:
                    raise ValueError(f"more than {MOST_CHANNELS}")
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                self.say("channels that are not described as the protocol says", f"{brief(each)} ({error!r})")
                continue
            self.topics[channel.topic] = schema.name if schema else ""
            if self.wants(channel.topic, self.topics[channel.topic]):
                self._channels[number] = channel, schema
                asked.append({"id": number, "channelId": number})
        if asked and self._socket is not None:
            await self._socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))


def _described(channel: Any) -> tuple[int, Channel, Schema | None]:
    """Number, channel and schema of a description; KeyError, TypeError or ValueError if it is none."""
    number, topic, encoding = channel["id"], channel["topic"], channel["encoding"]
    name, text = channel["schemaName"], channel.get("schema") or ""
    if type(number) is not int or not 0 <= number < 1 << 32:
        raise ValueError(f"id {brief(number)}")
    if not all(isinstance(each, str) for each in (topic, encoding, name, text)):
        raise TypeError("topic, encoding, schemaName or schema is no text")
    if len(text) > 2 * SCHEMA:
        raise ValueError(f"a schema of {len(text)} characters")
    kind = channel.get("schemaEncoding") or _SCHEMA_ENCODINGS.get(encoding, encoding)
    f"{topic}{encoding}{name}{kind}".encode()  # half a character could not be written
    data = base64.b64decode(text, validate=True) if kind in ("protobuf", "flatbuffer") else text.encode()
    schema = Schema(1, data, str(kind), name) if name else None
    return number, Channel(number, topic, encoding, {}, 1 if schema else 0), schema


def _pose_stamped(frame: str, time_: tuple[int, int], numbers: list[float]) -> bytes:
    """A ``geometry_msgs/msg/PoseStamped`` in CDR: x, y, z and the quaternion's x, y, z, w."""
    name = frame.encode() + b"\0"
    head = struct.pack("<iII", time_[0], time_[1], len(name)) + name
    return b"\0\1\0\0" + head + bytes(-len(head) % 8) + struct.pack("<7d", *numbers)
