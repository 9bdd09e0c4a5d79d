"""Refinement from corners with stated intrinsics that are wrong: do the 95 % ellipsoids of extrinsics hold the truth?

    python benchmarks/corner_wrong_intrinsics.py [--runs 400] [--workers 2] [--only WORDS] [--seed 0]

Simulated cells (`tests/fitting/simulated_cells.py`): two fixed cameras, a board on the hand, corners with 0.1
pixels of noise. Strong geometry is a board of 7 x 5 corners, 1.5 m away, tilted by 20 degrees and more, in 30 images;
weak geometry a board of 4 x 3 corners, 2 m away, tilted by 6 degrees, at the middle of 40 images. The stated centre
is off by 0, 10 or 30 pixels in a random direction, the focal length by 0 or 2 % either way, or the lens's distortion
(k1 = -0.1, k2 = 0.05: 50 pixels at the corner of the image) is left out. Stated intrinsics are told to be nominal; or
from a calibration, which must then be flagged as wrong where the images tell, or be named as held by the prior.

How far off stated intrinsics are in innovation deviations is told by the truth: an offset d of a part of the parameters
with the prior P and the posterior C would, without noise, show as m = (P - C) P^-1 d, which has sqrt(m' (P - C)^-1 m).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import bars
import numpy as np
import simulated_cells

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.fitting.corners_refined import RefinedIntrinsics
from gtsam_rwhec.fitting.fit_options import Stated
from gtsam_rwhec.fitting.stated_intrinsics import PARTS, TOLD, free_model, prior_of

LEVEL, LEAST = 0.95, 0.93
#: Beyond so many innovation deviations a contradiction must be flagged in this share of runs; falsely in so many.
FAR, FLAGGED, FALSELY = 5.0, 0.95, 0.01
SMALL_BOARD = Checkerboard("board", 4, 3, 0.03)


@dataclass(frozen=True)
class Kind:
    """What is wrong with the stated intrinsics, and what is told of them."""

    told: Stated
    centre_px: float = 0.0
    focal_share: float = 0.0
    without_distortion: bool = False
    drawn: bool = False
    noisy: bool = False

    @property
    def wrong(self) -> tuple[str, ...]:
        """The parameters that are off."""
        return (
            *(("fx", "fy") if self.focal_share or self.drawn else ()),
            *(("cx", "cy") if self.centre_px or self.drawn else ()),
            *(("k1", "k2") if self.without_distortion or self.drawn else ()),
        )


def _kinds() -> dict[str, Kind]:
    off = {
        f"c off by {centre:g} px, f by {share:.0%}": {"centre_px": centre, "focal_share": share}
        for centre in (0.0, 10.0, 30.0)
        for share in (0.0, 0.02)
    }
    kinds = {f"nominal, {words}": Kind("nominal", **wrong) for words, wrong in off.items()}
    kinds["nominal, distortion left out"] = Kind("nominal", without_distortion=True)
    kinds |= {f"{words}, A noisy": replace(kind, noisy=True) for words, kind in kinds.items()}
    kinds["nominal, drawn from the prior"] = Kind("nominal", drawn=True)
    for words, kind in {
        "drawn from the prior": Kind("calibration", drawn=True),
        "c off by 10 px": Kind("calibration", centre_px=10.0),
        "c off by 30 px": Kind("calibration", centre_px=30.0),
        "f off by 2%": Kind("calibration", focal_share=0.02),
        "distortion left out": Kind("calibration", without_distortion=True),
    }.items():
        kinds[f"calibration, {words}"] = kind
        kinds[f"calibration, {words}, A noisy"] = replace(kind, noisy=True)
    return kinds


KINDS = _kinds()
GEOMETRIES = ("strong", "weak")


def cell_of(geometry: str, name: str, seed: int) -> simulated_cells.Cell:
    """A cell whose stated intrinsics are wrong; each kind has cells of its own."""
    seed += 100_000 * list(KINDS).index(name)
    kind = KINDS[name]
    rng = np.random.default_rng([seed, 1])
    f = simulated_cells.CAMERA.K[0, 0]
    off = np.zeros(len(simulated_cells.CAMERA.parameters))
    angle = rng.uniform(-np.pi, np.pi)
    off[:2] = kind.focal_share * f * rng.choice([-1.0, 1.0])
    off[2:4] = kind.centre_px * np.array([np.cos(angle), np.sin(angle)])
    given = simulated_cells.cell(
        seed,
        stated=kind.told if kind.drawn else None,
        stated_off=off,
        carrier=(1e-3, 5e-4) if kind.noisy else (0.0, 0.0),
        **({"images": 40, "board": SMALL_BOARD, "facing": simulated_cells.WEAK} if geometry == "weak" else {}),
    )
    if not kind.without_distortion:
        return given
    pinholes = {
        name: Camera(camera.width, camera.height, "pinhole", camera.K, np.zeros(0))
        for name, camera in given.observations.cameras.items()
    }
    return replace(given, observations=replace(given.observations, cameras=pinholes))


@dataclass(frozen=True)
class Found:
    """Of one run: which ellipsoids hold the truth, by frame; of each camera what is told and said."""

    inside: dict[str, bool]
    flagged: dict[str, bool]
    innovation: dict[str, float]
    held: dict[str, bool]

    def named(self, frame: str) -> bool:
        """Whether parameters that are off are named as held by the prior: of the sensor, or of any for a target."""
        return self.held.get(frame, any(self.held.values()))


def one(case: str, seed: int) -> Found:
    """One run."""
    geometry, name = case.split(": ")
    kind = KINDS[name]
    given = cell_of(geometry, name, seed)
    options = rw.CornerOptions(stated=kind.told, carrier_noise="estimate" if kind.noisy else "exact")
    result = given.refined(options, seed=seed)
    frames = (*given.X, *given.Y)
    inside = {name: given.squared_error(result, name) < result.squared_radius(name, LEVEL) for name in frames}
    stated = given.observations.cameras
    return Found(
        inside,
        {sensor: camera.innovation.is_contradicted for sensor, camera in result.intrinsics.items()},
        {sensor: _told_deviations(camera, stated[sensor], kind.told) for sensor, camera in result.intrinsics.items()},
        {sensor: any(n in kind.wrong for n in camera.held_by_prior) for sensor, camera in result.intrinsics.items()},
    )


def _told_deviations(refined: RefinedIntrinsics, stated: Camera, told: Stated) -> float:
    """How far off stated intrinsics are, of what the images tell: the worst part's innovation deviations."""
    prior = prior_of(free_model(stated, told), told)
    truth = simulated_cells.CAMERA.parameters
    # the posterior had the prior not been widened
    information = np.linalg.inv(refined.covariance) + prior.precision - refined.prior.precision
    gain = np.eye(len(truth)) - prior.root @ np.linalg.inv(information) @ prior.root.T
    shown = gain @ (prior.root @ (truth - prior.mean))
    worst = 0.0
    for at in PARTS.values():
        values, vectors = np.linalg.eigh(gain[at, at])
        is_told = values > TOLD
        worst = max(worst, float(((vectors.T @ shown[at])[is_told] ** 2 / values[is_told]).sum()))
    return float(np.sqrt(worst))


