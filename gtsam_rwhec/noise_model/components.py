"""The components of the noise, each with its standard deviation as a parameter, in logarithms."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: A component is at least and at most this many times the typical size of what residuals show of it.
SMALLEST, LARGEST = 1e-3, 30.0
#: The logarithm of a standard deviation is known before the data with this standard deviation.
PRIOR = 2.0
#: That of a component that the user states.
STATED = 0.02
#: A component is expected at this share of the residuals.
EXPECTED = 0.3
#: Errors that vary with the configuration are expected at this share: an arm in order shows less of them than noise.
EXPECTED_SYSTEMATIC = 0.15


class Component(StrEnum):
    """A kind of noise; the unit is that of its standard deviation."""

    #: B's rotation about each axis, rad (a factor, where covariances are stated).
    ROTATION = "rotation of B"
    #: B's translation along each axis, m (a factor, where covariances are stated).
    TRANSLATION = "translation of B"
    #: B's translation along the sensor's z axis, on top, m.
    DEPTH = "depth of B"
    #: A's rotation about each axis, rad.
    CARRIER_ROTATION = "rotation of A"
    #: A's translation along each axis, m.
    CARRIER_TRANSLATION = "translation of A"
    #: Jitter of clocks, s.
    JITTER = "jitter"
    #: Drift of a sensor's track in a step: rotation, rad.
    DRIFT_ROTATION = "drift of rotation"
    #: Drift in a step: translation, m.
    DRIFT_TRANSLATION = "drift of translation"
    #: Drift in a step: logarithm of the scale.
    DRIFT_SCALE = "drift of scale"
    #: Errors of the carriers' poses that vary with the configuration: rotation, rad.
    SYSTEMATIC_ROTATION = "systematic rotation of A"
    #: The same: translation, m.
    SYSTEMATIC_TRANSLATION = "systematic translation of A"


C = Component
WHITE = (C.ROTATION, C.TRANSLATION, C.DEPTH)
CARRIER = (C.CARRIER_ROTATION, C.CARRIER_TRANSLATION)
DRIFT = (C.DRIFT_ROTATION, C.DRIFT_TRANSLATION, C.DRIFT_SCALE)
SYSTEMATIC = (C.SYSTEMATIC_ROTATION, C.SYSTEMATIC_TRANSLATION)


@dataclass(frozen=True)
class Sizes:
    """What is known of each component before the data.

    Attributes
    ----------
    active : tuple of Component
        The components in the model.
    typical : (k,) array
        Each one's size if it alone made the residuals; it is between ``SMALLEST`` and ``LARGEST`` times that.
    expected, spread : (k,) arrays
        Mean and standard deviation of the logarithms.
    """

    active: tuple[Component, ...]
    typical: Array
    expected: Array
    spread: Array

    @staticmethod
    def of(typical: dict[Component, float], stated: dict[Component, float]) -> Sizes:
        """Components by their typical sizes; those that were ``stated`` have these standard deviations."""
        active = tuple(typical)
        sizes = np.array([stated.get(component, size) for component, size in typical.items()])
        is_stated = np.array([component in stated for component in active])
        share = np.where([component in SYSTEMATIC for component in active], EXPECTED_SYSTEMATIC, EXPECTED)
        expected = np.log(np.where(is_stated, 1.0, share) * sizes)
        return Sizes(active, sizes, expected, np.where(is_stated, STATED, PRIOR))

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Of the logarithms."""
        return [(c + np.log(SMALLEST), c + np.log(LARGEST)) for c in np.log(self.typical)]

    def penalty(self, logs: Array) -> float:
        """-2 log of the prior's density."""
        return float((((logs - self.expected) / self.spread) ** 2).sum())

    def penalty_gradient(self, logs: Array) -> Array:
        """The derivative (k,) of ``penalty``."""
        found: Array = 2.0 * (logs - self.expected) / self.spread**2
        return found

    def values(self, logs: Array) -> dict[Component, float]:
        """Standard deviations by component; zero for those that are not active."""
        return dict.fromkeys(Component, 0.0) | dict(zip(self.active, np.exp(logs).tolist(), strict=True))
