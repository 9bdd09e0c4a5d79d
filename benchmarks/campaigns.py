"""The long campaigns in parts: each run does the next seeds, and adds what it counted to benchmarks/campaigns.json.

    python benchmarks/campaigns.py [--only NAME ...] [--minutes 20] [--nice 19]     the next parts, then the table
    python benchmarks/campaigns.py --show                                           the table alone
    python benchmarks/campaigns.py --only NAME --again [SEED ...]                   seeds alone, or all failing ones

The first parts are those of campaigns that nobody has timed, then of the one that reaches half of its size soonest,
then of the one of which the least is done. A part is kept as soon as it ends, so an interrupted run loses less than
one. Seeds that follow each other on the same library are one entry: its `commit` is the last that changed
`gtsam_rwhec` or `factors`, with a "+" where files differ from what is committed. A failing case is kept with its seed.
``--again`` says what fails there now, and adds `mended` with the commit to a kept case that no longer fails. Exits with
1 if a bar is missed; bars of few seeds may be missed by chance.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
import warnings
from functools import cache
from pathlib import Path
from typing import Any

from bars import Row, benchmark_parser, print_rows
from campaign_sums import CAMPAIGNS, Counts, none_of

from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.geometry.blas_threads import one_blas_thread

HERE = Path(__file__).resolve().parent
KEPT = HERE / "campaigns.json"
#: A part ends after the seed in which it has taken so many seconds of the processor.
PART_S = 5.0


def kept_parts() -> list[dict[str, Any]]:
    return json.loads(KEPT.read_text(encoding="utf-8"))["parts"] if KEPT.exists() else []


def keep(parts: list[dict[str, Any]]) -> None:
    parts.sort(key=lambda part: (list(CAMPAIGNS).index(part["campaign"]), part["seeds"]))
    lines = ",\n".join(json.dumps(part) for part in parts)
    write_atomically(KEPT, f'{{"parts": [\n{lines}\n]}}\n'.encode())


def parts_of(name: str, parts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted((part for part in parts if part["campaign"] == name), key=lambda part: part["seeds"])


def next_seeds(name: str, parts: list[dict[str, Any]]) -> range:
    """The first that no part covers; none where all are done."""
    at, end = 0, CAMPAIGNS[name].size
    for first, last in (part["seeds"] for part in parts_of(name, parts)):
        if first > at:
            end = first
            break
        at = max(at, last)
    return range(at, end)


@cache
def product() -> str:
    """The commit that last changed what is tested, with a "+" where the files are not as committed."""

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", HERE, *words], capture_output=True, text=True, check=True).stdout.strip()

    library = [str(HERE.parent / folder) for folder in ("gtsam_rwhec", "factors")]
    changed = git("status", "--porcelain", "--", *library, str(HERE), f":(exclude){HERE}/campaign*")
    return git("log", "-1", "--format=%h", "--abbrev=8", "--", *library) + "+" * bool(changed)


def run(name: str, seeds: range) -> dict[str, Any]:
    """A part: as many of the seeds as take ``PART_S``. What a seed raises is a failing case; its counts are lost."""
    counts, failing, start = Counts(), [], time.process_time()
    for seed in seeds:
        try:
            with warnings.catch_warnings(action="ignore"), one_blas_thread():
                of_seed, cases = CAMPAIGNS[name].one(seed)
        except Exception as error:  # noqa: BLE001  (whatever it is, it is a finding)
            of_seed, cases = Counts(), [f"raised {type(error).__name__}: {error}"]
        counts.update(of_seed)
        failing += [{"seed": seed, "case": case} for case in cases]
        if time.process_time() - start > PART_S:
            break
    return {
        "campaign": name,
        "seeds": [seeds.start, seed + 1],
        "commit": product(),
        "date": time.strftime("%Y-%m-%d"),
        "seconds": round(time.process_time() - start, 2),
        "failing": failing,
        "counts": {what: plain(value) for what, value in sorted(counts.items()) if value},
    }


def plain(value: Any) -> float:
    """As JSON has it: whole where it is, else to nine digits."""
    return int(value) if value == int(value) else float(f"{value:.9g}")


def added(part: dict[str, Any], parts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The parts with this one, as a part of its own or at the end of one that it follows on the same library."""
    for before in parts:
        same = all(before[of] == part[of] for of in ("campaign", "commit"))
        if same and before["seeds"][1] == part["seeds"][0]:
            counts = Counts(before["counts"])
            counts.update(part["counts"])
            joined = {
                "seeds": [before["seeds"][0], part["seeds"][1]],
                "seconds": round(before["seconds"] + part["seconds"], 2),
                "failing": before["failing"] + part["failing"],
                "counts": {what: plain(value) for what, value in sorted(counts.items())},
            }
            return [one for one in parts if one is not before] + [part | joined]
    return [*parts, part]


