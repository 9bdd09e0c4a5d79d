"""Two LiDARs of a vehicle, by their motions and by what both saw: simulated drives with a known truth.

    python benchmarks/lidars_together.py [--runs 20] [--workers 1]

Each has 16 beams, ranges to 15 mm, points with times, and all its ranges are off alike by 10 mm (a standard deviation).
They drive through a yard of boxes: on a plane; with a sway of 5 degrees in roll and pitch; and on a
plane with LiDARs that see 100 degrees to both sides, one ahead and one back, so that sweeps at one time hardly overlap.
"Elsewhere": the second was in another yard. Nothing else is given. Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import bars
import lidar_drive
import numpy as np
from rwhec_factors import se3
from scipy.special import chdtrc

import gtsam_rwhec as rw
from gtsam_rwhec.clouds import CloudTrack, odometry

LEVEL, LEAST = 0.95, 0.90
#: By kind: degrees of sway, seconds, degrees to both sides, and how many yards.
KINDS = {
    "plane": (0.0, 12.0, 180.0, 1),
    "sway": (5.0, 12.0, 180.0, 1),
    "ahead and back": (0.0, 24.0, 100.0, 1),
    "elsewhere": (0.0, 12.0, 180.0, 2),
}
BIAS_M = 0.010


def tracks_of(kind: str, seed: int) -> tuple[np.ndarray, dict[str, CloudTrack]]:
    """The true T_front_rear, and the tracks of both."""
    sway_deg, seconds, aside_deg, yards = KINDS[kind]
    driven = lidar_drive.driven(seconds, seed, float(np.radians(sway_deg)))
    rng = np.random.default_rng(seed)
    tracks = {}
    for k, sensor in enumerate(lidar_drive.MOUNTS):
        boxes = lidar_drive.yard(driven, seed + 1000 * (k % yards))
        bias_m, of_sweeps = BIAS_M * float(rng.normal()), int(rng.integers(2**31))
        aside_rad = float(np.radians(aside_deg))
        tracks[sensor] = odometry(
            lidar_drive.sweeps(driven, boxes, sensor, of_sweeps, aside_rad=aside_rad, bias_m=bias_m)
        )
    return driven.T("front", "rear"), tracks


def judged(
    truth: np.ndarray, tracks: dict[str, CloudTrack]
) -> tuple[bool, str, float, float, float, rw.odometry.OdometryCalibration]:
    """Whether the clouds are used, the verdict, errors (mm, degrees), and the chance of as large an error or more."""
    found = rw.odometry.calibrate_odometries(
        [rw.odometry.OdometryTrack(name, each.stamps_ns, each.T_start_sensor) for name, each in tracks.items()],
        reference="front",
        maps={name: each.maps for name, each in tracks.items()},
        options=rw.odometry.OdometryOptions(estimate_time_offsets=False),
    )
    error = se3.logmap((np.linalg.inv(truth) @ found.T_reference_sensor["rear"])[None])[0]
    covariance = found.covariance_of("rear")
    is_known = bool(np.isfinite(covariance).all())
    chance = chdtrc(6, float(error @ np.linalg.solve(covariance, error))) if is_known else np.nan
    used = not found.together[0].why_not
    mm, degrees = 1e3 * float(np.linalg.norm(error[3:])), float(np.degrees(np.linalg.norm(error[:3])))
    return used, found.judgement.verdict.value, mm, degrees, float(chance), found


def one(kind: str, seed: int) -> tuple[bool, str, float, float, float]:
    """What `judged` says of one drive."""
    return judged(*tracks_of(kind, seed))[:5]


def rows(runs: int, workers: int) -> list[bars.Row]:
    """All kinds."""
    table = []
    for kind in KINDS:
        results = [each for _, each in bars.each_done(one, [(kind, seed) for seed in range(runs)], workers, kind)]
        used, verdicts, mm, degrees, chance = (np.array(column) for column in zip(*results, strict=True))
        if kind == "elsewhere":
            wrong = int((used & (verdicts == "use")).sum())
            table.append(bars.Row(f"{kind}: clouds used and 'use'", f"{wrong} of {runs}", "0", wrong == 0))
            table.append(bars.Row(f"{kind}: clouds not used", f"{(~used).sum()} of {runs}"))
            continue
        table.append(
            bars.Row(f"{kind}: clouds used, and 'use'", f"{used.sum()}, {(verdicts == 'use').sum()} of {runs}")
        )
        off = f"{np.median(mm[used]):.2g} mm, {np.median(degrees[used]):.2g} deg; most {mm[used].max():.2g} mm"
        table.append(bars.Row(f"{kind}: off by, median", off))
        held = bars.Share.of((chance[used] > 1.0 - LEVEL).tolist())
        what = f"{kind}: 95 % ellipsoids that hold the truth"
        table.append(bars.Row(what, str(held), ">= 90 %", held.meets(LEAST, 1.0)))
    return table


if __name__ == "__main__":
    bars.run_script("LiDARs by what both saw", rows, runs=20, workers=1)
