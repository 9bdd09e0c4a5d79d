"""One process of atheris on one reader; `run.py` starts it, and starts another when an input ends it.

fuzzed_process.py READER SECONDS CORPUS FINDINGS SEED EXECUTIONS; the last two may be empty
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import random
import resource
import signal
import sys
import time
import traceback
import warnings
from pathlib import Path
from types import FrameType
from typing import Any

import atheris
from run import LIMIT_MB, READERS

TESTS = Path(__file__).resolve().parents[1]
#: Branches of these packages are counted: the library, and what parses for it in Python.
COUNTED = ["gtsam_rwhec", "yaml", "mcap", "mcap_protobuf"]
#: The process gets no more address space, megabytes: a MemoryError is a finding, and the machine goes on.
ADDRESSES_MB = 8000
#: libFuzzer ends the process if an input takes this long on the clock: code outside Python that never returns.
LONGEST_S = 120
#: The state is written at most this often.
STATE_S = 0.5


class TooLongError(BaseException):
    """An input took too long. Not an Exception, so that no reader can catch it."""


def _too_long(_signal: int, _frame: FrameType | None) -> None:
    raise TooLongError("the limit of one input is over")


def _peak_mb() -> int:
    # Not ru_maxrss, which libFuzzer's own limit looks at: a process takes over that of the one that started it.
    with open("/proc/self/status", encoding="ascii") as status:
        peak = next(line for line in status if line.startswith("VmHWM:"))
    return int(peak.split()[1]) // 1024


class Fuzzed:
    """The reader as libFuzzer calls it: counts, and keeps what is wrong."""

    def __init__(self, harness: Any, findings: Path, state: Path, most: int | None) -> None:
        from gtsam_rwhec.errors import RwhecError

        self._harness, self._findings, self._state, self._refusal = harness, findings, state, RwhecError
        self._executions = self._refused = 0
        self._most = most
        self._slowest_s = 0.0
        self._told = 0.0
        self.tell()

    def tell(self) -> None:
        """Write the counts where `run.py` finds them, however this process ends."""
        self._told = time.monotonic()
        state = {
            "executions": self._executions, "refused": self._refused,
            "peak_mb": _peak_mb(), "slowest_s": self._slowest_s,
        }  # fmt: skip
        self._state.with_suffix(".new").write_text(json.dumps(state))
        self._state.with_suffix(".new").replace(self._state)

    def __call__(self, data: bytes) -> None:
        """Read one input."""
        self._executions += 1
        began = time.process_time()
        try:
            signal.setitimer(signal.ITIMER_PROF, self._harness.limit_s)
            try:
                self._harness.read(data)
            except self._refusal:
                self._refused += 1
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
        except (Exception, TooLongError) as error:  # noqa: BLE001  (whatever else it is, it is a finding)
            self._keep(data, error)
        self._slowest_s = max(self._slowest_s, time.process_time() - began)
        if _peak_mb() > LIMIT_MB:
            self._keep(data, MemoryError(f"peak of more than {LIMIT_MB} MB"))
            self.tell()
            os._exit(1)  # the peak of a process never falls
        if time.monotonic() - self._told > STATE_S or self._executions == self._most:
            self.tell()

    def _keep(self, data: bytes, error: BaseException) -> None:
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename != __file__]
        own = [frame for frame in frames if "/gtsam_rwhec/" in frame.filename]
        places = [f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in (*frames[-1:], *own[-1:])]
        where = " <- ".join(dict.fromkeys(places))
        kind = f"{type(error).__name__} at {where}" if where else f"{type(error).__name__}: {error}"
        folder = self._findings / hashlib.sha1(kind.encode()).hexdigest()[:12]
        if not folder.exists():
            folder.mkdir()
            (folder / "kind.txt").write_text(kind)
            (folder / "input.bin").write_bytes(data)
            (folder / "traceback.txt").write_text("".join(traceback.format_exception(error)))


def main() -> None:
    """Fuzz until the time is over."""
    reader, seconds, corpus, findings, seed, executions = sys.argv[1:7]
    sys.path[:0] = [str(TESTS), str(TESTS / "logs"), str(TESTS / "rig")]
    warnings.simplefilter("ignore")
    warnings.simplefilter("error", RuntimeWarning)  # of NumPy: what reads a file takes no logarithm of zero
    with atheris.instrument_imports(include=COUNTED):
        harness = importlib.import_module(READERS.get(reader, reader)).HARNESS
        given = list(harness.seeds())
        state = Path(findings).parent / f"{reader}.state.json"
        fuzzed = Fuzzed(harness, Path(findings), state, int(executions) if executions else None)
        signal.signal(signal.SIGPROF, _too_long)
        for data in given:  # what the library imports late is imported here, and counted
            fuzzed(data)
    for data in given:
        (Path(corpus) / f"seed-{hashlib.sha1(data).hexdigest()}").write_bytes(data)
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES_MB << 20, ADDRESSES_MB << 20))
    options = [
        f"-max_total_time={seconds}", f"-artifact_prefix={findings}/", "-rss_limit_mb=0",
        f"-timeout={LONGEST_S}", "-max_len=200000", "-len_control=0", "-print_final_stats=1",
        *([f"-seed={seed}"] if seed else []), *([f"-runs={executions}"] if executions else []),
    ]  # fmt: skip

    def mutate(data: bytes, most: int, seed: int) -> bytes:
        chance = random.Random(seed)
        return bytes(harness.mutate(data, chance, lambda given: atheris.Mutate(given, most)))[:most]

    own = {"custom_mutator": mutate} if harness.mutate else {}
    atheris.Setup([sys.argv[0], *options, corpus], fuzzed, **own)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
