"""Comparable noise of targets and odometries, for the search for outliers in all measurements together.

One variance factor is estimated for all measurements, so the ratios of their covariances must be right.
`odometry_windows` finds the covariances of motions, from what two motions have in common. This module finds those of
targets, from a calibration with the targets alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gtsam_rwhec.errors import RwhecError, RwhecWarning
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.refined import PairNoise
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.rig.rig import Rig
from gtsam_rwhec.runs.carrier_motion import CarrierMotion
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs, Pairs, problem_of
from gtsam_rwhec.solver.solution import solve


def with_comparable_noise(
    pairs: Pairs, rig: Rig, motion: CarrierMotion, offsets_s: Mapping[str, float], tell: Progress
) -> Pairs:
    """The pairs, with covariances of the targets' poses that fit their residuals.

    The pairs are unchanged if the rig file states the noise, if there is no odometry or no target, or if a calibration
    with the targets alone fails.
    """
    targets = {pair: one for pair, one in pairs.items() if not pair.is_motion and one.used.any()}
    if rig.noise != "estimate" or not targets or not any(pair.is_motion for pair in pairs):
        return pairs
    tell("finding the noise of the targets' poses")
    problem = problem_of(targets, rig, offsets_s)
    options = RefineOptions(
        noise="estimate", robust=rig.cleaning.robust, carrier_noise=motion.noise, carrier_model="propagated"
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RwhecWarning)
            noise = refine(problem, solve(problem), options, progress=tell).noise
    except RwhecError:
        return pairs  # all measurements together may have an answer, under weights that are guessed
    return pairs | {pair: _with_noise(one, noise[pair]) for pair, one in targets.items() if pair in noise}


def _with_noise(measured: MeasuredPairs, noise: PairNoise) -> MeasuredPairs:
    """Scale the covariances so that their median is `noise`; without any, use `noise` for all measurements."""
    variances = np.array([noise.rotation_rad**2] * 3 + [noise.translation_m**2] * 3)
    if measured.covariance is None:
        covariance: Array = np.tile(np.diag(variances), (len(measured.B), 1, 1))
        return replace(measured, covariance=covariance)
    diagonal = np.diagonal(measured.covariance[measured.used], axis1=1, axis2=2)
    stated = np.repeat(np.median(diagonal.reshape(-1, 2, 3).mean(axis=2), axis=0), 3)
    by = np.sqrt(variances / stated)
    return replace(measured, covariance=by[:, None] * measured.covariance * by)
