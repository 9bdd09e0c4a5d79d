"""Six odometries calibrated at once: errors against the Cramer-Rao bound, and covariances against errors.

    python benchmarks/odometry_bounds.py [--runs 40] [--seconds 120] [--outliers 0] [--one-clock]

Three LiDARs and three cameras of unknown scale, clocks up to 0.3 s apart, no noise stated: a drive in 3 D, and one on a
plane with a height (2 cm) for each sensor. The bound is that of all steps as simulated, with the vehicle's motion, the
clocks and the ground as nuisances. Exits with 1 where a root mean square is above 1.1 times the bound, or where
95 % ellipsoids of the sensors do not hold the truth as often as they say.
"""

from __future__ import annotations

import time

import numpy as np
import odometry_drives
from bars import Row, Share, run_script
from scipy.special import chdtri

from gtsam_rwhec.simulate.drives import DriveShape

BAR = 1.1
LEVEL = 0.95
#: By row: the shape, and whether heights are given.
CASES: dict[str, tuple[DriveShape, bool]] = {"3 D": ("3d", False), "planar, a height each": ("planar", True)}


def rows(runs: int, seconds: float, outliers: float, one_clock: bool) -> list[Row]:
    """Errors and shares of each case."""
    result = []
    for what, (shape, heights) in CASES.items():
        begun = time.process_time()
        done = [
            odometry_drives.run(shape, seconds, seed, heights=heights, outliers=outliers, clocks=not one_clock)
            for seed in range(runs)
        ]
        each = (time.process_time() - begun) / runs
        sensors = len(done[0].found.order)
        turns = np.r_[np.tile(np.r_[np.ones(3, bool), np.zeros(3, bool)], sensors), np.zeros(3, bool)]
        shifts = np.r_[np.tile(np.r_[np.zeros(3, bool), np.ones(3, bool)], sensors), np.zeros(3, bool)]
        for name, part, unit in (
            ("rotations", turns, "deg"),
            ("translations", shifts, "mm"),
            ("scales", ~(turns | shifts), "%"),
        ):
            # In units of the bound, so that each number of each drive counts alike.
            square = np.mean([(run.error[part] ** 2 / np.diagonal(run.bound)[part]).mean() for run in done])
            size = np.sqrt(np.mean([(run.error[part] ** 2).mean() for run in done]))
            size *= {"deg": np.degrees(1.0), "mm": 1e3, "%": 100.0}[unit]
            ratio = float(np.sqrt(square))
            text = f"{ratio:.3f}x ({size:.3g} {unit})"
            result.append(Row(f"{what}: {name}, error over the bound", text, f"<= {BAR}x", ratio <= BAR))
        held = [
            bool(e @ np.linalg.solve(run.found.covariance_of(name), e) <= chdtri(6.0, 1.0 - LEVEL))
            for run in done
            for name, e in zip(run.found.order, run.error[: 6 * sensors].reshape(-1, 6), strict=True)
        ]
        share = Share.of(held)
        # A drive's sensors share their reference: about two of five are independent.
        met = Share(2 * sum(held) // 5, 2 * len(held) // 5).meets(0.93, 0.97)
        result.append(Row("  95 % ellipsoids of poses that hold the truth", f"{share}", "93 to 97 %", met))
        certified = sum(run.found.certificate.is_optimal for run in done)
        result.append(Row("  certified", f"{certified} of {runs}", "all", certified == runs))
        named = sum(bool(run.found.free_directions) for run in done)
        result.append(Row("  drives with a direction falsely named free", f"{named} of {runs}", "0", named == 0))
        result.append(Row("  seconds of the processor a drive, simulation included", f"{each:.2f} s"))
    return result


if __name__ == "__main__":
    run_script("six odometries", rows, runs=40, seconds=120.0, outliers=0.0, one_clock=False)
