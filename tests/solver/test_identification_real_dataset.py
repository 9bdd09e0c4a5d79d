"""What the real dataset determines: the paper's figure 8."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import GOLDEN

import gtsam_rwhec as rw

GOLDEN_FIGURE_8 = GOLDEN / "utias_figure_8.txt"


@pytest.fixture(scope="module")
def real(utias_folder: Path) -> rw.Solution:
    return rw.solve(rw.read_csv(utias_folder, sigma=1.0, kappa=1.0))


def figure_8(known: rw.Identifiability, targets: list[str], sensors: list[str]) -> list[str]:
    """A row for each sensor, a column for each target: B blue, unique alone; r red, not; . white, not observed."""
    rows = []
    for sensor in sensors:
        pairs = [known.pairs.get((target, sensor)) for target in targets]
        rows.append(sensor + " " + "".join("." if p is None else "B" if p.is_unique else "r" for p in pairs))
    return rows


def test_the_real_dataset_is_unique(real: rw.Solution) -> None:
    known = real.identifiability
    assert real.certificate.status == "certified"
    assert known.is_unique
    assert known.free_directions == ()
    assert known.weakest > 10.0 * known.threshold
    assert len(known.parts) == 1


def test_figure_8_of_the_real_dataset(real: rw.Solution) -> None:
    targets = sorted(real.X, key=lambda name: int(name[4:]))
    grid = figure_8(real.identifiability, targets, sorted(real.Y))
    assert grid == GOLDEN_FIGURE_8.read_text().splitlines()
    joined = "".join(row.split()[1] for row in grid)
    assert (len(joined) - joined.count(".")) == 73


def test_red_squares_are_motions_in_the_plane(real: rw.Solution, utias_folder: Path) -> None:
    """Read from A itself, without any residual: how far each pair's rotations leave one common axis, in degrees."""
    problem = rw.read_csv(utias_folder, sigma=1.0, kappa=1.0)
    for pair, value in real.identifiability.pairs.items():
        R = problem.measurements(*pair).A[:, :3, :3]
        # The direction that the rotations keep best, and the mean angle by which they tilt it.
        _, s, _ = np.linalg.svd(R.mean(axis=0))
        tilt_deg = np.degrees(np.arccos(min(1.0, s[0])))
        if tilt_deg < 0.2:
            assert not value.is_unique, pair
            assert value.rotation_axes < 2, pair
        if tilt_deg > 3.0 and len(R) >= 10:
            assert value.is_unique, pair
            assert value.rotation_axes == 2, pair


def test_nothing_that_was_not_seen_is_in_the_grid(real: rw.Solution) -> None:
    assert set(real.identifiability.pairs) == set(real.residuals)
    for pair, value in real.identifiability.pairs.items():
        assert value.number_of_measurements == real.residuals[pair].number_of_measurements
        assert value.is_unique is (value.free_directions == ())
