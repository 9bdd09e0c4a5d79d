"""Sources: a log replayed, a file that grows, a folder, and Foxglove's WebSocket with all that can go wrong there."""

from __future__ import annotations

import asyncio
import importlib
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_robot import Robot, messages_of
from hypothesis import given, settings
from hypothesis import strategies as st
from places import CELL, EXAMPLES
from rwhec_factors import se3
from stations import stations
from synthetic_logs import rig, write
from websockets.asyncio.server import ServerConnection, serve

from gtsam_rwhec.capture.live_session import source_of
from gtsam_rwhec.capture.sources import FollowedFile, Message, Reader, ReplayedLog, Source
from gtsam_rwhec.capture.sources_folder import FolderSource
from gtsam_rwhec.capture.sources_foxglove import FoxgloveSource, _pose_stamped
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import ImageRecord, PoseRecord, open_log
from gtsam_rwhec.logs.ros2_messages import ros2_decoder
from gtsam_rwhec.rig import parse_rig, read_rig
from gtsam_rwhec.runs import write_folder_log

OPS = ("advertise", "serverInfo", "unadvertise", "status", "removeStatus")
KEYS = (
    "op", "channels", "id", "topic", "encoding", "schemaName", "schema", "schemaEncoding", "capabilities",
    "supportedEncodings", "channelIds", "level", "message",
)  # fmt: skip
ROS2_RIG = CELL / "eye_to_hand.yaml"


async def taken(source: Source, count: int, seconds: float = 20.0) -> list[Message]:
    """The first messages of a source."""
    found: list[Message] = []

    async def follow() -> None:
        async for message in source.messages():
            found.append(message)
            if len(found) >= count:
                return

    await asyncio.wait_for(follow(), seconds)
    return found


