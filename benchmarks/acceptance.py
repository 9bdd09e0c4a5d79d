"""How often ``rw.accept`` accepts a calibration that is off by the limit, and how many touches a good one needs.

    python benchmarks/acceptance.py [--runs 1000] [--seed 0] [--workers 1] [--layout WORDS]

A camera 0.6 m away sees points of a box of 0.4 x 0.3 x 0.2 m, which are touched. Its pose is off so that the largest
error in the volume is exactly the limit, 1 mm: by a translation, by a rotation, or by a rotation and translation that
move one corner along the line of sight, where a camera is noisiest. Each is simulated ``--runs`` times for each layout,
the rotations at a small and a larger noise. The layouts differ in the number of touches (3 to 20), the volume (the box
around the touches, a ball, a box that is larger than the touches, a volume above touches that lie in a plane), in
whether the noise is estimated or stated, alike in all directions or three times as large along the line of sight, in
whether a scale is unknown too, and in views of a board whose place is unknown in place of touches. For each layout the
row has the cell (error and noise) with most false acceptances, whose interval is corrected for the number of cells.

Then the power: calibrations that are off by a third of the limit, by the number of touches and the noise; and of those
that were not accepted after 5 touches the share that is after as many more as the answer asks for, all tested together.
Who does this tests twice: the last rows have how often a calibration that is off by the limit is accepted so.

Exits with 1 if false acceptances exceed 5 % by more than chance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from bars import Row, Share, each_done, run_script
from numpy.typing import NDArray

import gtsam_rwhec as rw
from gtsam_rwhec.results import Answer, Result, Touches, Volume
from gtsam_rwhec.simulate.simulated_noise import Noise, random_poses
from gtsam_rwhec.simulate.simulated_rigs import Motion, carrier_poses, general

FloatArray = NDArray[np.float64]
LIMIT_MM, LEVEL = 1.0, 0.95
BOX, AWAY = np.array([0.4, 0.3, 0.2]), np.array([0.0, 0.0, 0.6])
#: Errors, and the standard deviation of a touch along each axis, mm.
CELLS = (("translation", 0.02), ("rotation", 0.02), ("rotation", 0.2), ("depth", 0.02), ("depth", 0.2))
ERRORS = ("translation", "rotation", "depth")
#: Of all rows together the share that misses its bar by chance.
BY_CHANCE = 0.01
#: Numbers of touches, and noises in mm, of the power; the share of runs that "most" means.
COUNTS, POWER_MM, MOST = (3, 4, 5, 6, 8, 10, 12, 16, 20, 30), (0.1, 0.2, 0.3), 0.8
#: Nobody touches more than this many points besides.
MOST_MORE = 100


@dataclass(frozen=True)
class Layout:
    """How a calibration is touched."""

    count: int
    volume: str = "around"  #: "around", "ball", "larger" or "above"
    is_flat: bool = False  #: Whether all touches lie in a plane
    along: float = 1.0  #: Noise along the line of sight over that across it
    is_stated: bool = False
    has_scale: bool = False
    is_of_views: bool = False


LAYOUTS: Mapping[str, Layout] = {
    "3 touches": Layout(3),
    "4 touches": Layout(4),
    "5 touches": Layout(5),
    "10 touches": Layout(10),
    "20 touches": Layout(20),
    "5 touches, ball": Layout(5, "ball"),
    "8 touches, larger box": Layout(8, "larger"),
    "6 touches in a plane": Layout(6, is_flat=True),
    "8 touches in a plane, box above": Layout(8, "above", is_flat=True),
    "4 touches, depth noise x3": Layout(4, along=3.0),
    "6 touches, depth noise x3": Layout(6, along=3.0),
    "12 touches, depth noise x3": Layout(12, along=3.0),
    "12 touches, depth noise /3": Layout(12, along=1.0 / 3.0),
    "3 touches, noise stated": Layout(3, is_stated=True),
    "5 touches, depth noise x3 stated": Layout(5, along=3.0, is_stated=True),
    "8 touches, scale unknown": Layout(8, has_scale=True),
    "8 views of a board": Layout(8, is_of_views=True),
    "20 views of a board, depth noise x3": Layout(20, along=3.0, is_of_views=True),
}
_calibrated: dict[bool, Result] = {}


def calibrated(has_scale: bool) -> Result:
    """A calibration of one camera; its errors do not matter, since what is touched follows from its poses."""
    if has_scale not in _calibrated:
        problem = general(1, 1, seed=0, noise=Noise(sigma_m=0.001, kappa=1e5)).problem
        given = rw.Problem("shared" if has_scale else "known")
        for pair in problem.pairs:
            one = problem.measurements(*pair)
            given.add(*pair, one.A, one.B, 0.001, 1e5)
        options = rw.CalibrateOptions(noise="given", robust="none", misreadings=False)
        answer = rw.calibrate(given, options)
        assert answer.solution is not None
        _calibrated[has_scale] = Result(answer.solution, answer.refined, None)
    return _calibrated[has_scale]


def touched(
    layout: Layout, error: str, size_mm: float, noise_mm: float, count: int, seed: list[int]
) -> rw.results.Acceptance:
    """The answer for a calibration whose largest error in the volume is ``size_mm``."""
    # More touches begin with the same ones: the rows of each array are drawn one after the other.
    of_points, of_error, of_noise = (np.random.default_rng([*seed, i]) for i in range(3))
    result = calibrated(layout.has_scale)
    answer = result.refined
    assert answer is not None
    (sensor,) = answer.Y
    T = answer.Y[sensor].matrix()
    seen = (of_points.random((count, 3)) - 0.5) * BOX * (1.0, 1.0, 0.0 if layout.is_flat else 1.0) + AWAY
    exact = seen @ T[:3, :3].T + T[:3, 3]
    first = exact[: layout.count]
    centre, radius = first.mean(axis=0), 0.25
    volume = None
    if layout.volume == "ball":
        volume = Volume.ball(centre, radius)
    elif layout.volume == "larger":
        volume = Volume.box(centre - 0.3, centre + 0.3)
    elif layout.volume == "above":
        lifted = centre - 0.1 * T[:3, 2]
        volume = Volume.box(lifted - 0.1, lifted + 0.1)
    where = volume or Volume.box(first.min(axis=0), first.max(axis=0))
    volume = volume if count == layout.count else where
    omega, v, s = off_by(error, size_mm, where, T, of_error, has_scale=layout.has_scale)
    middle = np.array(where.centre_m)
    sight = (exact - T[:3, 3]) / np.linalg.norm(exact - T[:3, 3], axis=1)[:, None]
    noise = 1e-3 * noise_mm * of_noise.standard_normal((count, 3))
    noise += (layout.along - 1.0) * np.einsum("ni,ni->n", noise, sight)[:, None] * sight
    known = exact - (np.cross(omega, exact - middle) + v + s * (exact - middle)) + noise
    stated = (noise_mm, layout.along * noise_mm) if layout.is_stated else None
    options = {"limit_mm": LIMIT_MM, "level": LEVEL, "noise_mm": stated}
    if not layout.is_of_views:
        scale = float(answer.scale) if not isinstance(answer.scale, dict) else 1.0
        return rw.accept(result, Touches.of(seen * scale, known), volume=volume, **options)
    # A board at known[i] in the frame of the sensor's carrier: the targets' carrier is where this makes it be.
    A = carrier_poses(Motion("general"), count, of_points)
    board = random_poses(1, 0.5, of_points)[0]
    A[:, :3, 3] = known - np.einsum("nij,j->ni", A[:, :3, :3], board[:3, 3])
    B = random_poses(count, 0.1, of_points)
    B[:, :3, 3] = seen
    problem = rw.Problem()
    problem.add("new board", sensor, A, B)
    return rw.accept(result, problem, volume=where, **options)


def off_by(
    error: str, size_mm: float, where: Volume, T: FloatArray, generator: np.random.Generator, *, has_scale: bool
) -> tuple[FloatArray, FloatArray, float]:
    """An error [omega, v, s] about the middle of a volume, of which it moves the worst corner by ``size_mm``."""
    omega, v, s = np.zeros(3), np.zeros(3), 0.0
    if error != "translation":
        omega = generator.standard_normal(3)
    if error == "translation":
        v = generator.standard_normal(3)
    elif error == "depth":  # about axes across the sight, and along it
        omega -= (omega @ T[:3, 2]) * T[:3, 2]
        v = 0.1 * T[:3, 2]
    if has_scale:
        s = generator.standard_normal()
    levers = rows_of(where) - np.array(where.centre_m)
    most = np.linalg.norm(np.cross(omega, levers) + v + s * levers, axis=1).max()
    factor = 1e-3 * size_mm / most
    return factor * omega, factor * v, factor * s


def rows_of(where: Volume) -> FloatArray:
    """Corners of a box; points of a ball's sphere itself, which the corners of its test lie beyond."""
    if where.shape == "box":
        return where.corners_m
    corners = where.corners_m - np.array(where.centre_m)
    return np.array(where.centre_m) + where.half_m[0] * corners / np.linalg.norm(corners, axis=1)[:, None]


