"""ROS 1 bags and ROS 2 db3 bags converted to MCAP by the `rosbags` library (the extra ``gtsam-rwhec[rosbags]``).

ROS 1 messages are encoded as CDR with the same fields and numbers; ROS 2 messages are copied byte for byte. `rosbags`
trusts what a bag states: so it runs in a process of its own (``ros_bag_process.py``), whose memory, time and output are
bounded by the bag's size.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import BinaryIO

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.files.whole_files import atomic_stream, checked_path

#: Bytes. Reading a bag may take this much memory,
MEMORY = 200 << 20
#: and this many bytes for each byte of the bag: an index entry of 16 bytes becomes an object of 150.
MEMORY_FOR_A_BYTE = 12
#: Bytes. The log that is written, and each file that is decompressed on the way, may have this many,
WRITTEN = 256 << 20
#: and this many for each byte of the bag.
WRITTEN_FOR_A_BYTE = 100
#: Seconds of the processor. Reading a bag may take this long,
TIME_S = 2
#: and this many seconds for each megabyte of the bag. Honest bags of small messages take one or two.
TIME_FOR_A_MEGABYTE_S = 30
#: What ended the process, in words.
_ENDED_BY = {
    signal.SIGXCPU: "it takes more time than a bag of its size may",
    signal.SIGKILL: "it takes more time or memory than a bag of its size may",
    signal.SIGXFSZ: "it decompresses to more than a bag of its size may",
}


def convert_ros_bag(bag: str | Path, path: str | Path) -> int:
    """Write the messages of a ROS 1 ``.bag`` file, or of a ROS 2 bag's folder, as an MCAP file in the order of time.

    A file of this name is replaced once all is written. Returns how many messages there are.

    Raises
    ------
    MissingPackageError
        `rosbags` is not installed.
    LogError
        The bag cannot be read, has no definitions of its messages, or takes more memory or time than a bag of its size
        may; the file cannot be written; or a ROS 2 bag is in MCAP already.
    """
    bag, path = checked_path(bag), checked_path(path)
    with extra_named():
        import rosbags  # noqa: F401
    size = _size(bag)
    if bag.suffix == ".mcap" or (bag.is_dir() and not any(bag.glob("*.db3*")) and any(bag.glob("*.mcap"))):
        raise LogError(f"{bag} is in MCAP already: no conversion is needed. Give it to gtsam-rwhec init as it is.")
    try:
        with atomic_stream(path) as stream:
            return _converted(bag, size, stream, path)
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror or error}.") from error


def _size(bag: Path) -> int:
    """Bytes of the bag's files; pipes and devices are refused."""
    try:
        files = sorted(bag.iterdir()) if bag.is_dir() else [bag]
        states = [file.stat() for file in files]
    except OSError as error:
        raise LogError(f"{bag} cannot be read as a ROS bag: {error.strerror}.") from error
    for file, state in zip(files, states, strict=True):
        if not (stat.S_ISREG(state.st_mode) or stat.S_ISDIR(state.st_mode)):
            raise LogError(f"{bag} cannot be read as a ROS bag: {file} is not a file.")
    return sum(state.st_size for state in states)


def _converted(bag: Path, size: int, stream: BinaryIO, path: Path) -> int:
    limits = (
        MEMORY + MEMORY_FOR_A_BYTE * size,
        WRITTEN + WRITTEN_FOR_A_BYTE * size,
        TIME_S + TIME_FOR_A_MEGABYTE_S * size // 1_000_000,
    )
    script = Path(__file__).with_name("ros_bag_process.py")
    # -P: no folder of the caller's comes before the libraries. Threads of BLAS would only reserve memory.
    command = [sys.executable, "-P", str(script), os.path.abspath(bag), *map(str, limits)]
    found_in = os.pathsep.join(folder for folder in sys.path if os.path.isabs(folder))
    with tempfile.TemporaryDirectory() as scratch:  # for what rosbags decompresses; it is emptied however rosbags ends
        environment = {**os.environ, "PYTHONPATH": found_in, "TMPDIR": scratch, "OPENBLAS_NUM_THREADS": "1"}
        ended = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.PIPE, env=environment, check=False
        )
    last = ended.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    if ended.returncode == 0:
        told = json.loads(last)
        if "count" in told:
            return int(told["count"])
        if told["errno"] in (errno.ENOSPC, errno.EDQUOT):
            raise LogError(f"{path} cannot be written: {told['refused']}.")
        what = _ENDED_BY[signal.SIGXFSZ] if told["errno"] == errno.EFBIG else shown(told["refused"], 500)
        raise LogError(f"{bag} cannot be read as a ROS bag: {what}.")
    if ended.returncode < 0:
        name = signal.Signals(-ended.returncode)
        raise LogError(f"{bag} cannot be read as a ROS bag: {_ENDED_BY.get(name, f'rosbags ended by {name.name}')}.")
    kind, _, said = last.partition(": ")
    what = said or kind.rpartition(".")[2]
    if kind == "MemoryError":
        what = "it takes more memory than a bag of its size may"
    raise LogError(f"{bag} cannot be read as a ROS bag: {shown(what, 500)}")
