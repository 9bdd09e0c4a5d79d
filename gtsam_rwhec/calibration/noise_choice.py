"""By which model the noise is found, and the inliers under it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.calibration.noise_found import NoiseFound
from gtsam_rwhec.calibration.options import CalibrateOptions
from gtsam_rwhec.errors import CountError, NoiseError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.fitting.fit_options import CarrierNoise, Component, NoiseOptions, RefineOptions
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.fitting.noise_refinement import under_noise
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution

#: Inliers are chosen again under the noise that is found at most this many times.
MAX_CHOICES = 4

Inliers = dict[Pair, np.ndarray]


def estimated(
    problem: Problem, solution: Solution, inliers: Inliers, options: CalibrateOptions, progress: Progress
) -> tuple[Refined, NoiseFound, Inliers]:
    """The refined calibration of the inliers under the noise that is found, a record of this noise, and the inliers.

    Inliers are chosen again under the noise that is found, until they stay the same.

    ``inliers`` is empty where every measurement counts; ``solution`` is the certified one of the inliers. The one place
    that decides by which model the noise is found: the whole model of ``noise_model``; where that has too few
    measurements, or too many, or noise is given or wanted by groups, ``refine`` with the noise of B alone.

    Raises
    ------
    NoiseError, CountError
        The measurements are too few for the noise.
    """
    kept = selected(problem, inliers) if inliers else problem
    how = RefineOptions(
        noise="given" if options.noise == "given" else "estimate",
        noise_groups=options.noise_groups,
        residual="geodesic" if problem.has_measurements else "chordal",
        carrier_noise=options.carrier_noise,
        time_offsets=offsets_of(kept, options),
        carrier_path=options.carrier_path if offsets_of(kept, options) else None,
    )
    why, failed = "a model of all noise was not asked for", False
    if not problem.has_measurements:
        why = "the raw measurements were not kept"
    is_whole = options.noise != "given" and options.noise_groups == "all" and _is_plain(options.carrier_noise)
    if is_whole and problem.has_measurements:
        try:
            return _by_the_whole_model(problem, solution, how, options, inliers, progress)
        except CountError as error:
            why = str(error)
        except (np.linalg.LinAlgError, RuntimeError) as error:  # noises many orders apart, in LAPACK or in GTSAM
            why, failed = f"that of A and B together could not be computed ({error})", True
    try:
        refined = refine(kept, solution, how, progress=progress)
    except NoiseError as error:
        if options.noise == "auto" and not problem.is_relative:
            refined = refine(kept, solution, replace(how, noise="given"), progress=progress)
        elif options.noise != "given" and options.carrier_noise is not None:  # it is more than the residuals hold
            why, failed = f"the noise that was stated for A was not used: {error}", True
            options = replace(options, carrier_noise=None)
            refined = refine(kept, solution, replace(how, carrier_noise=None), progress=progress)
        else:
            raise
    counts = {pair: (int(mask.sum()), len(mask)) for pair, mask in inliers.items()}
    noise = replace(_noise_of(refined, options, None, why), has_failed=failed)
    return replace(refined, inliers=inliers, inlier_counts=counts), noise, inliers


def _by_the_whole_model(
    problem: Problem,
    solution: Solution,
    how: RefineOptions,
    options: CalibrateOptions,
    inliers: Inliers,
    progress: Progress,
) -> tuple[Refined, NoiseFound, Inliers]:
    stated: dict[Component, float] = {}
    side = options.hand
    if options.carrier_noise is not None:
        stated = {
            Component.CARRIER_ROTATION: options.carrier_noise.rotation_rad,
            Component.CARRIER_TRANSLATION: options.carrier_noise.translation_m,
        }
        side = options.carrier_noise.about
    noise = NoiseOptions(stated=stated, drift=options.drift, systematic=options.systematic, side=side)
    how = replace(how, carrier_noise=None)
    before, choices = None, 0
    while True:
        kept = selected(problem, inliers) if inliers else problem
        found = under_noise(kept, solution, how, noise, before=before, progress=progress)
        choices += 1
        if not inliers or choices == MAX_CHOICES:
            break
        progress("judging outliers again")
        again = found.agreeing(problem, inliers)
        if all(np.array_equal(mask, inliers[pair]) for pair, mask in again.items()):
            break
        inliers, before = again, found.settled
        solution = solve(selected(problem, inliers), options=options.solve, progress=progress)
    progress("covariances")
    refined, noise_found = found.refined(inliers)
    return refined, _noise_of(refined, options, noise_found, ""), inliers


def _is_plain(noise: CarrierNoise | None) -> bool:
    """Whether the whole model can hold the stated noise of A: standard deviations, no covariances."""
    return noise is None or noise.covariances is None


def _noise_of(refined: Refined, options: CalibrateOptions, model: NoiseInData | None, why: str) -> NoiseFound:
    return NoiseFound(
        source="estimated from the residuals" if refined.noise_source == "estimated" else "as given",
        rotation_rad={pair: noise.rotation_rad for pair, noise in refined.noise.items()},
        translation_m={pair: noise.translation_m for pair, noise in refined.noise.items()},
        carriers="as given" if options.carrier_noise is not None else "none, A counts as exact",
        model=model,
        simple=why,
    )


def offsets_of(problem: Problem, options: CalibrateOptions) -> bool | tuple[str, ...]:
    """The sensors whose time offsets are estimated, of those that the problem has."""
    if options.time_offsets == "auto":
        return False
    if isinstance(options.time_offsets, bool):
        return options.time_offsets
    return tuple(name for name in options.time_offsets if name in problem.sensors)
