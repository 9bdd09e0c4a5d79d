"""The typical size of each component: what the residuals would be if it were alone."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import CARRIER, DRIFT, SYSTEMATIC, WHITE, Component
from gtsam_rwhec.noise_model.drift import DriftPrior
from gtsam_rwhec.noise_model.rows import Rows

C = Component
#: No noise is smaller: rad and m.
QUIETEST = 1e-7


def typical_sizes(
    rows: Rows, drift: DriftPrior | None, *, has_scale: bool, carrier: bool, systematic: bool
) -> dict[Component, float]:
    """The components that are in the model, with their typical sizes."""
    r = rows.residual
    size_r, size_t = (max(float(np.sqrt(np.median((part**2).mean(axis=1)))), QUIETEST) for part in (r[:, :3], r[:, 3:]))
    given = np.sqrt(np.einsum("nii->i", rows.given) / len(r))
    active: list[Component] = list(WHITE)
    typical: dict[Component, float] = {
        C.ROTATION: size_r / float(given[:3].mean()),
        C.TRANSLATION: size_t / float(given[3:].mean()),
        C.DEPTH: size_t,
        C.CARRIER_ROTATION: size_r,
        C.CARRIER_TRANSLATION: size_t,
        C.SYSTEMATIC_ROTATION: size_r,
        C.SYSTEMATIC_TRANSLATION: size_t,
    }
    if carrier:
        active += CARRIER
        speed = np.sqrt((rows.rate**2).mean(axis=0))
        if speed.any():
            active.append(C.JITTER)
            turning, moving = max(float(speed[:3].max()), 1e-12), max(float(speed[3:].max()), 1e-12)
            typical[C.JITTER] = min(size_r / turning, size_t / moving)
    if drift is not None:
        steps = np.sqrt(rows.instants.count / rows.instants.chains) if drift.correlation == 1.0 else 1.0
        length = max(_root_mean_square(rows.length), QUIETEST)
        typical |= {
            C.DRIFT_ROTATION: size_r / steps,
            C.DRIFT_TRANSLATION: size_t / steps,
            C.DRIFT_SCALE: size_t / length / steps,
        }
        active += DRIFT if has_scale else DRIFT[:2]
    if systematic:
        active += SYSTEMATIC
    return {component: typical[component] for component in active}


def _root_mean_square(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))
