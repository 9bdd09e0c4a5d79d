"""The components of the noise, each with its standard deviation as a parameter, in logarithms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.fitting.fit_options import Component
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


C = Component
WHITE = (C.ROTATION, C.TRANSLATION, C.DEPTH)
CARRIER = (C.CARRIER_ROTATION, C.CARRIER_TRANSLATION)
DRIFT = (C.DRIFT_ROTATION, C.DRIFT_TRANSLATION, C.DRIFT_SCALE)
SYSTEMATIC = (C.SYSTEMATIC_ROTATION, C.SYSTEMATIC_TRANSLATION)


@dataclass(frozen=True)
class Sizes:
    """What is known of each component before the data."""

    #: The components in the model.
    active: tuple[Component, ...]
    #: (k,): Each one's size if it alone made the residuals; it is between ``SMALLEST`` and ``LARGEST`` times that.
    typical: Array
    #: (k,): Mean and standard deviation of the logarithms.
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
