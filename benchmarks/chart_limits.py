"""The limits of the control chart, by Monte Carlo: writes ``gtsam_rwhec/results/chart_limits.json``.

Every path is a robot that nothing happens to: nights of independent standard normal numbers, some groups of equal
size. Its statistic of each night is the smallest chance over moments and groups (`gtsam_rwhec.results.control_chart`).
The limit of a night is such that, of the paths without an alarm so far, the given share has one (Hawkins and Zamba
2005). It is kept as limit / rate, which is one over the number of moments that the search is worth, and smoothed over
nights.

    python benchmarks/chart_limits.py [--paths 100000]
"""

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.special import chdtrc

from gtsam_rwhec.results.control_chart import OF_ALL

TABLE = Path(__file__).parents[1] / "gtsam_rwhec/results/chart_limits.json"
NIGHTS = 61
#: Kept nights: the limits change slowly after the first ones.
KEPT = (2, 3, 4, 5, 6, 8, 10, 13, 17, 22, 28, 36, 46, 61)
GROUPS = ((1, 1), (1, 3), (1, 6), (2, 6), (4, 6), (8, 6), (16, 6))
RATES = (1e-2, 1e-3)


def chances(groups: int, size: int, paths: int, seed: int) -> np.ndarray:
    """The statistic (paths, NIGHTS + 1) of each night; 1 where there is none yet."""
    chance = np.random.default_rng(seed)
    found = np.ones((paths, NIGHTS + 1))
    step = max(40_000_000 // (NIGHTS * NIGHTS * 8), 1)
    k, n = np.arange(1, NIGHTS + 1)[:, None], np.arange(1, NIGHTS + 1)
    with np.errstate(divide="ignore"):
        weight = np.where(k < n, n / (k * np.maximum(n - k, 1)), 0.0).astype(np.float32)
    share = (k / n).astype(np.float32)
    for first in range(0, paths, step):
        count = min(step, paths - first)
        joint, least = np.zeros((count, NIGHTS, NIGHTS), np.float32), np.ones((count, NIGHTS))
        for _ in range(groups):
            S = np.cumsum(chance.standard_normal((count, NIGHTS, size), np.float32), axis=1)
            gram = S @ S.transpose(0, 2, 1)
            square = np.einsum("pii->pi", gram)
            # |S_k - (k / n) S_n|^2 n / (k (n - k)): the step after night k, seen from night n.
            T = weight * (square[:, :, None] - 2.0 * share * gram + share**2 * square[:, None, :])
            joint += T
            least = np.minimum(least, chdtrc(size, T.max(axis=1).astype(float)))
        if groups > 1:
            together = chdtrc(groups * size, joint.max(axis=1).astype(float)) / OF_ALL
            least = np.minimum(together, groups * least / (1.0 - OF_ALL))
        found[first : first + count, 1:] = least
    found[:, 1] = 1.0  # of one night
    return found


def limits(found: np.ndarray, rate: float) -> np.ndarray:
    """limit / rate (NIGHTS + 1,) of each night from the second on."""
    alive, limit = np.ones(len(found), bool), np.ones(NIGHTS + 1)
    for n in range(2, NIGHTS + 1):
        limit[n] = np.quantile(found[alive, n], rate)
        alive &= found[:, n] >= limit[n]
    return limit / rate


def smoothed(ratio: np.ndarray) -> list[float]:
    """limit / rate at the kept nights: its logarithm as a cubic polynomial of log(1 + log(n - 1)), least squares."""
    n = np.arange(2, NIGHTS + 1)
    at = np.log1p(np.log(n - 1.0))
    fitted = np.polynomial.Polynomial.fit(at, np.log(ratio[2:]), 3, w=np.where(n == 2, 3.0, 1.0))
    return [round(float(np.exp(fitted(np.log1p(np.log(n - 1.0))))), 4) for n in KEPT]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--paths", type=int, default=100_000)
    given = parser.parse_args()
    table = []
    for i, (groups, size) in enumerate(GROUPS):
        found = chances(groups, size, given.paths, seed=16_000 + i)
        for rate in RATES:
            ratio = limits(found, rate)
            row = smoothed(ratio)
            table.append({"groups": groups, "size": size, "rate": rate, "ratio": row})
            print(groups, size, rate, " ".join(f"{1 / each:.2f}" for each in row), flush=True)
            print("   counted", " ".join(f"{1 / ratio[n]:.2f}" for n in KEPT), flush=True)
    made = "benchmarks/chart_limits.py"
    head = {"made_by": made, "of_all": OF_ALL, "nights": KEPT, "limits": table}
    text = json.dumps(head).replace("[{", "[\n{").replace("}, {", "},\n{").replace("}]}", "}\n]}")
    TABLE.write_text(f"{text}\n", "utf-8")


if __name__ == "__main__":
    main()
