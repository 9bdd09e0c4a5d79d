"""The options of the noise model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from gtsam_rwhec.noise_model.components import Component
from gtsam_rwhec.noise_model.drift import Walk
from gtsam_rwhec.noise_model.rows import Side

#: Whether a track drifts: found out, a random walk, errors with a correlation time, or neither.
Drift = Literal["auto", "walk", "correlated", "none"]


@dataclass(frozen=True)
class NoiseOptions:
    """The options of ``modelled``; each one overrules a choice that the data make.

    Attributes
    ----------
    stated : dict of Component to float
        Standard deviations that are known. Those of B are factors of the covariances that the problem states.
    carrier : bool
        Whether A has noise.
    systematic : bool
        Whether A has errors that vary smoothly with the configuration.
    drift : "auto", "walk", "correlated", "none" or Walk
        "auto": as the residuals' correlation in time shows. A ``Walk``: this kind, which was found before.
    side : "targetcarrier", "sensorcarrier" or None
        Which carrier the errors of A are fixed to: an arm's hand. None: as the data show.
    """

    stated: dict[Component, float] = field(default_factory=dict)
    carrier: bool = True
    systematic: bool = True
    drift: Drift | Walk = "auto"
    side: Side | None = None
