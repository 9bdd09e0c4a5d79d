"""The process in which `rosbags` reads a bag; ``ros_bags.py`` starts it. It imports nothing else of this package.

    python ros_bag_process.py BAG MEMORY_BYTES FILE_BYTES SECONDS >OUT.mcap

`rosbags` decompresses without a limit, and makes Python code of the definitions in a bag. So it runs here, where the
system bounds memory, time and the size of files. Whatever it raises ends this process alone. The last line of stderr is
JSON if all went well, or if the system refused something.
"""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path
from typing import BinaryIO

from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

#: Messages are compressed and written when they have this many bytes.
CHUNK_BYTES = 1 << 20


def convert(bag: Path, stream: BinaryIO) -> int:
    """Write a bag's messages as MCAP; return how many there are. `rosbags` raises anything for damaged bags."""
    count = 0
    with AnyReader([bag]) as reader:
        writer = Writer(stream, CHUNK_BYTES)
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
            # Each entry of a list takes a byte or more, but for empty messages, of which there could be billions.
            types.max_sequence_length = len(raw)
            data = raw if reader.is2 else bytes(types.ros1_to_cdr(raw, connection.msgtype))
            writer.add_message(channels[id(connection)], stamp_ns, data, stamp_ns)
            count += 1
        writer.finish()  # type: ignore[no-untyped-call]
    return count


def _limit(memory_bytes: int, file_bytes: int, seconds: int) -> None:
    """Bound what this process may take beyond what it has now, after its imports."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    has_bytes = pages * resource.getpagesize()
    used_s = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
    limits = {
        resource.RLIMIT_AS: has_bytes + memory_bytes,
        resource.RLIMIT_FSIZE: file_bytes,
        resource.RLIMIT_CPU: int(used_s) + seconds,
        resource.RLIMIT_CORE: 0,
    }
    for kind, most in limits.items():
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))


def main() -> None:
    """Convert one bag to stdout."""
    _limit(*map(int, sys.argv[2:5]))
    try:
        with sys.stdout.buffer as stream:
            told: dict[str, object] = {"count": convert(Path(sys.argv[1]), stream)}
    except OSError as error:
        told = {"refused": error.strerror or str(error), "errno": error.errno}
    print(json.dumps(told), file=sys.stderr)


if __name__ == "__main__":
    main()