def accepted(name: str, error: str, noise_mm: float, runs: int, seed: int) -> list[bool]:
    """Of one cell, which calibrations that are off by the limit are accepted."""
    layout = LAYOUTS[name]
    cell = [seed, list(LAYOUTS).index(name), CELLS.index((error, noise_mm))]
    found = (touched(layout, error, LIMIT_MM, noise_mm, layout.count, [*cell, i]) for i in range(runs))
    return [one.answer is Answer.ACCEPTED for one in found]


def power(count: int, noise_mm: float, runs: int, seed: int) -> list[bool]:
    """Which calibrations that are off by a third of the limit are accepted."""
    kinds = [ERRORS[i % len(ERRORS)] for i in range(runs)]
    found = (
        touched(Layout(count), kind, LIMIT_MM / 3.0, noise_mm, count, [seed, 99, count, i])
        for i, kind in enumerate(kinds)
    )
    return [one.answer is Answer.ACCEPTED for one in found]


def tested_twice(size_mm: float, noise_mm: float, runs: int, seed: int) -> tuple[int, list[int], list[bool]]:
    """How many calibrations are accepted with 5 touches; of those that ask for more, how many, and with what answer.

    All touches are tested together then, those of the first time too.
    """
    at_once, asked, done = 0, [], []
    for i in range(runs):
        first = touched(Layout(5), "depth", size_mm, noise_mm, 5, [seed, 98, i])
        at_once += first.answer is Answer.ACCEPTED
        if first.answer is Answer.NOT_YET and first.more is not None and first.more <= MOST_MORE:
            asked.append(first.more)
            again = touched(Layout(5), "depth", size_mm, noise_mm, 5 + first.more, [seed, 98, i])
            done.append(again.answer is Answer.ACCEPTED)
    return at_once, asked, done


