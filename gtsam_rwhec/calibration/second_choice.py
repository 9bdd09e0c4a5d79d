"""Outliers that agree with one another far better than what was kept: then they are the good measurements.

Where half of the measurements are wrong in the same way (a planar target that is seen flipped), a fit may keep most of
them, with some good ones between, under a noise that is many times too large.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.calibration.noise_choice import Inliers
from gtsam_rwhec.calibration.trial_fits import MEDIAN_OF_CHI, Sample, TrialFit, fitted, residuals
from gtsam_rwhec.problem.problem import Problem

#: What was left out is looked at from this share of all measurements on, and from so many.
SHARE, FEWEST = 0.25, 8
#: The medians of its residuals, rotation times translation, are this many times smaller than those of what was kept.
BETTER = 25.0
#: A measurement agrees with a fit within this many standard deviations, of rotation and of translation.
AGREES = 5.0


def more_consistent(problem: Problem, inliers: Inliers) -> Inliers | None:
    """The measurements that agree with those that were left out, where these agree far better with one another.

    None where the choice of ``inliers``, by pair (N,) booleans, stands.
    """
    number = sum(len(mask) for mask in inliers.values())
    left_out = sum(int((~mask).sum()) for mask in inliers.values())
    if left_out < max(FEWEST, SHARE * number):
        return None
    raw = {pair: problem.measurements(*pair) for pair in inliers}
    kept: Sample = {pair: (raw[pair].A[mask], raw[pair].B[mask]) for pair, mask in inliers.items() if mask.any()}
    other: Sample = {pair: (raw[pair].A[~mask], raw[pair].B[~mask]) for pair, mask in inliers.items() if not mask.all()}
    of_kept, of_other = fitted(problem, kept), fitted(problem, other)
    if of_kept is None or of_other is None or _volume(of_other) * BETTER > _volume(of_kept):
        return None
    if not all(name in of_other.frames for pair in inliers for name in pair.frames):
        return None  # it does not tell all frames
    spread = np.array([of_other.residual.rotation_rad, of_other.residual.translation_m]) / MEDIAN_OF_CHI
    found: Inliers = {}
    for pair in inliers:
        scale = of_other.scale[pair.target] if isinstance(of_other.scale, dict) else of_other.scale
        errors = residuals(of_other.frames, scale, pair, raw[pair].A, raw[pair].B)
        found[pair] = np.asarray((errors < AGREES * spread[:, None]).all(axis=0))
    return found if sum(int(mask.sum()) for mask in found.values()) >= left_out // 2 else None


def _volume(fit: TrialFit) -> float:
    return fit.residual.rotation_rad * fit.residual.translation_m
