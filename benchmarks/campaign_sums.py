"""What one seed of each long campaign counts, and what the sums of many are held to; `campaigns.py` runs them."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
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
from bars import Row, Share
from scipy.special import chdtri
from scipy.stats import ncx2

sys.path.append(str(Path(__file__).resolve().parent / "adversary"))
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
    """The kind without OpenCV's detector: its time, a third of all, is not counted here."""
    return replace(rendered_boards.KINDS[name](), peer=lambda gray: None)


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
