"""ROS 1 bags and ROS 2 db3 bags converted to MCAP by the `rosbags` library (the extra ``gtsam-rwhec[rosbags]``).

ROS 1 messages are encoded as CDR with the same fields and numbers; ROS 2 messages are copied byte for byte. `rosbags`
runs in a process of its own, with limits that grow with the bag (``ros_bag_process.py``).
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
from importlib.util import find_spec
from pathlib import Path
from typing import BinaryIO

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.atomic_write import atomic_stream
from gtsam_rwhec.files.budgets import Spending
from gtsam_rwhec.files.paths import checked_path
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.logs.ros1_checks import check_ros1_bag
from gtsam_rwhec.logs.ros2_checks import check_ros2_bag

#: Bytes. Reading a bag may take this much memory,
MEMORY = 200 << 20
#: and this many bytes for each byte of the bag: an index entry of 16 bytes becomes an object of 150.
MEMORY_FOR_A_BYTE = 12
#: Bytes. The log that is written, and each file that is decompressed on the way, may have this many,
WRITTEN = 256 << 20
#: and this many for each byte of the bag.
WRITTEN_FOR_A_BYTE = 100
#: Seconds of the processor. Reading a bag may take this long,
TIME_S = 5
#: and this many seconds for each megabyte of the bag. Honest bags of small messages take one or two.
TIME_FOR_A_MEGABYTE_S = 30
#: What ended the process, in words.
_ENDED_BY = {
    signal.SIGXCPU: "it takes more time than a bag of its size may",
    signal.SIGKILL: "it takes more time or memory than a bag of its size may",
    signal.SIGXFSZ: "it decompresses to more than a bag of its size may",
}


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
        `rosbags` is not installed; the bag cannot be read, has no definitions of its messages, or takes more memory or
        time than a bag of its size may; the file cannot be written; or a ROS 2 bag is in MCAP already.
    BudgetError
        The bag states more, or yields more, than one of its size may (``files/budgets.py``).
    """
    bag, path = checked_path(bag), checked_path(path)
    if find_spec("rosbags") is None:
        raise LogError("rosbags is not installed: pip install gtsam-rwhec[rosbags]")
    size = _size(bag)
    # What can be told before `rosbags` reads is told in words; its process only ends.
    if bag.is_dir() or bag.suffix != ".bag":
        check_ros2_bag(bag, Spending(bag, size))
    else:
        check_ros1_bag(bag)
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
