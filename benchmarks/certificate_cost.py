"""What the certificate of the measurements as they were given costs, against another checkout and against copying.

    python benchmarks/certificate_cost.py [--tree PATH] [--count 1000000] [--rounds 6] [--repetitions 9]

PATH is the root of another checkout (its gtsam_rwhec/ and factors/ are used). The real dataset is solved by both
versions in processes that take turns; a million measurements, of one pair and of a hundred, are solved beside copies of
their arrays in one process. All times are seconds of the processor, and the least of many: other work on the machine
counts little. Without ``--tree`` the rows of the real dataset have no bar.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from bars import Row, benchmark_parser, print_rows
from dataset import utias_folder
from interleaved import in_words
from numpy.typing import NDArray

HERE = Path(__file__).resolve()
OWN_TREE = HERE.parents[1]
#: Of the real dataset, the other version's time to ours.
BAR = 1.5
#: Of many measurements, copies of the arrays, twice, to everything from arrays to certificate.
BARS_OF_COPIES = {True: 4.0, False: 6.0}
#: Targets and sensors of many measurements.
FRAMES = ((1, 1), (10, 10))


def least_seconds(repetitions: int, calls: dict[str, Callable[[], object]]) -> dict[str, float]:
    """The least of the processor's seconds of each call; the calls take turns, and the first round does not count."""
    least = dict.fromkeys(calls, np.inf)
    for repetition in range(repetitions + 1):
        for name, call in calls.items():
            start = time.process_time()
            call()
            if repetition:
                least[name] = min(least[name], time.process_time() - start)
    return least


def real_dataset(repetitions: int) -> dict[str, float]:
    """Seconds of all of ``solve`` and until the certificate is there, for each kind of scale, and the relative gaps."""
    import gtsam_rwhec as rw

    result = {}
    for scale in ("known", "shared"):
        problem = rw.read_csv(utias_folder(), scale=scale, sigma=1.0, kappa=1.0)
        whole, until = [], []
        for _ in range(repetitions + 1):
            certified_at = [0.0]

            def progress(stage: str, at: list[float] = certified_at) -> None:
                if stage == "identifiability":
                    at[0] = time.process_time()

            start = time.process_time()
            solution = rw.solve(problem, progress=progress)
            whole.append(time.process_time() - start)
            until.append(certified_at[0] - start)
        result |= {f"{scale} whole": min(whole[1:]), f"{scale} until": min(until[1:])}
        result[f"{scale} gap"] = solution.certificate.relative_gap
    return result


def many_measurements(count: int, targets: int, sensors: int, repetitions: int) -> dict[str, float]:
    """Seconds of copying the arrays twice, and from arrays to certificate, with measurements kept and not."""
    import gtsam_rwhec as rw
    from gtsam_rwhec.simulate import Noise, general

    noise = Noise(sigma_m=0.01, kappa=125.0)
    pairs = targets * sensors
    simulated = general(targets, sensors, seed=1, number_of_measurements=count // pairs, noise=noise).problem
    data: dict[rw.Pair, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
    for pair in simulated.pairs:
        measured = simulated.measurements(*pair)
        data[pair] = measured.A, measured.B
    del simulated

    def copies() -> None:
        for _ in range(2):
            _ = [(np.copy(A), np.copy(B)) for A, B in data.values()]

    def to_certificate(keep: bool) -> rw.Solution:
        problem = rw.Problem(scale="known", keep_measurements=keep)
        for (target, sensor), (A, B) in data.items():
            problem.add(target, sensor, A, B, noise.sigma_m, noise.kappa)
        return rw.solve(problem)

    calls = {"copies": copies, "kept": lambda: to_certificate(True), "not kept": lambda: to_certificate(False)}
    result = least_seconds(repetitions, calls)
    for keep, name in ((True, "kept gap"), (False, "not kept gap")):
        certificate = to_certificate(keep).certificate
        result[name] = certificate.relative_gap if certificate.is_certified else np.inf
    return result


def in_process(tree: Path, *arguments: object) -> dict[str, float]:
    """The result of a function of this script in a process of its own, which imports the library of ``tree``."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (tree, tree / "factors")))}
    command = [sys.executable, str(HERE), "--child", *map(str, arguments)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    result: dict[str, float] = json.loads(done.stdout)
    return result


def child(name: str, *numbers: str) -> int:
    """Print what `in_process` asked for."""
    function = {"real_dataset": real_dataset, "many_measurements": many_measurements}[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        print(json.dumps(function(*map(int, numbers))))
    return 0


def rows_of_real_dataset(tree: Path | None, rounds: int, repetitions: int) -> list[Row]:
    """Times of this version over those of the other."""
    trees = [OWN_TREE] if tree is None else [OWN_TREE, tree.resolve()]
    results: dict[Path, list[dict[str, float]]] = {each: [] for each in trees}
    for _ in range(rounds):
        for each in trees:
            results[each].append(in_process(each, "real_dataset", repetitions))
    rows = []
    for scale in ("known", "shared"):
        for key, what in (("until", "until the certificate"), ("whole", "all of solve")):
            seconds = [min(result[f"{scale} {key}"] for result in results[each]) for each in trees]
            name = f"real dataset, {scale} scale, {what}"
            if tree is None:
                rows.append(Row(name, in_words(seconds[0])))
                continue
            ratio = seconds[0] / seconds[1]
            figure = f"{ratio:.2f}x ({in_words(seconds[0])}; the other {in_words(seconds[1])})"
            rows.append(Row(name, figure, f"<= {BAR:g}x", ratio <= BAR))
        gap = results[OWN_TREE][0][f"{scale} gap"]
        rows.append(Row("    relative gap", f"{gap:.1e}", "<= 1e-12", gap <= 1e-12))
    return rows


def rows_of_many(count: int, repetitions: int) -> list[Row]:
    """Times from arrays to certificate over those of two copies of the arrays."""
    rows = []
    for targets, sensors in FRAMES:
        seconds = in_process(OWN_TREE, "many_measurements", count, targets, sensors, repetitions)
        pairs = targets * sensors
        for keep, name in ((True, "kept"), (False, "not kept")):
            ratio, bar = seconds[name] / seconds["copies"], BARS_OF_COPIES[keep]
            rows.append(
                Row(
                    f"{count:,} measurements of {pairs} pair{'s' * (pairs > 1)}, {name}, over copying them twice",
                    f"{ratio:.2f}x ({in_words(seconds[name])}; copies {in_words(seconds['copies'])})",
                    f"<= {bar:g}x",
                    ratio <= bar,
                )
            )
            gap = seconds[f"{name} gap"]
            rows.append(Row("    relative gap, certified", f"{gap:.1e}", "<= 1e-6", gap <= 1e-6))
    return rows


def main() -> int:
    """Print the table."""
    if sys.argv[1:2] == ["--child"]:
        return child(*sys.argv[2:])
    parser = benchmark_parser(__doc__)
    parser.add_argument("--tree", type=Path, help="root of the checkout to compare with")
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=6, help="processes of each version")
    parser.add_argument("--repetitions", type=int, default=9, help="in each process")
    given = parser.parse_args()
    rows = rows_of_real_dataset(given.tree, given.rounds, 3 * given.repetitions)
    rows += rows_of_many(given.count, given.repetitions)
    return print_rows("Cost of the certificate", rows, store=given.store)


if __name__ == "__main__":
    raise SystemExit(main())
