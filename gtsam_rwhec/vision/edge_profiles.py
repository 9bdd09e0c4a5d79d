"""Where the edge of a tag's border is along a profile across it, by a model of what is printed there.

From inside: the code's cell (black or white, not known), one module of black border, the paper, and where that may end,
a module further, whatever is behind; all blurred alike. Blur of half a module mixes them, and without the neighbours
the edge would be found too far inside, a tag's four edges alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from gtsam_rwhec.geometry.poses import Array

#: Prior standard deviations: of what is beyond the border and beyond the paper, in units of the edge's step; of the
#: edge's shift and of the blur's change in one round, in units of the blur. They only keep columns apart that the
#: samples do not: held against so much noise (in units of the step) they weigh next to nothing.
BEYOND, SHIFT, NOISE = 2.0, 1.0, 0.01


@dataclass(frozen=True, eq=False)
class Fitted:
    """Of profiles (...): how far outwards the edge is, by what the blur differs, the step's height, what is left.

    `shift` and `wider` are in the profiles' unit of length, `rms` in units of the step.
    """

    shift: Array
    wider: Array
    step: Array
    rms: Array


def fit_profiles(values: Array, places: Array, module: Array, blur: Array, step: Array) -> Fitted:
    """One Gauss-Newton step from an edge at 0.

    Parameters
    ----------
    values : (..., S) array
        Gray values.
    places : (..., S) array
        Where, from inside (negative) outwards.
    module : (...) array
        How far inside the code begins.
    blur : (...) array
        Standard deviation.
    step : (...) array
        About how much lighter the paper is than the border: a scale for the priors.
    """
    sigma = blur[..., None]
    z = places / sigma
    inner, outer = (places + module[..., None]) / sigma, (places - module[..., None]) / sigma
    columns = [np.ones_like(z), ndtr(z), ndtr(-inner), ndtr(outer), -_bell(z), -z * _bell(z)]
    K = np.stack(columns, axis=-1)
    prior = np.array([0.0, 0.0, *[(NOISE / BEYOND) ** 2] * 2, *[(NOISE / SHIFT) ** 2] * 2])
    H = np.swapaxes(K, -1, -2) @ K + np.diag(prior) + 1e-9 * np.eye(6)
    y = values / step[..., None]
    c = np.linalg.solve(H, np.swapaxes(K, -1, -2) @ y[..., None])[..., 0]
    rms = np.sqrt(((np.einsum("...sk,...k->...s", K, c) - y) ** 2).mean(axis=-1))
    height = np.where(np.abs(c[..., 1]) > 1e-3, c[..., 1], np.nan)
    return Fitted(c[..., 4] / height * blur, c[..., 5] / height * blur, c[..., 1] * step, rms / np.abs(height))


def _bell(z: Array) -> Array:
    density: Array = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return density
