"""ROS 1 bags and ROS 2 db3 bags converted to MCAP by the `rosbags` library (the extra ``gtsam-rwhec[rosbags]``).

ROS 1 messages are encoded as CDR with the same fields and numbers; ROS 2 messages are copied byte for byte.
"""

from __future__ import annotations

import struct
from pathlib import Path

from mcap.writer import Writer as McapWriter

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.atomic_write import atomic_stream

#: Messages are compressed and written when they have this many bytes.
CHUNK_BYTES = 1 << 20


def convert_ros_bag(bag: str | Path, path: str | Path) -> int:
    """Write a bag's messages as an MCAP file, in the order of time.

    Parameters
    ----------
    bag
        A ROS 1 ``.bag`` file, or the folder of a ROS 2 bag.
    path
        The MCAP file. A file of this name is replaced once all is written.

    Returns
    -------
    int
        How many messages were written.

    Raises
    ------
    LogError
        `rosbags` is not installed; the bag cannot be read or has no definitions of its messages; the file cannot be
        written.
    """
    try:
        import apsw
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.rosbag1 import ReaderError as Ros1Error
        from rosbags.rosbag2 import ReaderError as Ros2Error
        from rosbags.serde import SerdeError
        from rosbags.typesys import Stores, TypesysError, get_typestore
    except ImportError as error:
        raise LogError("rosbags is not installed: pip install gtsam-rwhec[rosbags]") from error
    # rosbags raises the last five for damaged bags that it does not recognise as damaged.
    faults = (
        AnyReaderError, Ros1Error, Ros2Error, SerdeError, TypesysError, apsw.Error,
        AssertionError, ValueError, KeyError, IndexError, struct.error,
    )  # fmt: skip
    bag, path = Path(bag), Path(path)
    count = 0
    try:
        with AnyReader([bag]) as reader, atomic_stream(path) as stream:
            writer = McapWriter(stream, CHUNK_BYTES)
            writer.start(profile="ros2", library="gtsam-rwhec")
            # ROS 2's Header lacks ROS 1's seq. All other definitions are the bag's own.
            definitions = dict(reader.typestore.fielddefs)
            if not reader.is2:
                definitions["std_msgs/msg/Header"] = get_typestore(Stores.LATEST).fielddefs["std_msgs/msg/Header"]
            types = get_typestore(Stores.EMPTY)
            types.register(definitions)
            schemas: dict[str, int] = {}
            channels: dict[int, int] = {}
            for connection in reader.connections:
                name = connection.msgtype
                if name not in schemas:
                    definition, _ = types.generate_msgdef(name, ros_version=2)
                    schemas[name] = writer.register_schema(name, "ros2msg", definition.encode())
                channels[id(connection)] = writer.register_channel(connection.topic, "cdr", schemas[name])
            for connection, stamp_ns, raw in reader.messages():
                data = raw if reader.is2 else bytes(types.ros1_to_cdr(raw, connection.msgtype))
                writer.add_message(channels[id(connection)], stamp_ns, data, stamp_ns)
                count += 1
            writer.finish()  # type: ignore[no-untyped-call]
    except faults as error:
        what = str(error) or type(error).__name__
        raise LogError(f"{bag} cannot be read as a ROS bag: {what}") from error
    except OSError as error:
        raise LogError(f"{bag} cannot be converted to {path}: {error.strerror or error}") from error
    return count
