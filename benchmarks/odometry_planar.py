"""Planar drives without heights: are the free directions named, and are none named falsely?

    python benchmarks/odometry_planar.py [--runs 200] [--seconds 60]

Six odometries (three of unknown scale). On a plane the height of each sensor over the first is free, and nothing else.
In 3 D nothing is. Exits with 1 where one of the planar drives says less or more, or one of the others anything.
"""

from __future__ import annotations

import numpy as np
import odometry_drives
from bars import Row, run_script

from gtsam_rwhec import odometry

#: A free shift is along the plane's normal within this cosine.
ALONG = 0.99


def is_right(found: odometry.OdometryCalibration) -> bool:
    """Whether exactly the height of each sensor but the reference is named free."""
    named = set()
    for free in found.free_directions:
        for name, twist in free.frames.items():
            shift = found.T_reference_sensor[name][:3, :3] @ np.array(twist[3:])
            if np.linalg.norm(twist[:3]) > 0.05 or abs(shift[2]) < ALONG * np.linalg.norm(shift):
                return False
            named.add(name)
    return named == set(found.order) and len(found.free_directions) == len(found.order)


def rows(runs: int, seconds: float) -> list[Row]:
    """How many are right."""
    planar = [odometry_drives.run("planar", seconds, seed, clocks=False) for seed in range(runs)]
    hilly = [odometry_drives.run("3d", seconds, seed, clocks=False) for seed in range(runs)]
    right = sum(is_right(run.found) for run in planar)
    false = sum(bool(run.found.free_directions) for run in hilly)
    certified = sum(run.found.certificate.is_optimal for run in planar + hilly)
    return [
        Row("planar drives that name the heights, and nothing else", f"{right} of {runs}", "all", right == runs),
        Row("3 D drives that name something falsely", f"{false} of {runs}", "0", false == 0),
        Row("certified", f"{certified} of {2 * runs}", "all", certified == 2 * runs),
    ]


if __name__ == "__main__":
    run_script("planar odometries", rows, runs=200, seconds=60.0)
