"""KinHEC, a neutral benchmark: its eleven baselines and `rw.calibrate`, by its protocol.

    python benchmarks/kinhec.py [--seeds 20260909] [--offsets true|estimated] [--tracks noise ...] [--jobs 1]

Its package (`pip install '.[bench]'`; MIT) generates the small tier: 562 sequences in eight tracks for each seed. Each
method is given the keyframes of the protocol; ours is `rw.calibrate(problem)` alone, with no option, no weight and no
setting by track. Part of the problem are the scale mode ("shared" for a monocular camera that tracks itself) and the
stamps. "estimated": asynchronous sequences, of which each method is given what its own clock makes; KinHEC's is a
cross-correlation, ours `rw.geometry.estimate_time_offset`.

Errors are of KinHEC's X, over the sequences that we call unique; the others are listed with everybody's errors on them.
Seeds are pooled: `--seeds 20260909,1,2,3,4`. A seed takes some minutes to generate, and is kept in --folder with the
baselines' answers. Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import kinhec_tables
from bars import benchmark_parser, each_done, print_rows, wide_console
from calibrate_times import rows as time_rows
from kinhec_answers import Answer, Offsets, answers_of, baselines_of, store_baselines, stored_baselines
from kinhec_sequences import STANDARD_SEED, TRACKS, generated, numbers_of

CHUNK = 20
Result = TypeVar("Result")


def in_chunks(
    what: str, numbers: list[int], jobs: int, of_chunk: Callable[..., Result], root: Path, seed: int, *others: object
) -> Iterator[Result]:
    """``of_chunk(root, seed, numbers, ...)`` of all numbers, in processes if there are several jobs."""
    chunks = [numbers[first : first + CHUNK] for first in range(0, len(numbers), CHUNK)]
    calls = [(root, seed, chunk, *others) for chunk in chunks]
    yield from (result for _, result in each_done(of_chunk, calls, jobs, what))


def answers(
    seeds: list[int],
    offsets: Offsets,
    *,
    tracks: tuple[str, ...] = TRACKS,
    jobs: int = 1,
    folder: Path | None = None,
    tier: str = "small",
) -> list[Answer]:
    """Everybody's answers to every sequence of some seeds."""
    found: list[Answer] = []
    for seed in seeds:
        root = generated(seed, folder, tier, jobs=jobs)
        numbers = numbers_of(root, tracks, synchronous=offsets == "true")
        path = root / f"baselines_{offsets}_offsets.json"
        baselines = stored_baselines(path)
        missing = [number for number in numbers if number not in baselines]
        for part in in_chunks(f"baselines, seed {seed}", missing, jobs, baselines_of, root, seed, offsets):
            baselines |= part
            store_baselines(path, baselines)
        what = f"rw.calibrate, seed {seed}"
        parts = in_chunks(what, numbers, jobs, answers_of, root, seed, offsets, baselines)
        of_seed = [answer for part in parts for answer in part]
        found += sorted(of_seed, key=lambda answer: answer.name)
    return found


def main() -> int:
    """Run it; 0 if the bars are met."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--seeds", default=str(STANDARD_SEED), help=f"with commas between (default: {STANDARD_SEED})")
    parser.add_argument("--offsets", choices=("true", "estimated"), default="true")
    parser.add_argument("--tracks", nargs="+", choices=TRACKS, default=TRACKS)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes (default: one for each core)")
    parser.add_argument(
        "--folder", type=Path, help="where the data are kept (default: in the folder for passing files)"
    )
    parser.add_argument("--tier", default="small", choices=("smoke", "small", "medium"))
    parser.add_argument("--no-times", action="store_true", help="leave out the times of a second call")
    arguments = parser.parse_args()
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    console = wide_console()
    found = answers(
        seeds,
        arguments.offsets,
        tracks=tuple(arguments.tracks),
        jobs=arguments.jobs,
        folder=arguments.folder,
        tier=arguments.tier,
    )
    for table in kinhec_tables.leaderboard(found):
        console.print(table)
    console.print(kinhec_tables.not_compared(found))
    console.print(kinhec_tables.verdicts(found))
    result = kinhec_tables.rows(found, arguments.offsets)
    if not arguments.no_times:
        result += time_rows(3)
    title = f"KinHEC {arguments.tier}, {len(seeds)} seed{'s' * (len(seeds) > 1)}, {arguments.offsets} offsets"
    return print_rows(title, result)


if __name__ == "__main__":
    raise SystemExit(main())
