"""Coverage-guided fuzzing of the readers, with atheris: only RwhecError may leave a reader.

    python tests/fuzz/run.py mcap --seconds 3600
    python tests/fuzz/run.py --list

An input may take 500 MB (the whole process, with the library in it) and 10 s of the processor. A finding is kept with
its traceback, and the run goes on; at the end each kind of finding is printed once, and the exit status is 1. A corpus
that is kept (``--corpus``) is where the next run begins.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent

#: The readers, and the module of each one's harness.
READERS = {
    "csv": "csv_poses",
    "results": "result_json",
    "foxglove": "foxglove_json",
    "rig": "rig_yaml",
    "mcap": "mcap_logs",
    "cdr": "cdr_messages",
    "intrinsics": "intrinsics_yaml",
    "protobuf": "protobuf_messages",
    "poses": "pose_tables",
    "images": "image_bytes",
}
#: The whole process may have this many megabytes.
LIMIT_MB = 500
#: After this many findings a run ends: the first ones are to be mended.
MOST_FINDINGS = 200


@dataclass(frozen=True)
class Outcome:
    """What one run did."""

    reader: str
    seconds: float
    executions: int
    refused: int  #: How many inputs ended with an RwhecError; the rest was read
    #: How many of the branches of the library, and of the libraries that parse for it, the corpus reaches.
    coverage: int
    corpus: int
    peak_mb: int
    slowest_s: float
    findings: dict[str, Path]

    def __str__(self) -> str:
        lines = [
            f"{self.reader}: {self.seconds / 60:.1f} min, {self.executions} executions ({self.refused} refused), "
            f"coverage {self.coverage}, corpus {self.corpus}, peak {self.peak_mb} MB, slowest {self.slowest_s:.2f} s "
            f"of the processor, {len(self.findings)} kinds of findings"
        ]
        return "\n".join(lines + [f"  {kind}\n    {path}" for kind, path in self.findings.items()])


def fuzz(
    reader: str, seconds: float, corpus: Path, findings: Path, seed: int | None = None, most: int | None = None
) -> Outcome:
    """Fuzz one reader in processes of its own: a process that dies on an input is followed by another.

    With a seed and a number of executions (``most``), and time enough for them, each run tries the same inputs. The
    process that follows has the next seed: with the same one it would try, and die of, the same inputs again.
    """
    corpus.mkdir(parents=True, exist_ok=True)
    findings.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    memory = Path("/dev/shm")
    folder = tempfile.TemporaryDirectory(prefix="fuzz-", dir=memory if memory.is_dir() else None)
    environment = {**os.environ, "TMPDIR": folder.name, "PYTHONHASHSEED": "0"}
    executions = refused = coverage = peak_mb = 0
    slowest_s = 0.0
    processes = 0
    while (
        (left := seconds - (time.monotonic() - began)) > 0
        and (most is None or executions < most)
        and len(list(findings.iterdir())) < MOST_FINDINGS
    ):
        command = [sys.executable, str(HERE / "fuzzed_process.py"), reader, str(int(left) + 1), corpus, findings]
        limits = ["" if seed is None else str(seed + processes), "" if most is None else str(most - executions)]
        process = subprocess.run(
            [*map(str, command), *limits],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment,
        )  # fmt: skip
        processes += 1
        said = process.stdout.decode(errors="replace")
        state = findings.parent / f"{reader}.state.json"
        if not state.exists():
            raise SystemExit(f"the fuzzing of {reader} did not begin:\n{said[-5000:]}")
        done = json.loads(state.read_text())
        state.unlink()
        executions, refused = executions + done["executions"], refused + done["refused"]
        peak_mb, slowest_s = max(peak_mb, done["peak_mb"]), max(slowest_s, done["slowest_s"])
        coverage = max([coverage, *map(int, re.findall(r"cov: (\d+)", said))])
        _keep_artifacts(findings, process.returncode, said)
    folder.cleanup()
    kinds = {(found / "kind.txt").read_text(): found for found in sorted(findings.iterdir()) if found.is_dir()}
    took, size = time.monotonic() - began, len(list(corpus.iterdir()))
    return Outcome(reader, took, executions, refused, coverage, size, peak_mb, slowest_s, kinds)


def _keep_artifacts(findings: Path, status: int, said: str) -> None:
    """What libFuzzer itself ended for (memory, time, a crash outside Python), as a finding of its own kind."""
    for path in [file for file in findings.iterdir() if file.is_file()]:
        kind = path.name.split("-")[0]
        folder = findings / path.name[:40]
        folder.mkdir(exist_ok=True)
        path.rename(folder / "input.bin")
        (folder / "kind.txt").write_text(f"{kind} (status {status})")
        (folder / "traceback.txt").write_text(said[-20_000:])


def main() -> int:
    """The command; 1 if there were findings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", choices=[*READERS, []], metavar="READER", help=", ".join(READERS))
    parser.add_argument("--seconds", type=float, default=60.0, help="for each reader")
    parser.add_argument("--corpus", type=Path, help="keep the inputs that reach new code here, a folder a reader")
    parser.add_argument("--findings", type=Path, help="keep the findings here, a folder a reader")
    parser.add_argument("--seed", type=int, help="of libFuzzer; another one each time if left out")
    parser.add_argument("--list", action="store_true", help="name the readers")
    given = parser.parse_args()
    if given.list:
        print("\n".join(READERS))
        return 0
    is_good = True
    kept = given.findings or Path(tempfile.mkdtemp(prefix="fuzz-findings-"))
    with tempfile.TemporaryDirectory(prefix="fuzz-corpus-") as folder:
        corpus = given.corpus or Path(folder)
        for reader in given.readers or READERS:
            outcome = fuzz(reader, given.seconds, corpus / reader, kept / reader, given.seed)
            print(outcome, flush=True)
            is_good &= not outcome.findings
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main())
