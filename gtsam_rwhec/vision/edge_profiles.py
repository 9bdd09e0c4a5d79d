"""The place of a tag's edge along a profile across it, from a model of the printed pattern.

From inside outwards a profile crosses the code's cell (black or white, not known), one module of black border, and one
module of paper or more; the background beyond the paper is not known. Blur mixes all four. A model without the
neighbours of the edge would place all four edges of a tag too far inside where the blur is half a module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from gtsam_rwhec.geometry.poses import Array

#: Gray values beyond the border and beyond the paper have this prior standard deviation, in units of the edge's step.
BEYOND = 2.0
#: The edge's shift and the blur's change in one round have this prior standard deviation, in units of the blur.
SHIFT = 1.0
#: A sample has this noise, in units of the step. With so little noise the priors only separate columns that the samples
#: do not separate.
NOISE = 0.01


@dataclass(frozen=True, eq=False)
class Fitted:
    """Edges that were fitted to profiles (...); all arrays (...).

    The edge is `shift` further outwards and the blur `wider` than assumed, in the profiles' unit of length; the paper
    is lighter than the border by `step`; `rms` is the root mean square of the residuals, in units of the step.
    """

    shift: Array
    wider: Array
    step: Array
    rms: Array


def fit_profiles(values: Array, places: Array, module: Array, blur: Array, step: Array) -> Fitted:
    """Fit edges to profiles by one Gauss-Newton step from an edge at 0.

    Profiles are gray values (..., S) at places (..., S), from inside (negative) outwards. `module` (...) is the
    distance from the edge inwards to the code, `blur` (...) the blur's standard deviation, and `step` (...) about how
    much lighter the paper is than the border: a scale for the priors.
    """
    sigma = blur[..., None]
    z = places / sigma
    inner, outer = (places + module[..., None]) / sigma, (places - module[..., None]) / sigma
    bell = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    K = np.stack([np.ones_like(z), ndtr(z), ndtr(-inner), ndtr(outer), -bell, -z * bell], axis=-1)
    prior = np.array([0.0, 0.0, *[(NOISE / BEYOND) ** 2] * 2, *[(NOISE / SHIFT) ** 2] * 2])
    H = np.swapaxes(K, -1, -2) @ K + np.diag(prior) + 1e-9 * np.eye(6)
    y = values / step[..., None]
    c = np.linalg.solve(H, np.swapaxes(K, -1, -2) @ y[..., None])[..., 0]
    rms = np.sqrt(((np.einsum("...sk,...k->...s", K, c) - y) ** 2).mean(axis=-1))
    height = np.where(np.abs(c[..., 1]) > 1e-3, c[..., 1], np.nan)
    return Fitted(c[..., 4] / height * blur, c[..., 5] / height * blur, c[..., 1] * step, rms / np.abs(height))
