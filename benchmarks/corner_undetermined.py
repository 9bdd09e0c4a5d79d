"""Refinement from corners of images that do not tell the intrinsics: is it said, and are no more claims made than held?

    python benchmarks/corner_undetermined.py [--runs 60] [--workers 2] [--only WORDS] [--seed 0]

Simulated cells (`tests/fitting/simulated_cells.py`): boards that face their camera almost straight, at one depth, or in
a corner of the image only; stated intrinsics are drawn from the prior of a calibration, or of nominal ones. Parameters
that the images do not tell must be named as held by the prior (or as doubted, with a prior that was widened), and
ellipsoids must hold the truth. Boards that face
their camera straight leave a place free, which must be refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import bars
import numpy as np
import simulated_cells

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.fit_options import Stated

LEVEL, LEAST = 0.95, 0.93


@dataclass(frozen=True)
class Kind:
    """Where the boards are, what is told of intrinsics, which parameters must be named, and whether it is refused."""

    placement: simulated_cells.Placement
    told: Stated
    noisy: bool
    named: tuple[str, ...] = ()
    is_refused: bool = False


def _kinds() -> dict[str, Kind]:
    every = {}
    named = {
        ("nearly fronto-parallel at one depth", "calibration"): ("fx", "fy", "cx", "cy"),
        ("nearly fronto-parallel at one depth", "nominal"): ("fx", "fy"),
        ("in a corner of the image", "calibration"): ("cx", "cy"),
    }
    for told in ("calibration", "nominal"):
        for noisy in (False, True):
            words = f"{told}, A {'noisy' if noisy else 'exact'}"
            every[f"fronto-parallel, {words}"] = Kind(simulated_cells.Placement(tilt=0.0), told, noisy, is_refused=True)
            for name, placement in simulated_cells.UNDETERMINED.items():
                every[f"{name}, {words}"] = Kind(placement, told, noisy, named.get((name, told), ()))
    return every


KINDS = _kinds()


def one(name: str, seed: int) -> dict[str, bool]:
    """One run: what is so."""
    kind = KINDS[name]
    seed += 100_000 * list(KINDS).index(name)
    given = simulated_cells.cell(
        seed, facing=kind.placement, stated=kind.told, carrier=(1e-3, 5e-4) if kind.noisy else (0.0, 0.0)
    )
    options = rw.CornerOptions(stated=kind.told, carrier_noise="estimate" if kind.noisy else "exact")
    try:
        result = given.refined(options, seed=seed)
    except rw.errors.UnderdeterminedError:
        return {"refused": True}
    found = {"refused": False}
    errors = {
        "target": ("board", given.error(result, "board")),
        "sensor": ("cam_0", given.error(result, "cam_0")),
        "intrinsics": (
            "intrinsics:cam_0",
            simulated_cells.CAMERA.parameters - result.intrinsics["cam_0"].camera.parameters,
        ),
    }
    for what, (unknown, error) in errors.items():
        squared = float(error @ np.linalg.solve(result.covariance(unknown), error))
        found[what] = squared < result.squared_radius(unknown, LEVEL)
    if kind.named:  # a prior that was widened, and said to be, holds less
        found["named"] = all(
            camera.widened > 1.0 or set(kind.named) <= set(camera.held_by_prior)
            for camera in result.intrinsics.values()
        )
    found["no deviation above the prior's"] = all(
        (np.sqrt(np.diagonal(camera.covariance)) <= (1.0 + 1e-6) * camera.prior.deviation).all()
        for camera in result.intrinsics.values()
    )
    return found


def rows_of(name: str, found: list[dict[str, bool]]) -> list[bars.Row]:
    """What a kind has in the table."""
    refused = bars.Share.of([each["refused"] for each in found])
    if KINDS[name].is_refused:
        return [bars.Row(f"{name}: refused", str(refused), "100 %", refused.value == 1.0)]
    rows = [bars.Row(f"{name}: refused", str(refused), "0 %", refused.value == 0.0)]
    for what in [what for what in found[0] if what != "refused"]:
        share = bars.Share.of([each[what] for each in found if not each["refused"]])
        is_coverage = what in ("target", "sensor", "intrinsics")
        bar, met = (">= 93 %", share.meets(LEAST, 1.0)) if is_coverage else ("100 %", share.value == 1.0)
        if what == "named":
            what = f"{', '.join(KINDS[name].named)} named as held by the prior, or widened"
        rows.append(bars.Row(f"  {what}", str(share), bar, met))
    return rows


def rows(runs: int, workers: int, seed: int, only: str) -> list[bars.Row]:
    """What is said of all kinds."""
    return [row for pair in bars.runs_of_kinds(one, KINDS, runs, workers, seed, only) for row in rows_of(*pair)]


if __name__ == "__main__":
    bars.run_script("intrinsics that the images do not tell", rows, runs=60, workers=2, seed=0, only="")
