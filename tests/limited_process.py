"""Hostile files read by the real readers in a process of their own, whose memory and time are measured.

`Reader` starts one process that imports the library, and forks it for each file: the child's peak memory is measured
from what the imports need. A limit on the child's address space turns a flood into a MemoryError, and an alarm ends a
hang.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

#: Bytes beyond the imports and the file that a reader may take.
MEMORY = 200_000_000
#: Seconds of the processor. The bar is 2; a busy machine gets more.
SECONDS = 8.0
#: The address space that a child may take beyond its parent's, bytes: far beyond what passes.
_SPACE = 3 << 30
#: Seconds after which a child is ended.
_ALARM = 60


@dataclass(frozen=True)
class Reading:
    """What reading a file gave, and what it cost."""

    error: str
    message: str
    warnings: str
    result: Any
    peak_bytes: int
    #: Of the largest process that the reader itself started, its imports included.
    children_peak_bytes: int
    seconds: float

    @property
    def said(self) -> str:
        """All that was said of the file."""
        return f"{self.message} {self.warnings}"


class Reader:
    """A process that imports the library once. It is a context manager."""

    def __enter__(self) -> Reader:
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        return self

    def __exit__(self, *raised: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def __call__(self, how: str, path: Path, **options: Any) -> Reading:
        """Read a file as `HOW` has it."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps([how, str(path), options]), file=self._process.stdin, flush=True)
        return Reading(**json.loads(self._process.stdout.readline()))


def _log(path: str, topics: list[str] | None = None) -> Any:
    """Everything that a log has, as the stages of a calibration ask for it."""
    from gtsam_rwhec.logs import open_log

    with open_log(path) as log:
        count = len(log.topics())
        for name in log.metadata():
            log.attachment(name)
        records = sum(1 for _ in log.records(topics))
        return [count, records]


def _copy(path: str) -> Any:
    from gtsam_rwhec.logs import LogWriter, open_log

    with open_log(path) as log, LogWriter(f"{path}.copy.mcap") as out:
        return out.copy(log)


def _image(path: str, size: list[int] | None = None) -> Any:
    from gtsam_rwhec.detect.images import decode_gray
    from gtsam_rwhec.logs.records import ImageRecord

    record = ImageRecord(0, 0, "/cam", "cam", "any", Path(path).read_bytes())
    gray = decode_gray(record, None if size is None else (size[0], size[1]))
    return list(gray.shape)


def _bag(path: str, out: str | None = None) -> Any:
    from gtsam_rwhec.logs.ros_bags import convert_ros_bag

    return convert_ros_bag(path, out or f"{path}.mcap")


HOW: dict[str, Callable[..., Any]] = {"log": _log, "copy": _copy, "image": _image, "bag": _bag}


def _read(how: str, path: str, options: dict[str, Any]) -> dict[str, Any]:
    from gtsam_rwhec.errors import RwhecError

    before = resource.getrusage(resource.RUSAGE_SELF)
    space = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (space + _SPACE, space + _SPACE))
    signal.alarm(_ALARM)
    started = time.process_time()
    error, message, result = "", "", None
    with warnings.catch_warnings(record=True, action="always") as caught:
        try:
            result = HOW[how](path, **options)
        except RwhecError as refused:
            error, message = type(refused).__name__, str(refused)
        except BaseException as escaped:  # noqa: BLE001  (it is reported, and fails the test)
            error, message = f"not ours: {type(escaped).__name__}", str(escaped)
    after = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "error": error,
        "message": message[:100_000],
        "warnings": "; ".join(str(w.message) for w in caught)[:100_000],
        "result": result,
        "peak_bytes": (after.ru_maxrss - before.ru_maxrss) * 1024,
        "children_peak_bytes": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024,
        "seconds": time.process_time() - started,
    }


def _serve() -> None:
    for module in (
        "rosbags.highlevel", "rosbags.typesys", "gtsam_rwhec.detect.images", "gtsam_rwhec.logs.image_folder",
        "gtsam_rwhec.logs.mcap_writer", "gtsam_rwhec.logs.ros_bags", "gtsam_rwhec.logs.tf_buffer",
    ):  # fmt: skip
        importlib.import_module(module)
    for line in sys.stdin:
        how, path, options = json.loads(line)
        source, sink = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(source)
            with open(sink, "w") as stream:
                json.dump(_read(how, path, options), stream)
            os._exit(0)
        os.close(sink)
        with open(source) as stream:
            said = stream.read()
        _, status = os.waitpid(child, 0)
        ended = {"error": f"not ours: ended with status {status}", "message": "", "warnings": "", "result": None}
        print(said or json.dumps({**ended, "peak_bytes": 0, "children_peak_bytes": 0, "seconds": 0.0}), flush=True)


if __name__ == "__main__":
    _serve()
