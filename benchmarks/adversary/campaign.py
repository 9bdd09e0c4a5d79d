"""The oracle over many seeds: what is certified, what is not, and every claim that is false, by kind.

    python benchmarks/adversary/campaign.py --seeds 0:100000 --jobs 2 [--sane] [--json FILE]

Exit status 1 where any claim is false, an exception is none of the library's own, or numpy warns.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

#: A region that a bound is limited to has at least this many times the data's extent.
LEAST_REGION = 100.0
#: Seeds are given out in runs of this many.
RUN = 25
#: Errors of Python's that a library's own checks should have been in front of.
FOREIGN = (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)


@dataclass
class Result:
    """What one seed gave."""

    seed: int
    kind: str
    scale: str
    traits: list[str]
    status: str  #: of the certificate, or the class of the error
    cause: str = ""
    cost: float = 0.0
    relative_gap: float = 0.0
    has_region: bool = False
    region_ratio: float = 0.0
    violations: list[dict[str, Any]] = field(default_factory=list)
    seconds_library: float = 0.0  #: of the processor
    seconds: float = 0.0

    def violated(self, kind: str, said: float = 0.0, true: float = 0.0, note: str = "") -> None:
        amount = abs(said - true)
        self.violations.append(dict(kind=kind, amount=amount, relative=amount, said=said, true=true, note=note))


def attacked(seed: int, *, sane: bool) -> Result:
    """One seed: the problem solved, its certificate judged, and some answers certified."""
    from seeded_problems import seeded

    from gtsam_rwhec.geometry.blas_threads import one_blas_thread

    started = time.process_time()
    case = seeded(seed, sane=sane)
    result = Result(seed, case.kind, case.scale, sorted(set(case.traits)), "")
    # The oracle's matrices are as small as the library's: with threads it took 2.6 times as long.
    with warnings.catch_warnings(record=True, action="always") as heard, one_blas_thread():
        try:
            _solve_and_judge(case, result)
        except FOREIGN as error:
            result.status = result.status or type(error).__name__
            frames = traceback.extract_tb(error.__traceback__)
            own = [f for f in frames if "gtsam_rwhec" in f.filename or "adversary" in f.filename]
            place = f"{Path(own[-1].filename).name}:{own[-1].lineno}, in {own[-1].name}"
            result.violated(f"exception {type(error).__name__}", note=f"{place}: {error}")
    for warning in heard:
        if issubclass(warning.category, RuntimeWarning) and "adversary" not in warning.filename:
            result.violated("numpy warning", note=f"{warning.filename}:{warning.lineno}: {warning.message}")
            break
    result.seconds = time.process_time() - started
    return result


def _solve_and_judge(case: Any, result: Result) -> None:
    import numpy as np
    from given_rows import given_rows
    from oracle import judged

    from gtsam_rwhec.errors import RwhecError

    started = time.process_time()
    try:
        problem = case.problem()
        solution = case.solution(problem)
    except RwhecError as error:
        result.status = type(error).__name__
        return
    finally:
        result.seconds_library = time.process_time() - started
    certificate = solution.certificate
    cause = getattr(certificate, "cause", "")  # older versions have none
    result.status, result.cause = str(getattr(certificate.status, "value", certificate.status)), str(cause)
    result.cost, result.relative_gap = certificate.cost, certificate.relative_gap
    result.has_region = getattr(certificate, "region", None) is not None
    rows = given_rows(case, problem)
    matrices = {name: pose.matrix() for name, pose in {**solution.X, **solution.Y}.items()}
    parts = [(part.names, part.certificate) for part in solution.parts]
    verdict = judged(case, problem, rows, certificate, matrices, solution.scale, parts)
    if result.has_region:
        result.region_ratio = verdict.region_ratio
    if result.has_region and verdict.region_ratio < LEAST_REGION:
        result.violated("region too small", LEAST_REGION, verdict.region_ratio)
    result.violations += [asdict(violation) | {"note": "solve"} for violation in verdict.violations]
    rng = np.random.default_rng([case.seed, 11])
    if rng.random() < 0.12:
        _certify_another(case, problem, rows, solution, rng, result)


def _certify_another(case: Any, problem: Any, rows: Any, solution: Any, rng: Any, result: Result) -> None:
    """``certify`` of another answer: the truth, a perturbed one, an absurd scale."""
    import numpy as np
    from oracle import judged
    from seeded_motions import rotations

    import gtsam_rwhec as rw
    from gtsam_rwhec.errors import RwhecError

    draw = rng.random()
    matrices = {name: pose.matrix() for name, pose in {**solution.X, **solution.Y}.items()}
    scale = solution.scale
    if draw < 0.3:
        matrices = {name: case.truth[name].copy() for name in matrices}
        scale = 1.0 if case.scale == "known" else case.scales
        scale = next(iter(case.scales.values())) if case.scale == "shared" else scale
    elif draw < 0.8:
        size = 10 ** rng.uniform(-12, 0)
        for T in matrices.values():
            T[:3, :3] = (T[:3, :3] @ rotations(size * rng.standard_normal((1, 3)))[0]).astype(float)
            T[:3, 3] += size * rng.standard_normal(3)
    if draw > 0.7 and case.scale != "known":
        factor = 10 ** rng.choice([-250.0, -30.0, -6.0, 6.0, 30.0, 250.0])
        if isinstance(scale, dict):
            scale = {n: v if n in problem.fixed_scales else v * factor for n, v in scale.items()}
        else:
            scale = scale * factor
    X = {name: matrices[name] for name in problem.targets if name not in problem.fixed}
    Y = {name: matrices[name] for name in problem.sensors if name not in problem.fixed}
    try:
        certificate = rw.certify(problem, X, Y, scale)
    except RwhecError:
        return
    matrices |= problem.fixed
    with np.errstate(all="ignore"):  # absurd scales overflow here, in the oracle
        names = tuple(matrices)
        verdict = judged(case, problem, rows, certificate, matrices, scale, [(names, certificate)], starts=6)
    result.violations += [asdict(violation) | {"note": "certify"} for violation in verdict.violations]


# -- many -----------------------------------------------------------------------------------------------------------


def _run(task: tuple[int, int, bool]) -> list[Result]:
    first, last, sane = task
    return [attacked(seed, sane=sane) for seed in range(first, last)]


def results(first: int, last: int, *, sane: bool, jobs: int) -> Iterator[Result]:
    """Results of all seeds, in their order."""
    tasks = [(at, min(at + RUN, last), sane) for at in range(first, last, RUN)]
    if jobs == 1:
        for task in tasks:
            yield from _run(task)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        for batch in pool.imap(_run, tasks):
            yield from batch


class Tally:
    """Counts by kind, and the worst of each."""

    def __init__(self) -> None:
        self.by_kind: dict[str, Counter[str]] = {}
        self.causes: Counter[str] = Counter()
        self.violations: dict[tuple[str, str], list[tuple[Result, dict[str, Any]]]] = {}
        self.gaps: dict[str, list[float]] = {}
        self.shares: dict[str, Counter[str]] = {}
        self.number = 0
        self.library = self.total = 0.0
        self.slowest: list[tuple[float, int]] = []
        self.least_region = float("inf")

    def add(self, result: Result) -> None:
        self.number += 1
        self.by_kind.setdefault(result.kind, Counter())[result.status] += 1
        if result.status in ("gap", "failed"):
            self.causes[f"{result.status}: {result.cause}"] += 1
        for violation in result.violations:
            key = violation["kind"], violation["note"]
            self.violations.setdefault(key, []).append((result, violation))
        self.library += result.seconds_library
        self.total += result.seconds
        self.slowest = sorted([*self.slowest, (result.seconds_library, result.seed)], reverse=True)[:5]
        if result.has_region:
            self.least_region = min(self.least_region, result.region_ratio)
        for row in self._rows_of(result):
            self.shares.setdefault(row, Counter())[result.status] += 1
            if result.status.startswith("certified"):
                self.gaps.setdefault(row, []).append(result.relative_gap)

    @staticmethod
    def _rows_of(result: Result) -> list[str]:
        """The rows of the table of figures that a result counts for."""
        rows = []
        if result.kind.startswith("micrometres"):
            rows.append("sigma 1 um, " + ("offset 1e6 m" if "far away" in result.traits else "offset up to 1 km"))
        if result.has_region:
            rows.append("free directions, over their region")
        if not rows:
            rows.append("the others")
        return rows

    @property
    def number_of_violations(self) -> int:
        return sum(len(found) for found in self.violations.values())

    def print(self) -> None:
        statuses = sorted({status for counts in self.by_kind.values() for status in counts})
        print(f"{'kind':28}" + f"{'all':>8}" + "".join(f"{status[:14]:>15}" for status in statuses))
        total: Counter[str] = Counter()
        for kind, counts in sorted(self.by_kind.items()):
            total += counts
            row = "".join(f"{counts[status]:15}" for status in statuses)
            print(f"{kind:28}{counts.total():8}{row}")
        print(f"{'all':28}{total.total():8}" + "".join(f"{total[status]:15}" for status in statuses))
        optimal = sum(n for status, n in total.items() if status.startswith("certified"))
        all_of_them = max(total.total(), 1)
        print(f"proven optimal: {optimal / all_of_them:.4%}; certified: {total['certified'] / all_of_them:.4%}")
        for cause, count in self.causes.most_common():
            print(f"  {cause}: {count}")
        for row, gaps in sorted(self.gaps.items()):
            gaps.sort()
            counts = self.shares[row]
            shown = ", ".join(f"{share:.0%} {gaps[int(share * (len(gaps) - 1))]:.1e}" for share in (0.5, 0.95, 1.0))
            print(f"relative gap of what is proven, {row}: {shown}; proven {len(gaps)} of {counts.total()}")
        if self.least_region < float("inf"):
            print(f"least radius of a region over the data's extent: {self.least_region:.3g}")
        each, library = self.total / max(self.number, 1), self.library / max(self.number, 1)
        print(f"seconds a problem: {each:.4f}, of these the library {library:.4f}")
        print("slowest: " + ", ".join(f"seed {seed} {seconds:.2f} s" for seconds, seed in self.slowest))
        seeds = {result.seed for found in self.violations.values() for result, _ in found}
        print(f"VIOLATIONS: {self.number_of_violations}, in {len(seeds)} of {self.number} problems")
        for (kind, note), found in sorted(self.violations.items()):
            kinds = Counter(result.kind for result, _ in found)
            beyond = sum(violation["relative"] > 1e-6 for _, violation in found)
            worst, worst_violation = max(found, key=lambda pair: pair[1]["relative"])
            print(f"  {kind} ({note}): {len(found)}, of these {beyond} by more than 1e-6 max(cost, 1)")
            print(f"    kinds: {', '.join(f'{name} {n}' for name, n in kinds.most_common())}")
            print(f"    first seeds: {', '.join(str(result.seed) for result, _ in found[:12])}")
            print(
                f"    worst: seed {worst.seed}, {worst_violation['said']!r} said, {worst_violation['true']!r} found "
                f"(relative {worst_violation['relative']:.3g})"
            )


def seeds_of(text: str) -> tuple[int, int]:
    first, _, last = text.partition(":")
    return int(first), int(last)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, default=(0, 100_000), metavar="A:B")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--sane", action="store_true", help="problems as sane users have them")
    parser.add_argument("--json", type=Path, help="write each result here, one a line")
    options = parser.parse_args(arguments)
    tally = Tally()
    out = options.json.open("w") if options.json else None
    for result in results(*options.seeds, sane=options.sane, jobs=options.jobs):
        tally.add(result)
        if out:
            out.write(json.dumps(asdict(result)) + "\n")
    if out:
        out.close()
    tally.print()
    return 1 if tally.number_of_violations else 0


if __name__ == "__main__":
    sys.exit(main())
