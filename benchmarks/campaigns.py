"""The long campaigns in parts: each run does the next seeds, and adds what it counted to benchmarks/campaigns.json.

    python benchmarks/campaigns.py [--only NAME ...] [--minutes 20] [--nice 19]     the next parts, then the table
    python benchmarks/campaigns.py --show                                           the table alone
    python benchmarks/campaigns.py --only NAME --again [SEED ...]                   seeds alone, or all failing ones

The first parts are those of campaigns that nobody has timed, then of the one that reaches half of its size soonest,
then of the one of which the least is done. A part is kept as soon as it ends, so an interrupted run loses less than
one. Seeds that follow each other on the same library are one entry: its `commit` is the last that changed
`gtsam_rwhec` or `factors`, with a "+" where files differ from what is committed. A failing case is kept with its seed.
``--again`` says what fails there now, and adds `mended` with the commit to a kept case that no longer fails. Exits with
1 if a bar is missed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import changes
import few_measurements
import gallery
import misreadings
import numpy as np
import rendered_boards
import split_halves
import wrong_assumptions
from bars import Row, Share, benchmark_parser, print_rows
from scipy.special import chdtri
from scipy.stats import ncx2

from gtsam_rwhec.files.whole_files import write_atomically

HERE = Path(__file__).resolve().parent
KEPT = HERE / "campaigns.json"
#: A part ends after the seed in which it has taken so many seconds of the processor.
PART_S = 20.0
sys.path.append(str(HERE / "adversary"))
Counts = Counter[str]
#: What a seed counted, and its failing cases, in words.
Found = tuple[Counts, list[str]]


@dataclass(frozen=True)
class Campaign:
    """A campaign of ``size`` seeds; ``bars`` are of sums and open failures."""

    size: int
    of: str
    one: Callable[[int], Found]
    bars: Callable[[Counts, int], list[Row]]
    command: str


# -- what one seed of each counts --------------------------------------------------------------------------------------


def adversary(seed: int, *, sane: bool) -> Found:
    from campaign import attacked

    result = attacked(seed, sane=sane)
    counts = Counts({f"status {result.status}": 1, f"kind {result.kind}": 1, "claims": len(result.violations)})
    words = "{kind} ({note}): {said!r} said, {true!r} found"
    return counts, [f"{result.kind}: {words.format(**violation)}" for violation in result.violations]


def few(trial: int) -> Found:
    found = few_measurements.counted(few_measurements.COUNTS, range(trial, trial + 1), few_measurements.SEED)
    counts = Counts({f"{name} {at}": number for name, values in vars(found).items() for at, number in values.items()})
    return counts, [f"free, N = {at}: called unique" for at, number in found.free_unique.items() if number]


@cache
def board(name: str) -> rendered_boards.Kind:
    return rendered_boards.KINDS[name]()


def boards(number: int) -> Found:
    counts, failing = Counts(), []
    for name in rendered_boards.KINDS:
        kind = board(name)
        one = rendered_boards.run_image(kind, name, 1, number)
        right = one.is_read and not one.wrong
        is_large = one.whole and not one.covered and one.side_px >= kind.least_px
        sums = {"images": 1, "read": one.is_read, "misread": one.wrong, "large": is_large, "held": is_large and right}
        if right:
            sums |= {"corners": one.corners, "squares": one.squares}
            sums |= dict(zip(rendered_boards.DIRECTIONS, map(float, one.sums), strict=True))
        counts.update({f"{name}: {what}": value for what, value in sums.items() if value})
        failing += [f"{name}: misread"] * one.wrong
    return counts, failing


def accusations(number: int) -> Found:
    kind, reasons = misreadings.accused(number, misreadings.good_problems())
    return Counts({"good": 1, "accused": bool(reasons)}), [f"{kind}: {reason}" for reason in reasons]


def assumptions(number: int) -> Found:
    counts = Counts()
    for row, name in enumerate(wrong_assumptions.CASES):
        # The child that `SeedSequence(0).spawn` gives to the row, and that one's to the run.
        found = wrong_assumptions.run_chunk(name, [np.random.SeedSequence(0, spawn_key=(row, number))])
        for what, share in found.held.items():
            counts.update({f"{name}: {what} held": share.held, f"{name}: {what} of": share.runs})
        counts.update({f"{name}: verdict {verdict}": 1 for verdict in found.verdicts})
    return counts, []


def halves(number: int) -> Found:
    found = split_halves.run(np.random.SeedSequence(0, spawn_key=(number,)), 1500)
    counts, failing = Counts({"own": sum(found.held), "own of": 2}), []
    counts.update(f"verdict {verdict}" for verdict in found.verdicts)
    for name, square in found.squares.items():
        within = square <= found.bounds[name]
        counts.update({f"{name} within": within, f"{name} within chi2": square <= chdtri(6, 1.0 - split_halves.LEVEL)})
        failing += [f"{name}: square {square:.1f}, bound {found.bounds[name]:.1f}"] * (not within)
    return counts, failing


def faults(number: int) -> Found:
    fault = gallery.FAULTS[number % len(gallery.FAULTS)]
    bad, good = (gallery.run(fault, 1 + number // len(gallery.FAULTS), is_good=is_good) for is_good in (False, True))
    counts = Counts({"bad": 1, "good": 1, "named": bad.named, "accused": good.accused, fault.name: bad.named})
    return counts, [str(bad)] * (not bad.named) + [f"{good}: {good.said[:200]}"] * good.accused


def pairs(number: int) -> Found:
    counts, failing = Counts(), []
    for kind in changes.KINDS:
        one = changes.run(kind, number, 0)
        counts.update({f"{kind} pairs": 1, f"{kind} answered": one["answered"]})
        if not one["answered"]:
            failing.append(f"{kind}: no covariances")
            continue
        alarms = {what: one[of] < changes.LEVEL for what, of in (("diff", "chance"), ("verify", "verified"))}
        tested = ("frame", "together", "together_joint", "one", "one_expected", "verified_one")
        counts.update({f"{kind} {what}": alarm for what, alarm in alarms.items()})
        counts.update({f"{kind} {what}": one[what] for what in tested if what in one})
        counts[f"{kind} one_named"] += one["one"] and one["one_named"]
        counts[f"{kind} verified of"] += "verified_one" in one
        failing += [f"{kind}: false alarm of {what}" for what, alarm in alarms.items() if alarm]
    return counts, failing


# -- the sums against the bars -----------------------------------------------------------------------------------------


def none_of(what: str, open_cases: int, more: str = "") -> Row:
    return Row(f"    {what}", f"{open_cases}{more}", "0", open_cases == 0)


def bars_of_adversary(sums: Counts, open_cases: int) -> list[Row]:
    statuses = Counter({name.removeprefix("status "): n for name, n in sums.items() if name.startswith("status ")})
    proven = sum(n for status, n in statuses.items() if status.startswith("certified"))
    said = ", ".join(f"{status} {n}" for status, n in statuses.most_common())
    return [none_of("false claims", open_cases), Row("    proven", f"{proven / statuses.total():.3%} ({said})")]


def bars_of_few(sums: Counts, _: int) -> list[Row]:
    found: dict[str, Counter[Any]] = {name: Counter() for name in few_measurements.Counts.__dataclass_fields__}
    for key, number in sums.items():
        name, _, at = key.rpartition(" ")
        found[name][int(at) if at.isdigit() else at] = number
    return [
        Row(f"    {row.what.strip()}", row.figure, row.bar, row.met) for row in few_measurements.Counts(**found).rows()
    ]


def bars_of_boards(sums: Counts, open_cases: int) -> list[Row]:
    result = [none_of("misread", open_cases, f" of {sum(n for name, n in sums.items() if name.endswith(': images'))}")]
    for name in rendered_boards.KINDS:
        of = {what: sums[f"{name}: {what}"] for what in ("large", "held", "corners", "squares")}
        if board(name).drawn is not None:  # another board is there: nothing is to be read
            continue
        recall, corners = Share(of["held"], of["large"]), max(of["corners"], 1)
        rms = (of["squares"] / (2 * corners)) ** 0.5
        bias = max(abs(sums[f"{name}: {direction}"]) / corners for direction in rendered_boards.DIRECTIONS)
        met = recall.value >= 0.98 and rms <= 0.05 and bias <= 0.01
        figure = f"recall {recall}, rms {rms:.4f} px, bias {bias:.4f} px"
        result.append(Row(f"    {name}", figure, "98 %, 0.05, 0.01 px", met))
    return result


def bars_of_assumptions(sums: Counts, _: int) -> list[Row]:
    result = []
    for name in wrong_assumptions.CASES:
        held = {
            what: Share(*(sums[f"{name}: {what} {of}"] for of in ("held", "of"))) for what in wrong_assumptions.NAMES
        }
        said = f"{name}: verdict "
        verdicts = Counter({key.removeprefix(said): n for key, n in sums.items() if key.startswith(said)})
        outcome = wrong_assumptions.Outcome(held, verdicts, verdicts.total())
        figure = ", ".join(f"{what} {share.value:.3f}" for what, share in held.items())
        figure += f"; not USE {100 * outcome.not_used.value:.1f} %"
        result.append(Row(f"    {name}", figure, ".92 to .98, or not USE in .99", outcome.is_met))
    return result


def bars_of_halves(sums: Counts, _: int) -> list[Row]:
    low, high = split_halves.BAND
    runs, bar = sums["own of"] // 2, f"{100 * low:g} to {100 * high:g} %"
    within = {name: Share(sums[f"{name} within"], runs) for name in split_halves.FRAMES}
    rows = [Row(f"    {name}, within the claimed 99 %", str(share)) for name, share in within.items()]
    camera = within["camera on hand"]
    rows[0] = Row(rows[0].what, rows[0].figure, bar, low <= camera.value <= high)
    return [*rows, Row("    a half's own 95 % ellipsoids", str(Share(sums["own"], sums["own of"])))]


def bars_of_gallery(sums: Counts, open_cases: int) -> list[Row]:
    named = Row(
        "    named", f"{sums['named']} of {sums['bad']}", ">= 140 of 150", sums["named"] >= gallery.NAMED * sums["bad"]
    )
    return [named, Row("    good runs accused", f"{sums['accused']} of {sums['good']}", "0", sums["accused"] == 0)]


def bars_of_changes(sums: Counts, _: int) -> list[Row]:
    def share(what: str, of: str = "answered", kinds: tuple[str, ...] = changes.KINDS) -> Share:
        return Share(*(sum(sums[f"{kind} {name}"] for kind in kinds) for name in (what, of)))

    result = []
    for what in ("diff", "verify"):
        alarms = share(what)
        by_kind = ", ".join(f"{kind} {100 * share(what, kinds=(kind,)).value:.2f} %" for kind in changes.KINDS)
        is_near = abs(alarms.value - changes.LEVEL) <= changes.BAND
        result.append(Row(f"    {what}: false alarms", f"{alarms}; {by_kind}", "1 +- 0.5 %", is_near))
    frame, together = share("frame"), share("together", kinds=changes.INDEPENDENT)
    theory = float(ncx2.sf(chdtri(6, changes.LEVEL), 6, changes.DEVIATIONS**2))
    is_found = frame.value >= changes.FOUND and abs(frame.value - theory) <= changes.NEAR
    result.append(
        Row("    diff: one frame moved", f"{frame}; theory {100 * theory:.1f} %", ">= 80 %, within 5", is_found)
    )
    is_near = abs(together.value - changes.POWER) <= changes.NEAR
    result.append(
        Row("    diff: all frames moved", f"{together}; theory {100 * changes.POWER:g} %", "within 5", is_near)
    )
    verified, expected = share("verified_one", "verified of"), share("one_expected").value
    is_found = verified.value >= expected - changes.NEAR
    words = f"{verified}; theory {100 * expected:.1f} %"
    return [*result, Row("    verify: one frame moved", words, "not 5 below", is_found)]


CAMPAIGNS = {
    "adversary": Campaign(
        100_000,
        "problems",
        lambda seed: adversary(seed, sane=False),
        bars_of_adversary,
        "adversary/campaign.py --seeds {}:{}",
    ),
    "adversary_sane": Campaign(
        20_000,
        "problems",
        lambda seed: adversary(seed, sane=True),
        bars_of_adversary,
        "adversary/campaign.py --sane --seeds {}:{}",
    ),
    "few_measurements": Campaign(2000, "trials at each N", few, bars_of_few, "few_measurements.py --trials {1}"),
    "boards": Campaign(2000, "images a kind", boards, bars_of_boards, "rendered_boards.py --images {1}"),
    "misreadings": Campaign(
        1000,
        "good problems",
        accusations,
        lambda sums, open_cases: [none_of("accused", open_cases, f" of {sums['good']}")],
        "misreadings.py --good {1}",
    ),
    "wrong_assumptions": Campaign(
        1000, "runs a row", assumptions, bars_of_assumptions, "wrong_assumptions.py --runs {1}"
    ),
    "split_halves": Campaign(300, "logs", halves, bars_of_halves, "split_halves.py --runs {1}"),
    "gallery": Campaign(150, "bad and good runs", faults, bars_of_gallery, "gallery.py --runs 10"),
    "changes": Campaign(1000, "pairs a kind of noise", pairs, bars_of_changes, "changes.py --runs {1}"),
}


# -- parts, kept and added up ------------------------------------------------------------------------------------------


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
    """A part: as many of the seeds as take ``PART_S``. What a seed raises is a failing case, and its counts are lost."""
    counts, failing, start = Counts(), [], time.process_time()
    for seed in seeds:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
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
    counts: Counts = Counter()
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


def run_again(name: str, seeds: list[int], parts: list[dict[str, Any]]) -> None:
    """Seeds alone, or those of all open cases: prints what fails, marks what no longer does."""
    cases = [case for part in parts_of(name, parts) for case in part["failing"] if "mended" not in case]
    for seed in seeds or sorted({case["seed"] for case in cases}):
        part = run(name, range(seed, seed + 1))
        now = [case["case"] for case in part["failing"]]
        print(f"{name}, seed {seed}, {part['seconds']} s: {'; '.join(now) or 'nothing fails'}", flush=True)
        for case in cases:
            # Of a case the words before the figures tell which it is.
            if case["seed"] == seed and case["case"].split(":")[0] not in {one.split(":")[0] for one in now}:
                case["mended"] = part["commit"]
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
            run_again(name, given.again, kept_parts())
        return 0
    end = time.monotonic() + 60.0 * given.minutes
    while not given.show and time.monotonic() < end:
        parts = kept_parts()
        waiting = [name for name in given.only if next_seeds(name, parts)]
        if not waiting:
            break
        name = min(waiting, key=lambda one: order_of(one, parts))
        part = run(name, next_seeds(name, parts))
        keep(added(part, parts))
        fails = "".join(f"\n    seed {case['seed']}: {case['case'][:300]}" for case in part["failing"])
        print(f"{name} {part['seeds'][0]}:{part['seeds'][1]}, {part['seconds']} s{fails}", flush=True)
    return print_rows("The campaigns so far", table(given.only, kept_parts()))


if __name__ == "__main__":
    raise SystemExit(main())
