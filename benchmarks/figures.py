"""The benchmarks' last figures and their bars, in figures.json beside this file, and how new ones compare with them.

``--store`` of a benchmark writes its figures there; a commit that makes something slower or less exact then shows it.
"""

from __future__ import annotations

import json
import math
import os
import platform
import re
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

PATH = Path(__file__).with_name("figures.json")
#: Times on a machine that does other work too differ by so much, relative, from one run to the next.
SAME = 0.15
#: Below this share of its bar a figure is rounding, whose size says nothing.
FAR = 0.01
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Figure:
    """One figure as it was printed, with what tells where it comes from."""

    figure: str
    bar: str
    met: bool | None
    version: str
    machine: str
    date: str = field(default_factory=lambda: datetime.now(UTC).strftime("%Y-%m-%d"))


def machine_class() -> str:
    """What times depend on: the processor's kind, the number of cores, and threads if the environment sets them."""
    threads = os.environ.get("OPENBLAS_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS") or "as installed"
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, BLAS threads {threads}"


def stored() -> dict[str, Figure]:
    """By name; empty where nothing was stored yet."""
    if not PATH.is_file():
        return {}
    return {name: Figure(**fields) for name, fields in json.loads(PATH.read_text(encoding="utf-8")).items()}


def write(found: dict[str, Figure]) -> Path:
    """Put figures in the place of those of the same names; the others stay."""
    figures = {name: asdict(figure) for name, figure in sorted((stored() | found).items())}
    PATH.write_text(json.dumps(figures, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return PATH


def compared(now: Figure, last: Figure | None) -> str:
    """In words: "worse than last by 31 % (2.0x, 0.1.0 of 2026-01-31)"; empty where there is nothing to compare."""
    if last is None:
        return ""
    origin = f"({last.figure}; {last.version} of {last.date})"
    if last.machine != now.machine:
        return f"on another machine {origin}"
    here, there = _NUMBER.search(now.figure), _NUMBER.search(last.figure)
    if now.figure == last.figure or here is None or there is None:
        return "the same" if now.figure == last.figure else f"was {origin}"
    if _unit(now.figure, here) != _unit(last.figure, there) or not now.bar.startswith(("<=", ">=")):
        return f"was {origin}"
    new, old = float(here[0]), float(there[0])
    if old == 0.0 or new == 0.0 or math.isclose(new, old, rel_tol=SAME):
        return "the same within noise" if math.isclose(new, old, rel_tol=SAME) else f"was {origin}"
    bar = _NUMBER.search(now.bar)
    if bar is not None and now.bar.startswith("<=") and max(new, old) < FAR * float(bar[0]):
        return "far below the bar, as the last"
    worse = (new > old) == now.bar.startswith("<=")
    return f"{'worse' if worse else 'better'} than last by {100.0 * abs(new / old - 1.0):.0f} % {origin}"


def _unit(figure: str, number: re.Match[str]) -> str:
    """What stands behind the number: "x", " ms"; up to a blank, a comma or a bracket."""
    return re.match(r" ?[^ ,;()]*", figure[number.end() :])[0]  # type: ignore[index]  # it matches the empty text too
