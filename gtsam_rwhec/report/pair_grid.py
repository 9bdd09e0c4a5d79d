"""The grid of the RWHEC paper's Figure 8: which pairs were seen, and which are determined on their own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile

from rich.console import Console, ConsoleOptions, RenderResult
from rich.style import Style
from rich.text import Text

from gtsam_rwhec.files.terminal_text import natural_key, shown
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.solver.identification import Identifiability


@dataclass(frozen=True)
class Symbol:
    """The sign for one state of a pair. The shapes differ, so that nobody needs to see the colours."""

    symbol: str
    ascii_symbol: str
    style: Style
    meaning: str


# Blue and vermillion of Okabe and Ito's palette, which people with any form of colour blindness tell apart.
DETERMINED = Symbol("■", "#", Style(color="#0072B2"), "determined by its own measurements")
NOT_DETERMINED = Symbol("□", "o", Style(color="#D55E00"), "seen, but not determined by its own measurements")
NOT_OBSERVED = Symbol("·", ".", Style(dim=True), "not seen")


@dataclass(frozen=True)
class PairGrid:
    """A grid with a row for each sensor and a column for each target. It prints itself to any width, in blocks."""

    identifiability: Identifiability

    def state(self, target: str, sensor: str) -> Symbol:
        """The state of one pair."""
        pair = self.identifiability.pairs.get(Pair(target, sensor))
        if pair is None:
            return NOT_OBSERVED
        return DETERMINED if pair.is_unique else NOT_DETERMINED

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Print the grid, then the meaning of its signs with their counts."""
        observed = [pair for pair in self.identifiability.pairs if not pair.is_motion]
        targets = sorted({target for target, _ in observed}, key=natural_key)
        sensors = sorted({sensor for _, sensor in observed}, key=natural_key)
        prefix, labels = _without_common_prefix(list(map(shown, targets)))
        side = max((len(shown(sensor)) for sensor in sensors), default=0)
        for block in _blocks(list(zip(targets, labels, strict=True)), options.max_width - side):
            yield Text(f"{'':{side}}" + "".join(f" {label:>{_width(label)}}" for _, label in block))
            for sensor in sensors:
                line = Text(f"{shown(sensor):<{side}}")
                for target, label in block:
                    state = self.state(target, sensor)
                    symbol = state.ascii_symbol if options.ascii_only else state.symbol
                    line.append(" " * _width(label)).append(symbol, state.style)
                yield line
        states = [self.state(target, sensor) for target in targets for sensor in sensors]
        legend = Text(f"Columns: targets{f' ({prefix}*)' if prefix else ''}. Rows: sensors. The pair is")
        for kind in (DETERMINED, NOT_DETERMINED, NOT_OBSERVED):
            symbol = kind.ascii_symbol if options.ascii_only else kind.symbol
            legend.append("\n").append(symbol, kind.style).append(f" {kind.meaning}: {states.count(kind)}")
        if observed:
            yield legend
        yield from _motions(self.identifiability)


def _motions(identifiability: Identifiability) -> Iterator[Text]:
    """A sentence for each sensor's own motion A Y = Y B, which has no target and so no place in the grid."""
    for pair, alone in identifiability.pairs.items():
        if pair.is_motion:
            verdict = "determined" if alone.is_unique else "not determined"
            yield Text(f"{shown(pair.sensor)} from its own motion: {verdict}")


def _width(label: str) -> int:
    return max(len(label), 1)


def _without_common_prefix(names: Sequence[str]) -> tuple[str, list[str]]:
    """("tag_", ["1", "20"]) of tag_1 and tag_20: the legend names the common beginning once."""
    first, last = min(names, default=""), max(names, default="")
    same = sum(1 for _ in takewhile(lambda letters: letters[0] == letters[1], zip(first, last, strict=False)))
    prefix = first[:same].rstrip("0123456789")
    if not all(name[len(prefix) :].isdecimal() for name in names):
        prefix = prefix[: max(prefix.rfind(separator) for separator in "_-/. ") + 1]
    if len(names) < 2 or prefix in names:
        return "", list(names)
    return prefix, [name[len(prefix) :] for name in names]


def _blocks(columns: Sequence[tuple[str, str]], width: int) -> Iterator[list[tuple[str, str]]]:
    """Cut the columns into blocks of at most `width` characters, with at least one column each."""
    block: list[tuple[str, str]] = []
    used = 0
    for target, label in columns:
        if block and used + _width(label) + 1 > width:
            yield block
            block, used = [], 0
        block.append((target, label))
        used += _width(label) + 1
    if block:
        yield block
