"""The share of problems that are proven optimal, of two versions of the library on the same seeds.

    python benchmarks/adversary/share_certified.py --tree PATH --seeds 0:2000 [--all-kinds] [--jobs 2]

PATH is the root of another checkout (its gtsam_rwhec/ and factors/ are used); the other version is this one. Sane
problems are compared, or all kinds.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import warnings
from collections import Counter
from itertools import pairwise
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]
PROVEN = ("certified", "certified_not_unique")


def statuses(first: int, last: int, *, sane: bool) -> dict[int, tuple[str, float]]:
    """Status (or class of error) and relative gap by seed, of the version that this process imports."""
    from campaign import FOREIGN
    from seeded_problems import seeded

    from gtsam_rwhec.errors import RwhecError

    result = {}
    with warnings.catch_warnings(action="ignore"):
        for seed in range(first, last):
            try:
                case = seeded(seed, sane=sane)
                certificate = case.solution(case.problem()).certificate
                result[seed] = certificate.status.value, certificate.relative_gap
            except (RwhecError, *FOREIGN) as error:
                result[seed] = type(error).__name__, 0.0
    return result


def of_tree(tree: Path, first: int, last: int, *, sane: bool) -> subprocess.Popen[str]:
    """A process that prints the statuses of another checkout's version."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (tree, tree / "factors")))}
    command = [sys.executable, str(Path(__file__).resolve()), "--tree", str(tree), "--seeds", f"{first}:{last}"]
    command += ["--print-own"] + ["--all-kinds"] * (not sane)
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def both(
    trees: tuple[Path, Path], first: int, last: int, *, sane: bool, jobs: int
) -> list[dict[int, tuple[str, float]]]:
    """The statuses of two trees, each in as many processes at a time as it is allowed."""
    cuts = [first + (last - first) * k // jobs for k in range(jobs + 1)]
    results: list[dict[int, tuple[str, float]]] = []
    for tree in trees:
        found: dict[int, tuple[str, float]] = {}
        children = [of_tree(tree, a, b, sane=sane) for a, b in pairwise(cuts) if b > a]
        for child in children:
            printed, _ = child.communicate()
            if child.returncode:
                raise SystemExit(f"the run of {tree} ended with {child.returncode}")
            found |= {int(seed): tuple(value) for seed, value in json.loads(printed).items()}
        results.append(found)
    return results


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tree", type=Path, required=True, help="root of the checkout to compare with")
    parser.add_argument("--seeds", default="0:2000", metavar="A:B")
    parser.add_argument("--all-kinds", action="store_true", help="all kinds of problems, not the sane ones alone")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--print-own", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    first, last = (int(part) for part in options.seeds.split(":"))
    sane, tree = not options.all_kinds, options.tree.resolve()
    if options.print_own:
        import gtsam_rwhec

        used = Path(gtsam_rwhec.__file__).resolve()
        if not used.is_relative_to(tree):
            raise SystemExit(f"gtsam_rwhec comes from {used}, not from {tree}")
        print(json.dumps(statuses(first, last, sane=sane)))
        return 0
    theirs, ours = both((tree, REPOSITORY), first, last, sane=sane, jobs=options.jobs)
    shares = []
    for name, found in ((str(options.tree), theirs), ("this version", ours)):
        counts = Counter(status for status, _ in found.values())
        proven = sorted(gap for status, gap in found.values() if status in PROVEN)
        shares.append(len(proven) / len(found))
        said = ", ".join(f"{status} {n}" for status, n in counts.most_common())
        print(f"{name}: proven optimal {shares[-1]:.3%}, certified {counts['certified'] / len(found):.3%} ({said})")
        if proven:
            print(f"  relative gap: median {proven[len(proven) // 2]:.1e}, largest {proven[-1]:.1e}")
    for what, before, after in (("lost", theirs, ours), ("won", ours, theirs)):
        seeds = [s for s in theirs if before[s][0] in PROVEN and after[s][0] not in PROVEN]
        print(f"{what}: {len(seeds)}" + (f", seeds {', '.join(map(str, seeds[:20]))}" if seeds else ""))
    changed = Counter((theirs[s][0], ours[s][0]) for s in theirs if theirs[s][0] != ours[s][0])
    for (before_status, after_status), count in changed.most_common():
        print(f"  {before_status} -> {after_status}: {count}")
    return 0 if shares[1] >= shares[0] else 1


if __name__ == "__main__":
    sys.exit(main())
