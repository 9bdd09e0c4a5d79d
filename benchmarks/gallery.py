"""The gallery of failures: is each fault named, and is no good run accused?

    python benchmarks/gallery.py --runs 10 [--seed 1] [--faults board_moved ...] [--workers 2] [--out FOLDER]

Each run renders a folder of images with poses beside them, with a fault of `gallery_faults.FAULTS`, and calibrates it
as `gtsam-rwhec calibrate` does. A fault counts as named where all of its words are in the verdict or in what to do
below it (of input that is refused: in the error's message). The good run of a fault is the same without it; it counts
as accused where its verdict is not USE, or where the first paragraph has a fault's words. Each run's outcome is kept
in FOLDER: an interrupted campaign goes on where it was. Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import io
import json
import os
import re
import tempfile
import warnings
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path

import gallery_scene as scene
import numpy as np
from bars import Row, each_done, given_options, print_rows
from gallery_faults import FAULTS, Fault
from rich.console import Console

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.report.advice import advice_of
from gtsam_rwhec.report.terminal_report import print_sentence
from gtsam_rwhec.rig import read_rig

#: The share of runs in which the fault is to be named.
NAMED = 140 / 150
#: A terminal that breaks no line.
WIDE = 100_000


@dataclass(frozen=True)
class Outcome:
    """One run: its verdict ("refused" where it raised), the first paragraph, whether the fault's words are there."""

    fault: str
    seed: int
    is_good: bool
    verdict: str
    said: str
    named: bool

    @property
    def accused(self) -> bool:
        """Of a good run."""
        return self.verdict != "use" or self.named

    def __str__(self) -> str:
        named, accused = "named" if self.named else "MISSED", "ACCUSED" if self.accused else "not accused"
        kind, what = ("good", accused) if self.is_good else ("bad", named)
        return f"{self.fault:17s} {self.seed:6d} {kind:4s} {self.verdict:11s} {what}"


def paragraph(calibrated: rw.runs.Calibrated) -> str:
    """The verdict's sentence, and what to do: the first lines that `calibrate` prints."""
    stream = io.StringIO()
    console = Console(file=stream, width=WIDE)
    calibration = calibrated.calibration
    free = calibrated.refined.free_directions
    if not free:
        free = calibrated.solution.identifiability.free_directions
    for words, style in advice_of(free, calibrated.log, calibration.judgement):
        print_sentence(console, f"  - {words}", style)
    return f"{calibration.judgement}\n{stream.getvalue()}".strip()


def calibrated_folder(fault: Fault, seed: int, folder: Path, *, is_good: bool) -> tuple[str, str]:
    """Render into a folder, and calibrate: the verdict, and what is said first."""
    rng = np.random.default_rng([seed, zlib.crc32(fault.name.encode())])
    rig = scene.write((fault.good if is_good else fault.bad)(rng), folder / "run", seed)
    try:
        with warnings.catch_warnings(action="ignore"):
            calibrated = rw.calibrate_log(folder / "run", read_rig(rig), folder / "out", workers=1)
    except RwhecError as error:
        return "refused", str(error)
    return calibrated.judgement.verdict.value, paragraph(calibrated)


def run(fault: Fault, seed: int, *, is_good: bool) -> Outcome:
    """One run, from the images."""
    with tempfile.TemporaryDirectory() as name:
        verdict, said = calibrated_folder(fault, seed, Path(name), is_good=is_good)
    words = [all(re.search(word, said, re.IGNORECASE) for word in one.words) for one in FAULTS]
    named = any(words) if is_good else words[FAULTS.index(fault)]
    return Outcome(fault.name, seed, is_good, verdict, said, named)


def kept_run(number: int, seed: int, is_good: bool, out: Path | None) -> Outcome:
    """One run, or its outcome where it is kept."""
    fault = FAULTS[number]
    path = None if out is None else out / f"{fault.name}_{seed}_{'good' if is_good else 'bad'}.json"
    if path is not None and path.exists():
        return Outcome(**json.loads(path.read_text(encoding="utf-8")))
    outcome = run(fault, seed, is_good=is_good)
    if path is not None:
        part = path.with_suffix(".part")
        part.write_text(json.dumps(asdict(outcome), indent=1), encoding="utf-8")
        part.replace(path)
    return outcome


def outcomes(faults: list[Fault], seeds: list[int], workers: int, out: Path | None, kinds: list[bool]) -> list[Outcome]:
    """All runs; each is said when it ends."""
    jobs = [(FAULTS.index(fault), seed, is_good, out) for seed in seeds for fault in faults for is_good in kinds]
    found = []
    for _, one in each_done(kept_run, jobs, workers, "runs"):
        found.append(one)
        what = ("ACCUSED" if one.accused else "not accused") if one.is_good else ("named" if one.named else "MISSED")
        kind = "good" if one.is_good else "bad "
        print(
            f"{len(found):4d} of {len(jobs)}  {one.fault:17s} {one.seed:6d} {kind} {one.verdict:11s} {what}", flush=True
        )
    return found


def rows(found: list[Outcome]) -> list[Row]:
    """The table."""
    table = []
    bad, good = [one for one in found if not one.is_good], [one for one in found if one.is_good]
    for fault in FAULTS:
        of_bad = [one for one in bad if one.fault == fault.name]
        of_good = [one for one in good if one.fault == fault.name]
        if of_bad or of_good:
            figures = f"{sum(one.named for one in of_bad)} of {len(of_bad)} named"
            table.append(
                Row(fault.title, f"{figures}, {sum(one.accused for one in of_good)} of {len(of_good)} accused")
            )
    if bad:
        number = sum(one.named for one in bad)
        table.append(Row("all faults named", f"{number} of {len(bad)}", ">= 140 of 150", number >= NAMED * len(bad)))
    if good:
        number = sum(one.accused for one in good)
        table.append(Row("good runs accused", f"{number} of {len(good)}", "0 of 150", number == 0))
    return table


def main() -> int:
    """Run it; 0 if the bars are met."""
    names = tuple(fault.name for fault in FAULTS)
    workers = os.cpu_count() or 1
    given = given_options(runs=10, seed=1, faults=names, only=("bad", "good"), workers=workers, out=Path)
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
    faults = [fault for fault in FAULTS if fault.name in given.faults]
    seeds = list(range(given.seed, given.seed + given.runs))
    found = outcomes(faults, seeds, given.workers, given.out, [kind == "good" for kind in given.only])
    return print_rows(f"Gallery of failures, {given.runs} seeds from {given.seed}", rows(found))


if __name__ == "__main__":
    raise SystemExit(main())
