"""LiDAR and camera by one board: simulated places with a known truth, and 40 real ones of other people.

    python benchmarks/lidar_camera.py [--runs 300] [--biased 60] [--splits 20] [--workers 2]

Simulated (`gtsam_rwhec/simulate/lidar_scenes.py`): 16 beams, ranges to 15 mm, a divergence of 3 mrad with mixed pixels,
a room, a board of 0.6 x 0.85 m on a stand in 10 or 3 places 1.5 to 3 m away, found without a start; the camera's poses
by corners to 0.2 px. Each run has its own poses. The LiDAR's and the camera's covariances are taken as they are stated.
"Biased": each beam measures 5 mm (standard deviation) too far or too near, always.

Real (`lidar_board/poses.csv` beside the checkout, or in the folder that GTSAM_RWHEC_DATA names): halves of 20 places
drawn at random, of which each must hold the other's answer in its own 95 % ellipsoid. Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import os

import bars
import numpy as np
from board_places import halves_of, places_of
from rwhec_factors.se3 import inverse

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import SimulatedLidar, frame_distance, lidar_places

LEVEL, LEAST, MOST = 0.95, 0.93, 0.97
#: By kind: places, standard deviation of a beam's bias (m), and the bars: mm and degrees, of the median or of each.
KINDS = {"10 places": (10, 0.0), "3 places": (3, 0.0), "10 places, biased beams": (10, 0.005)}
#: An answer that is off by more than this must be named as weak: half its claimed 95 % extent is as long.
WEAK_MM, WEAK_DEG = 10.0, 0.3


def one(kind: str, seed: int) -> tuple[float, float, bool, bool, float, float]:
    """Errors (mm, degrees), whether the ellipsoid holds the truth, whether it was certified, and claimed bounds."""
    count, bias_m = KINDS[kind]
    places = lidar_places(count, seed, lidar=SimulatedLidar(bias_m=bias_m))
    seen = rw.clouds.seen_boards(places.clouds, places.size_m)
    problem = rw.clouds.lidar_and_camera(
        places.T_camera_board, seen.T_sensor_board, places.size_m, seen.covariances,
        camera_covariances=places.covariances, common_m=seen.common_m,
    )  # fmt: skip
    found = rw.calibrate(problem, rw.CalibrateOptions(noise="given"))
    away = frame_distance(found.Y["lidar"].matrix(), places.T_camera_lidar)
    deviations = np.sqrt(np.diagonal(found.covariance("lidar")))
    bounds = found.squared_radius(3, LEVEL) ** 0.5 * np.array(
        [np.degrees(deviations[:3].max()), 1e3 * deviations[3:].max()]
    )
    return (
        away.translation_mm, away.rotation_deg, bool(found.contains("lidar", places.T_camera_lidar, LEVEL)),
        found.solution.certificate.status is rw.Status.CERTIFIED, float(bounds[1]), float(bounds[0]),
    )  # fmt: skip


def simulated(kind: str, runs: int, workers: int) -> list[bars.Row]:
    """Rows of one kind."""
    calls = [(kind, seed) for seed in range(runs)]
    results = [result for _, result in bars.each_done(one, calls, workers, kind)]
    mm, degrees, held, certified, bound_mm, bound_deg = (np.array(column) for column in zip(*results, strict=True))
    rows = [bars.Row(f"{kind}: certified", f"{certified.sum()} of {runs}", "all", bool(certified.all()))]
    if kind == "3 places":
        wrong = (mm > np.maximum(WEAK_MM, bound_mm)) | (degrees > np.maximum(WEAK_DEG, bound_deg))
        figure = f"{wrong.sum()} of {runs}; most {mm.max():.1f} mm, {degrees.max():.2f} deg"
        rows.append(bars.Row(f"{kind}: off by > 10 mm or 0.3 deg and not said", figure, "0", not wrong.any()))
    most = (3.0, 0.1) if kind == "10 places" else (None, None)
    rows.append(bars.at_most(f"{kind}: translation, median", float(np.median(mm)), most[0], " mm"))
    rows.append(bars.at_most(f"{kind}: rotation, median", float(np.median(degrees)), most[1], " deg"))
    share = bars.Share.of(held.tolist())
    met = share.meets(LEAST, MOST) if kind == "10 places" else None
    rows.append(
        bars.Row(
            f"{kind}: 95 % ellipsoids that hold the truth", str(share), "95 +- 2 %" if met is not None else "", met
        )
    )
    return rows


def real(splits: int) -> list[bars.Row]:
    """Rows of the 40 real places."""
    A, B = places_of(bars.SHARED / "lidar_board" / "poses.csv")
    whole = halves_of(A, B, np.arange(len(A)))
    t = 1e3 * inverse(whole.Y["lidar"].matrix()[None])[0, :3, 3]
    sigma = 1e3 * np.sqrt(np.diagonal(whole.covariance("lidar")))[3:]
    status, apart, both = [whole.solution.certificate.status], [], []
    for seed in range(splits):
        order = np.random.default_rng(seed).permutation(len(A))
        halves = [halves_of(A, B, np.sort(part)) for part in (order[:20], order[20:])]
        status += [half.solution.certificate.status for half in halves]
        Y = [half.Y["lidar"].matrix() for half in halves]
        apart.append(frame_distance(*Y))
        both.append(all(half.contains("lidar", other, LEVEL) for half, other in zip(halves, Y[::-1], strict=True)))
    distance = (
        f"{np.median([d.translation_mm for d in apart]):.1f} mm, {np.median([d.rotation_deg for d in apart]):.2f} deg"
    )
    verdict = whole.verdict.name
    good = all(each is rw.Status.CERTIFIED for each in status)
    return [
        bars.Row("40 real places: t of T_lidar_camera", f"{np.round(t, 1)} +- {np.round(sigma, 1)} mm, {verdict}"),
        bars.Row("    certified, with all halves", str(good), "all", good),
        bars.Row(
            "    halves each in the other's 95 % ellipsoid", f"{sum(both)} of {splits}; median apart {distance}",
            ">= 95 %", sum(both) >= 0.95 * splits,
        ),
    ]  # fmt: skip


def rows(runs: int, biased: int, splits: int, workers: int) -> list[bars.Row]:
    """All kinds, and the real places."""
    table = [row for kind in KINDS for row in simulated(kind, biased if "biased" in kind else runs, workers)]
    return table + real(splits) if (bars.SHARED / "lidar_board").is_dir() else table


if __name__ == "__main__":
    bars.run_script("LiDAR and camera", rows, runs=300, biased=60, splits=20, workers=os.cpu_count() or 1)
