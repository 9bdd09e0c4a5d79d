"""Result files that mean harm: small in memory and time, refused with a reason.

A process of their own reads them, since the peak of its memory is what counts.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from places import DEMO

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.results.json_tree import DEEPEST, MOST_ROWS, parse_json

#: Bytes of the large files.
LARGE = 20_000_000
#: Reading may take this many bytes, and this many for each byte of the file.
MEMORY, MEMORY_PER_BYTE = 50_000_000, 5
#: Far beyond what one of them takes, in seconds.
LONG_S = 20.0

#: Reads files, and prints for each what the process's memory grew by, in bytes, the seconds, and the error's text.
READ = """
import json, sys, time
from pathlib import Path
import gtsam_rwhec as rw

def memory(word):
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(word))

rw.read_solution(sys.argv[1])
results = {}
for path in sorted(Path(sys.argv[2]).iterdir()):
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before, begun, said = memory("VmRSS"), time.monotonic(), "nothing"
    try:
        rw.read_solution(path)
    except rw.errors.FileFormatError as error:
        said = str(error)
    results[path.stem] = memory("VmHWM") - before, time.monotonic() - begun, said
print(json.dumps(results))
"""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A refined calibration in a file."""
    problem = rw.read_csv(DEMO, sigma=0.005, kappa=6565.0)
    path = tmp_path_factory.mktemp("good") / "result.json"
    rw.write_refined(rw.refine(problem, rw.solve(problem)), path)
    return path


def filled(good: Path, field: str, value: bytes) -> bytes:
    """The good file with another value at the top."""
    raw = json.loads(good.read_bytes())
    raw[field] = "HERE"
    return json.dumps(raw).encode().replace(b'"HERE"', value)


def damaged(good: Path, change: Callable[[Any], object]) -> bytes:
    """The good file with a change inside."""
    raw = json.loads(good.read_bytes())
    change(raw)
    return json.dumps(raw).encode()


def repeated(piece: bytes, size: int = LARGE) -> bytes:
    return b"[" + piece * (size // len(piece)) + piece.rstrip(b",") + b"]"


LARGE_FILES: dict[str, tuple[Callable[[Path], bytes], str]] = {
    "a text in a field of numbers": (lambda good: filled(good, "scale", b'"' + b"x" * LARGE + b'"'), "$.scale"),
    "a text that no field has": (lambda good: filled(good, "more", b'"' + b"x" * LARGE + b'"'), "$.more: Extra inputs"),
    "a long key": (lambda good: filled(good, "x" * LARGE, b"0"), "Extra inputs are not permitted"),
    "empty lists": (lambda good: filled(good, "scale", repeated(b"[],")), "lists and objects"),
    "numbers": (lambda good: filled(good, "sensors", repeated(b"0,")), "values"),
    "a list of wrong rows": (
        lambda good: filled(good, "sensors", repeated(b"{}" + b" " * 60 + b",")),
        "entries; at most",
    ),
    "all nested": (lambda good: b"[" * LARGE, "lists and objects"),
    "nested with blanks": (lambda good: (b"[" + b" " * 60) * (LARGE // 61), "inside one another"),
    "other characters": (
        lambda good: filled(good, "more", ('"' + "\U0001f600" * (LARGE // 4) + '"').encode()),
        "$.more",
    ),
    "a number of many digits": (lambda good: filled(good, "scale", b"1" * LARGE), f"an integer of {LARGE} digits"),
    "blanks": (lambda good: b" " * LARGE, "it is empty"),
    "a matrix of text": (
        lambda good: damaged(
            good, lambda raw: raw["refined"]["joint"].update(finite=[["x" * 300] * 1000] * (LARGE // 300_000))
        ),
        "$.refined.joint.finite[0][0]: must be a finite number",
    ),
    "a name of a program": (
        lambda good: damaged(good, lambda raw: raw.update(format_version=99, written_by="x" * LARGE)),
        f"[... {LARGE} characters ...]",
    ),
    "another kind of file": (
        lambda good: damaged(good, lambda raw: raw.update(format="x" * LARGE)),
        "this is another kind of file",
    ),
}


@pytest.fixture(scope="module")
def readings(good: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, float, str]]:
    """What it took to read each large file, in a process of its own."""
    folder = tmp_path_factory.mktemp("bad")
    for kind, (make, _) in LARGE_FILES.items():
        (folder / f"{kind}.json").write_bytes(make(good))
    done = subprocess.run([sys.executable, "-c", READ, good, folder], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-1000:]
    for path in folder.iterdir():
        path.unlink()
    return json.loads(done.stdout)


@pytest.mark.parametrize("kind", LARGE_FILES)
def test_a_large_file_takes_little(kind: str, readings: dict[str, tuple[int, float, str]]) -> None:
    grown, seconds, message = readings[kind]
    assert LARGE_FILES[kind][1] in message
    assert len(message) < 2000
    assert grown < MEMORY + MEMORY_PER_BYTE * LARGE
    assert seconds < LONG_S


def refused(content: bytes, path: Path) -> str:
    path.write_bytes(content)
    with pytest.raises(FileFormatError) as caught:
        rw.read_solution(path)
    assert len(str(caught.value)) < 2000
    return str(caught.value)


@pytest.mark.parametrize("depth", [DEEPEST + 1, 900, 100_000])
def test_depth(depth: int, good: Path, tmp_path: Path) -> None:
    nested = b"[" * depth + b" " * (depth * 30) + b"]" * depth
    assert "inside one another" in refused(filled(good, "scale", nested), tmp_path / "deep.json")


def test_more_rows_than_are_read(good: Path, tmp_path: Path) -> None:
    rows = b"[" + b",".join([b'{"child": "a fairly long name", "parent": "x"}'] * (MOST_ROWS + 1)) + b"]"
    said = refused(filled(good, "sensors", rows), tmp_path / "rows.json")
    assert f"{MOST_ROWS + 1} entries; at most {MOST_ROWS} are read" in said


def test_thousands_of_faults_are_counted_only(good: Path, tmp_path: Path) -> None:
    rows = b"[" + b",".join([b'{"child": "a fairly long name", "parent": "x"}'] * 5000) + b"]"
    said = refused(filled(good, "sensors", rows), tmp_path / "rows.json")
    assert "15000 fields are missing, unknown or wrong." in said


def test_names_cannot_steer_a_terminal(good: Path, tmp_path: Path) -> None:
    said = refused(damaged(good, lambda raw: raw.update({"\x1b[2J\x9b": 1})), tmp_path / "escape.json")
    assert r"$.\x1b[2J\x9b: Extra inputs" in said


@pytest.mark.parametrize(
    ("text", "value"),
    [(b'{"a": [1, 2.5, "x"]}', {"a": [1, 2.5, "x"]}), ("\ufeff[]".encode(), []), (b"-12345678901234567890"[:20], None)],
)
def test_json(text: bytes, value: Any) -> None:
    assert parse_json(text) == (int(text) if value is None else value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"{", r"\$: Invalid JSON: .*\(line 1 column 2\)"),
        (b"\xff", r"not text in UTF-8 \(byte 0\)"),
        (b"[" * 19_000, "inside one another"),
        (b"1" * 5000, "an integer of 5000 digits"),
        (b'{"a": 1, "a": 2}', "the key 'a' is there twice"),
    ],
)
def test_no_json(text: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        parse_json(text)