def sums_of(name: str, parts: list[dict[str, Any]]) -> tuple[int, float, Counts, int]:
    """Seeds, seconds of the processor, sums, and failing cases that are not mended."""
    counts = Counts()
    own = parts_of(name, parts)
    for part in own:
        counts.update(part["counts"])
    seeds = sum(last - first for first, last in (part["seeds"] for part in own))
    is_open = [case for part in own for case in part["failing"] if "mended" not in case]
    return seeds, sum(part["seconds"] for part in own), counts, len(is_open)


def order_of(name: str, parts: list[dict[str, Any]]) -> tuple[int, float]:
    """What sorts campaigns by which is to be next."""
    seeds, seconds, *_ = sums_of(name, parts)
    size = CAMPAIGNS[name].size
    if not seeds:
        return 0, 0.0
    return (1, (size / 2 - seeds) * seconds / seeds) if seeds < size / 2 else (2, seeds / size)


def run_again(name: str, seeds: list[int]) -> None:
    """Seeds alone, or those of all open cases: prints what fails, marks what no longer does."""
    cases = [case for part in parts_of(name, kept_parts()) for case in part["failing"]]
    for seed in seeds or sorted({case["seed"] for case in cases if "mended" not in case}):
        part = run(name, range(seed, seed + 1))
        now = [case["case"] for case in part["failing"]]
        print(f"{name}, seed {seed}, {part['seconds']} s: {'; '.join(now) or 'nothing fails'}", flush=True)
        parts = kept_parts()  # another process may have added some meanwhile
        for case in (case for one in parts_of(name, parts) for case in one["failing"] if case["seed"] == seed):
            # The words before the figures tell which case it is.
            if case["case"].split(":")[0] not in {one.split(":")[0] for one in now}:
                case.setdefault("mended", part["commit"])
        keep(parts)


def table(names: list[str], parts: list[dict[str, Any]]) -> list[Row]:
    """For each campaign its size, its command, and the sums against its bars."""
    result = []
    for name in names:
        campaign = CAMPAIGNS[name]
        seeds, seconds, sums, open_cases = sums_of(name, parts)
        if not seeds:
            result.append(Row(name, f"none of {campaign.size:,} {campaign.of}", ">= half", False))
            continue
        each = seconds / seeds
        half = each * campaign.size / 2 / 3600
        commits = ", ".join(sorted({part["commit"] for part in parts_of(name, parts)}))
        figure = (
            f"{seeds:,} of {campaign.size:,} {campaign.of}; {each:.3g} s each, half of all {half:.2g} h; at {commits}"
        )
        result.append(Row(name, figure, ">= half", 2 * seeds >= campaign.size))
        result.append(Row(f"    benchmarks/{campaign.command.format(0, seeds)}", ""))
        result += campaign.bars(sums, open_cases)
        raised = [c for p in parts_of(name, parts) for c in p["failing"] if c["case"].startswith("raised")]
        if raised:
            result.append(none_of("seeds that raised", sum("mended" not in case for case in raised)))
    return result


def main() -> int:
    parser = benchmark_parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=list(CAMPAIGNS), default=list(CAMPAIGNS), metavar="NAME")
    parser.add_argument("--minutes", type=float, default=20.0, help="begin no part after these (default: 20)")
    parser.add_argument("--nice", type=int, default=19, help="the least niceness that it runs at (default: 19)")
    parser.add_argument("--show", action="store_true", help="the table alone")
    parser.add_argument("--again", nargs="*", type=int, metavar="SEED", help="these seeds alone, or all failing ones")
    given = parser.parse_args()
    os.nice(max(given.nice - os.nice(0), 0))
    if given.again is not None:
        for name in given.only:
            run_again(name, given.again)
        return 0
    end = time.monotonic() + 60.0 * given.minutes
    while not given.show and time.monotonic() < end:
        parts = kept_parts()
        waiting = [name for name in given.only if next_seeds(name, parts)]
        if not waiting:
            break
        name = min(waiting, key=lambda one: order_of(one, parts))
        part = run(name, next_seeds(name, parts))
        parts = kept_parts()
        if next_seeds(name, parts)[:1] != range(part["seeds"][0], part["seeds"][0] + 1):
            parser.error(f"another process ran {name} from {part['seeds'][0]} too: let one run at a time")
        keep(added(part, parts))
        fails = "".join(f"\n    seed {case['seed']}: {case['case'][:300]}" for case in part["failing"])
        print(f"{name} {part['seeds'][0]}:{part['seeds'][1]}, {part['seconds']} s{fails}", flush=True)
    return print_rows("The campaigns so far", table(given.only, kept_parts()))


if __name__ == "__main__":
    raise SystemExit(main())