def rows_of(name: str, found: list[Found]) -> list[bars.Row]:
    """What a cell of the table has."""
    kind, rows = KINDS[name.split(": ")[1]], []
    is_right = kind.drawn or not kind.wrong
    of_calibration = kind.told == "calibration" and not is_right
    for what in ("target", "sensors"):
        frames = [(each, frame) for each in found for frame in each.inside if (frame == "board") == (what == "target")]
        share = bars.Share.of([each.inside[frame] for each, frame in frames])
        unless = bars.Share.of([each.inside[frame] or each.named(frame) for each, frame in frames])
        figure = f"{share}; or named {100 * unless.value:.1f} %" if of_calibration else str(share)
        bar = ">= 93 %" + (", or held by the prior" if of_calibration else "")
        rows.append(bars.Row(f"{name}: {what}", figure, bar, (unless if of_calibration else share).meets(LEAST, 1.0)))
    flags = np.array([flag for each in found for flag in each.flagged.values()])
    deviations = np.array([deviation for each in found for deviation in each.innovation.values()])
    if is_right:
        share = bars.Share.of(flags.tolist())
        rows.append(bars.Row("  flagged falsely", str(share), "<= 1 %", share.meets(0.0, FALSELY)))
    elif (deviations > FAR).any():
        share = bars.Share.of(flags[deviations > FAR].tolist())
        rows.append(bars.Row("  flagged beyond 5 deviations", str(share), ">= 95 %", share.meets(FLAGGED, 1.0)))
    held = np.mean([any(each.held.values()) for each in found])
    figure = f"{100 * flags.mean():.0f} %; {np.median(deviations):.2g}; {100 * held:.0f} %"
    rows.append(bars.Row("  flagged; median of innovation's deviations; named as held", figure))
    return rows


def rows(runs: int, workers: int, seed: int, only: str) -> list[bars.Row]:
    """All kinds in both geometries."""
    names = [f"{geometry}: {kind}" for kind in KINDS for geometry in GEOMETRIES]
    return [row for pair in bars.runs_of_kinds(one, names, runs, workers, seed, only) for row in rows_of(*pair)]


if __name__ == "__main__":
    bars.run_script("95 % ellipsoids where stated intrinsics are wrong", rows, runs=400, workers=2, seed=0, only="")
