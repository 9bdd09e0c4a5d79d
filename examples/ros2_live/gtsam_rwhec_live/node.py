"""A node that gives a rig file's topics to a session of gtsam-rwhec, byte for byte, and publishes proposed poses."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from mcap.records import Channel, Schema
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py import get_interface_path
from rosidl_runtime_py.utilities import get_message
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.capture.sources import Message, Source
from gtsam_rwhec_live.definitions import definition_of


class RosSource(Source):
    """The messages of this node's subscriptions, in CDR as they came."""

    def __init__(self, node: Node, rig: rw.rig.Rig) -> None:
        super().__init__("ROS 2", rig)
        self._node, self._publisher, self._subscribed = node, None, set()

    async def messages(self) -> AsyncIterator[Message]:
        """Subscribe to the rig file's topics as they appear, and give what comes."""
        queue: asyncio.Queue[Message] = asyncio.Queue()
        loop = asyncio.get_running_loop()
        self.is_connected, self.state = True, "listening"
        while True:
            for topic, types in self._node.get_topic_names_and_types():
                self.topics[topic] = types[0]
                if topic not in self._subscribed and self.wants(topic, types[0]):
                    self._subscribe(
                        topic, types[0], lambda message: loop.call_soon_threadsafe(queue.put_nowait, message)
                    )
            until_s = time.monotonic() + 1.0
            while (left_s := until_s - time.monotonic()) > 0.0:
                try:
                    yield await asyncio.wait_for(queue.get(), left_s)
                except TimeoutError:
                    break

    async def publish(self, topic: str, frame: str, T: Any, stamp_ns: int) -> None:
        """Publish a proposed pose."""
        self._publisher = self._publisher or self._node.create_publisher(PoseStamped, topic, 1)
        pose = PoseStamped()
        pose.header.frame_id = frame
        pose.header.stamp.sec, pose.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        place, turn = pose.pose.position, pose.pose.orientation
        place.x, place.y, place.z = map(float, T[:3, 3])
        turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(np.asarray(T)[:3, :3]).as_quat().tolist()
        self._publisher.publish(pose)

    def _subscribe(self, topic: str, kind: str, give: Any) -> None:
        self._subscribed.add(topic)
        schema = Schema(1, definition_of(kind, get_interface_path).encode(), "ros2msg", kind)
        channel = Channel(1, topic, "cdr", {}, 1)
        is_latched = topic.endswith("tf_static")
        quality = QoSProfile(
            depth=100,
            reliability=ReliabilityPolicy.RELIABLE if is_latched else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE,
        )
        self._node.create_subscription(
            get_message(kind), topic, partial(_received, channel, schema, give), quality, raw=True
        )


def _received(channel: Channel, schema: Schema, give: Any, data: bytes) -> None:
    give(Message(channel, schema, time.time_ns(), bytes(data)))


async def _run(session: rw.capture.Session, page: rw.capture.PageServer) -> None:
    await asyncio.gather(session.run(), page.serve())


def main() -> None:
    """``ros2 run gtsam_rwhec_live live --ros-args -p rig:=rig.yaml -p folder:=cell``."""
    rclpy.init()
    node = Node("gtsam_rwhec_live")
    given = {name: node.declare_parameter(name, value).value for name, value in
             {"rig": "rig.yaml", "folder": "cell", "port": 8723, "publish": ""}.items()}  # fmt: skip
    rig = rw.rig.read_rig(given["rig"])
    options = rw.capture.LiveOptions(publish=given["publish"])
    session = rw.capture.Session(RosSource(node, rig), rig, Path(given["folder"]), options)
    page = rw.capture.PageServer(session, port=int(given["port"]))
    node.get_logger().info(f"the page: {page.address}")
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    try:
        asyncio.run(_run(session, page))
    finally:
        rclpy.shutdown()
