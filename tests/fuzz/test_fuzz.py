"""A short coverage-guided fuzzing of every reader, the same each time; `run.py` goes on for an hour, from any seed."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("atheris", reason="atheris has no wheel for this Python or system: nothing was fuzzed")

import run

#: So many executions take about five seconds; a test that is not marked begins with a part of them.
EXECUTIONS = {
    "csv": 12_000, "results": 1_000, "foxglove": 10_000, "rig": 1_500, "mcap": 1_000, "cdr": 10_000,
    "intrinsics": 2_500, "protobuf": 30_000, "poses": 5_000, "images": 60_000,
}  # fmt: skip
#: It loops at its first input alone, and runs out of memory late in a process, so that two processes are enough. To
#: fill the memory takes a busy machine more than a second.
PLANTED = """
from harness import Harness
from gtsam_rwhec.errors import FileFormatError

reads = 0

def read(data):
    global reads
    reads += 1
    if len(data) < 4:
        raise FileFormatError("four bytes are expected")
    if data[0] % 8 == 1:
        {}["no such key"]
    if data == b"loop" and reads <= 3:
        while True:
            pass
    if data[0] % 8 == 3 and reads > 500:
        b"x" * (500 << 20)

HARNESS = Harness(read, lambda: [b"loop", b"pine", b"bad"], limit_s=3.0)
"""


@pytest.mark.parametrize("part", [10, pytest.param(1, marks=pytest.mark.slow)], ids=["tenth", "whole"])
@pytest.mark.parametrize("reader", run.READERS)
def test_only_our_errors_leave_a_reader(reader: str, part: int, tmp_path: Path) -> None:
    most = EXECUTIONS[reader] // part
    outcome = run.fuzz(reader, 120.0, tmp_path / "corpus", tmp_path / "findings", seed=1, most=most)
    said = [(folder / "traceback.txt").read_text() for folder in outcome.findings.values()]
    assert not outcome.findings, "\n".join([str(outcome), *said])
    assert outcome.executions >= most
    assert outcome.coverage > 50
    assert outcome.peak_mb <= run.LIMIT_MB


@pytest.mark.slow
def test_errors_loops_and_memory_of_a_planted_reader_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "planted.py").write_text(PLANTED)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(run.HERE)}", prepend=":")
    outcome = run.fuzz("planted", 120.0, tmp_path / "corpus", tmp_path / "findings", seed=1, most=1000)
    assert outcome.executions == 1000
    assert 0 < outcome.refused < outcome.executions
    found = {kind: (folder / "input.bin").read_bytes() for kind, folder in outcome.findings.items()}
    firsts = {kind.partition(" at ")[0]: data[0] % 8 for kind, data in found.items()}
    assert firsts == {"KeyError": 1, "TooLongError": b"l"[0] % 8, "MemoryError: peak of more than 500 MB": 3}
    assert next(kind for kind in found if "KeyError" in kind).startswith("KeyError at planted.py:13 read")