def test_a_log_is_replayed_byte_for_byte_at_its_speed(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap", stations(1))
    source = source_of(str(path), rig(), 8.0)
    assert isinstance(source, ReplayedLog)

    async def run() -> float:
        begun = asyncio.get_running_loop().time()
        messages = await taken(source, 10_000)
        assert [(m.channel.topic, m.data) for m in messages] == [(m.channel.topic, m.data) for m in messages_of(path)]
        return asyncio.get_running_loop().time() - begun

    assert asyncio.run(run()) >= 1.5 / 8.0


def test_what_the_log_lacks_is_said_before_it_is_replayed(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap", stations(1))
    with pytest.raises(LogError, match=r"no topic /cam_9/tags; it has: /cam_0/tags"):
        source_of(str(path), rig(cam_0="detections: /cam_9/tags"))
    only_images = write(tmp_path / "other.mcap", [m for m in stations(1) if m.topic != "/tf"])
    with pytest.raises(LogError, match=r"no topic of transforms\. Topics there: /cam_0/tags"):
        source_of(str(only_images), rig())
    with pytest.raises(LogError, match="is no source: give ws://HOST:PORT, camera:0"):
        source_of(str(tmp_path / "nothing"), rig())


def test_a_file_that_grows_is_followed_to_its_end(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap", stations(1), chunk_size=2000).read_bytes()
    path = tmp_path / "growing.mcap"
    source = source_of(str(path), rig())
    assert isinstance(source, FollowedFile)

    async def recorder() -> None:
        for end in [4, 8, 3001, *range(9000, len(whole), 40_000), len(whole)]:  # in the middle of records
            path.write_bytes(b"") if not path.exists() else None
            with path.open("ab") as stream:
                stream.write(whole[path.stat().st_size : end])
            await asyncio.sleep(0.12)

    async def run() -> list[Message]:
        writing = asyncio.create_task(recorder())
        found = [message async for message in source.messages()]
        await writing
        return found

    found = asyncio.run(run())
    assert [m.data for m in found] == [m.data for m in messages_of(tmp_path / "whole.mcap")]
    assert source.troubles == {}
    assert source_of(str(path), rig()).is_finite  # its recorder has closed it: it is replayed


def test_a_robot_s_messages_come_by_foxglove_s_own_server() -> None:
    rig_file = read_rig(ROS2_RIG)
    with Robot(messages_of(CELL / "eye_to_hand.mcap")[:200]) as robot:

        async def run() -> tuple[FoxgloveSource, list[Message]]:
            source = FoxgloveSource(robot.address, rig_file)
            gathering = asyncio.create_task(taken(source, 100))
            await asyncio.to_thread(robot.wait_for_subscriptions, ["/tf", "/tf_static", "/cam_front/image/compressed"])
            await asyncio.sleep(0.3)  # what is latched comes first
            sending = asyncio.create_task(asyncio.to_thread(robot.send, 20.0))
            found = await gathering
            await sending
            return source, found

        source, found = asyncio.run(run())
        assert source.missing() == []
        read = Reader(source)
        records = [record for message in found for _, of in read([message]) for record in of]
        assert {type(record) for record in records} >= {ImageRecord, PoseRecord}
        assert {"/tf_static", "/cam_front/camera_info"} <= {message.channel.topic for message in found}
        assert source.troubles == {}


@pytest.mark.parametrize(
    ("encodings", "schema"), [(["cdr", "json"], "geometry_msgs/msg/PoseStamped"), (["json"], "foxglove.PoseInFrame")]
)
def test_a_pose_is_published(encodings: list[str], schema: str) -> None:
    T = se3.pose(np.eye(3), (0.1, -0.2, 0.75))
    with Robot(messages_of(CELL / "eye_to_hand.mcap")[:5], supported_encodings=encodings) as robot:

        async def run() -> None:
            source = FoxgloveSource(robot.address, read_rig(ROS2_RIG))
            with pytest.raises(LogError, match="no connection now"):
                await source.publish("/next", "base", T, 5)
            following = asyncio.create_task(taken(source, 10**6, 60))
            while not source._encodings:
                await asyncio.sleep(0.02)
            await source.publish("/next", "base", T, 1_700_000_000_250_000_000)
            while not robot.received:
                await asyncio.sleep(0.02)
            following.cancel()

        asyncio.run(asyncio.wait_for(run(), 20))
    (message,) = robot.received
    assert (message.topic, message.schema) == ("/next", schema)
    if schema.startswith("foxglove"):
        assert json.loads(message.data)["pose"]["position"] == {"x": 0.1, "y": -0.2, "z": 0.75}
        return
    definition = (
        "std_msgs/Header header\ngeometry_msgs/Pose pose\n" + "=" * 80 + "\nMSG: std_msgs/Header\n"
        "builtin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\n"
        "uint32 nanosec\n" + "=" * 80 + "\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\n"
        "geometry_msgs/Quaternion orientation\n" + "=" * 80 + "\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\n"
        "float64 z\n" + "=" * 80 + "\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
    )
    ((pose,),) = ros2_decoder(schema, definition, lambda count: None)("/next", [message.data], [0])
    assert isinstance(pose, PoseRecord)
    assert (pose.parent, pose.stamp_ns) == ("base", 1_700_000_000_250_000_000)
    assert np.array_equal(pose.T, T)


def channel(number: int, topic: str, **changed: Any) -> dict[str, Any]:
    return {
        "id": number, "topic": topic, "encoding": "json", "schemaName": "foxglove.FrameTransforms",
        "schema": "{}", "schemaEncoding": "jsonschema", **changed,
    }  # fmt: skip


async def served(handle: Callable[[ServerConnection], Any], then: Callable[[FoxgloveSource], Any]) -> FoxgloveSource:
    """A server of the older name of the protocol that does as `handle` says, and a source that listens to it."""
    async with serve(handle, "127.0.0.1", 0, subprotocols=["foxglove.websocket.v1"]) as server:  # type: ignore[list-item]
        port = next(iter(server.sockets)).getsockname()[1]
        source = FoxgloveSource(f"ws://127.0.0.1:{port}", rig())
        await asyncio.wait_for(then(source), 20)
        return source


def test_rubbish_is_counted_and_a_lost_connection_is_made_again() -> None:
    connections = []

    async def robot(socket: ServerConnection) -> None:
        connections.append(socket.subprotocol)
        for text in ("no JSON", "[]", '{"op": 7}', json.dumps({"op": "status", "level": 2, "message": "too slow"})):
            await socket.send(text)
        wrong = [channel(-1, "/a"), {"id": 3}, channel(2, "/b", encoding="protobuf", schemaEncoding=None, schema="?")]
        await socket.send(
            json.dumps(
                {"op": "advertise", "channels": [*wrong, channel(9, "/tf"), channel(8, "/other", schemaName="x.Other")]}
            )
        )
        asked = json.loads(await socket.recv())
        assert asked["subscriptions"] == [{"id": 9, "channelId": 9}]
        for data in (b"", b"\x01\x02", b"\x77" * 20, struct.pack("<BIQ", 1, 8, 0) + b"{}", b"\x02" + bytes(8)):
            await socket.send(data)
        await socket.send(struct.pack("<BIQ", 1, 9, 0) + b'{"transforms": []}')
        if len(connections) > 1:
            await socket.wait_closed()

    async def two(source: FoxgloveSource) -> None:
        assert [message.data for message in await taken(source, 2)] == [b'{"transforms": []}'] * 2

    source = asyncio.run(served(robot, two))
    assert connections == ["foxglove.websocket.v1"] * 2
    counted = {trouble.what: trouble.count for trouble in source.troubles.values()}
    assert counted == {
        "connections that were lost": 1,
        "texts that are not of the protocol": 6,
        "warnings of the server": 2,
        "channels that are not described as the protocol says": 6,
        "binary messages that are not of the protocol": 6,
        "messages of channels that were not asked for": 2,
    }
    assert "; the first: " in str(source.troubles["warnings of the server"])


def test_who_does_not_answer_is_named() -> None:
    async def run() -> str:
        source = FoxgloveSource("ws://127.0.0.1:9", rig())
        with pytest.raises(TimeoutError):
            await taken(source, 1, 0.3)
        return source.state

    assert "does foxglove_bridge run there" in asyncio.run(run())
    with pytest.raises(LogError, match="is no address of a WebSocket"):
        asyncio.run(taken(FoxgloveSource("ws://", rig()), 1))


FOLDER_RIG = """\
carriers: {sensors: hand, targets: base, poses: {frames: [base, hand]}}
sensors:
  cam: {images: images, poses: poses.csv, intrinsics: {size: [64, 48], K: [50, 50, 32, 24]}}
targets:
  tag: {type: tag, family: tag36h11, id: 0, size_m: 0.1}
"""


def test_images_and_poses_that_fall_into_a_folder(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    rig_file = parse_rig(FOLDER_RIG, "rig.yaml", tmp_path)
    lines = ["name,x,y,z,qx,qy,qz,qw"]
    source = source_of(str(tmp_path), rig_file)
    assert isinstance(source, FolderSource)

    def fall(number: int) -> None:
        picture = np.full((48, 64), 40 * number, np.uint8)
        cv2.imwrite(str(tmp_path / "images" / f"{number:03d}.png"), picture)
        lines.append(f"{number:03d}.png,0.{number},0,0.5,0,0,0,1")
        (tmp_path / "poses.csv").write_text("\n".join(lines))

    async def run() -> list[Message]:
        gathering = asyncio.create_task(taken(source, 6))
        await asyncio.sleep(0.2)
        assert "waiting" in source.state
        for number in (1, 2, 3):
            fall(number)
            await asyncio.sleep(0.5)
        return await gathering

    found = asyncio.run(run())
    write_folder_log(tmp_path, rig_file, tmp_path / "whole.mcap")
    with open_log(tmp_path / "whole.mcap") as log:
        expected = {(type(r).__name__, r.stamp_ns) for r in log.records()}
    assert {("ImageRecord", stamp) for stamp in source.instants} <= expected
    whole = {(m.channel.topic, m.data) for m in messages_of(tmp_path / "whole.mcap")}
    assert {(m.channel.topic, m.data) for m in found} == whole


def test_the_node_s_definitions_are_those_that_the_reader_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES / "ros2_live" / "gtsam_rwhec_live"))
    definitions = importlib.import_module("definitions")
    texts = {
        "geometry_msgs/msg/PoseStamped": "# A pose\nstd_msgs/Header header\nPose pose",
        "std_msgs/msg/Header": "builtin_interfaces/Time stamp  # when\nstring frame_id",
        "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
        "geometry_msgs/msg/Pose": "Point position\nQuaternion orientation",
        "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z",
        "geometry_msgs/msg/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    }
    for name, text in texts.items():
        (tmp_path / name.replace("/", ".")).write_text(text)
    found = definitions.definition_of("geometry_msgs/msg/PoseStamped", lambda name: tmp_path / name.replace("/", "."))
    data = _pose_stamped("base", (1, 2), [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
    ((pose,),) = ros2_decoder("geometry_msgs/msg/PoseStamped", found, lambda count: None)("/pose", [data], [0])
    assert isinstance(pose, PoseRecord)
    assert (pose.parent, pose.stamp_ns, pose.T[0, 3]) == ("base", 1_000_000_002, 0.1)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=6),
    max_leaves=12,
)


@settings(max_examples=100, deadline=None)
@given(
    st.binary(max_size=40)
    | st.text(max_size=40)
    | st.builds(
        lambda op, rest: json.dumps(rest | {"op": op}),
        JSON | st.sampled_from(OPS),
        st.dictionaries(st.sampled_from(KEYS), JSON),
    )
)
def test_no_frame_of_a_server_ends_a_session(frame: str | bytes) -> None:
    source = FoxgloveSource("ws://robot", rig())
    with pytest.raises(StopIteration) as end:  # it waits for nothing where there is no connection
        source._message(frame).send(None)
    assert end.value.value is None
    assert all(str(trouble).isprintable() for trouble in source.troubles.values())