def rows(runs: int, seed: int, workers: int, layout: str) -> list[Row]:
    """The shares against the bar."""
    names = [name for name in LAYOUTS if layout in name]
    cells = [(name, error, noise, runs, seed) for name in names for error, noise in CELLS]
    found = {cell[:3]: Share.of(done) for cell, done in each_done(accepted, cells, workers, "cells")}
    result = []
    for name in names:
        own = {cell: share for cell, share in found.items() if cell[0] == name}
        (_, error, noise), worst = max(own.items(), key=lambda item: item[1].value)
        met = worst.meets(0.0, 1.0 - LEVEL, 1.0 - BY_CHANCE / len(cells))
        figure = f"{worst} ({error}, {noise:g} mm)"
        result.append(Row(f"false acceptances: {name}", figure, f"<= {100 * (1 - LEVEL):g} %", met))
    if layout:
        return result
    calls = [(count, noise, runs, seed) for noise, count in product(POWER_MM, COUNTS)]
    shares = {call[:2]: Share.of(done) for call, done in each_done(power, calls, workers, "power")}
    for noise in POWER_MM:
        said = ", ".join(f"{count}: {100 * shares[count, noise].value:.0f}" for count in COUNTS)
        enough = next((str(count) for count in COUNTS if shares[count, noise].value >= MOST), f"> {COUNTS[-1]}")
        result.append(Row(f"off by a third of the limit, noise {noise:g} mm: % accepted by touches", said))
        result.append(Row(f"    touches for {100 * MOST:g} %", enough))
    calls = [(size, noise, runs, seed) for size, noise in product((LIMIT_MM / 3.0, LIMIT_MM), POWER_MM)]
    for (size, noise, *_), (at_once, asked, done) in each_done(tested_twice, calls, workers, "tested twice"):
        if size < LIMIT_MM:
            more = f"{Share.of(done)}, median {np.median(asked):.0f} more" if asked else "none"
            result.append(
                Row(f"noise {noise:g} mm: of those that ask for more after 5 touches, accepted after them", more)
            )
        else:
            twice = Share(at_once + sum(done), runs)
            result.append(
                Row(f"noise {noise:g} mm: off by the limit, 5 touches and as many more as asked for", str(twice))
            )
    return result


if __name__ == "__main__":
    run_script(
        "Acceptance: false acceptances at the limit, {runs} runs of each cell",
        rows,
        runs=1000,
        seed=0,
        workers=1,
        layout="",
    )
