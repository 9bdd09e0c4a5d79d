"""What the data say of their noise, as a record that says so in words."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gtsam_rwhec.noise_model.components import CARRIER, DRIFT, SYSTEMATIC, Component
from gtsam_rwhec.noise_model.drift import Frame
from gtsam_rwhec.noise_model.rows import Side

C = Component
#: A kind of noise is found where it raises twice the log likelihood by more than this, a parameter.
EVIDENCE = 5.0
_UNITS = {
    C.JITTER: ("ms", 1e3), C.DRIFT_SCALE: ("%", 1e2),
    **dict.fromkeys((C.ROTATION, C.CARRIER_ROTATION, C.DRIFT_ROTATION, C.SYSTEMATIC_ROTATION), ("°", 180.0 / math.pi)),
    **dict.fromkeys(
        (C.TRANSLATION, C.DEPTH, C.CARRIER_TRANSLATION, C.DRIFT_TRANSLATION, C.SYSTEMATIC_TRANSLATION), ("mm", 1e3)
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Deviation:
    """A component's standard deviation, with the interval that holds it with 90 % probability; rad, m, s or a ratio."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class NoiseInData:
    """The noise that the data have.

    Attributes
    ----------
    deviations : dict of Component to Deviation
    instants : int
        The carrier poses at which something was measured.
    worth : float
        As many instants with independent noise would determine the unknowns as well.
    hand : "targetcarrier" or "sensorcarrier"
        The carrier to which errors of A are fixed.
    correlation : float or None
        Of a track's errors from one step to the next; 1 is a random walk, None no drift.
    frame : "sensor", "target", "detection" or None
        In whose frame these errors are; "detection": rotations in the target's axes, translations along the sensor's.
    drift_evidence, systematic_evidence : float
        How much twice the log likelihood rose with drift, and with errors that vary with the configuration.
    is_drift_untried : bool
        Whether residuals are correlated in time, and there are too many tracks for a model of it.
    arms_assumed : bool
        Whether the covariance has a constant error of A, which no residual shows, as large as the part that varies.
    """

    deviations: dict[Component, Deviation]
    instants: int
    worth: float
    hand: Side
    correlation: float | None
    frame: Frame | None
    drift_evidence: float
    systematic_evidence: float
    is_drift_untried: bool
    arms_assumed: bool

    @property
    def has_systematic(self) -> bool:
        """Whether the data show errors that vary with the configuration."""
        return self.systematic_evidence > EVIDENCE * len(SYSTEMATIC)

    @property
    def systematic_words(self) -> str:
        """The size of these errors."""
        return (
            f"{self._words(C.SYSTEMATIC_ROTATION)} and {self._words(C.SYSTEMATIC_TRANSLATION)} for a far configuration"
        )

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found, each with its evidence."""
        said = [
            f"Noise of B for each axis: {self._words(C.ROTATION)} and {self._words(C.TRANSLATION)}, and on top "
            f"{self._words(C.DEPTH)} along the sensor's z axis."
        ]
        if any(component in self.deviations for component in CARRIER):
            said.append(
                f"Noise of A for each axis: {self._words(C.CARRIER_ROTATION)} and "
                f"{self._words(C.CARRIER_TRANSLATION)}"
                + (f"; jitter of stamps: {self._words(C.JITTER)}." if C.JITTER in self.deviations else ".")
                + " Only lever arms tell A's noise from B's: their sum is known better than either."
            )
        if self.correlation is not None:
            steps = [self._words(component) for component in DRIFT if component in self.deviations]
            kind = "Drift in a step" if self.correlation == 1.0 else f"Correlated errors ({self.correlation:g} a step)"
            kind += " of detections" if self.frame == "detection" else f" in the {self.frame}'s frame"
            said.append(
                f"{kind}: {', '.join(steps)} (2 log likelihood {self.drift_evidence:+.0f}). "
                f"{self.instants} frames are worth about {self.worth:.0f}."
            )
        elif self.worth < 0.8 * self.instants:
            said.append(f"{self.instants} frames are worth about {self.worth:.0f}.")
        if self.arms_assumed:
            found = "found" if self.has_systematic else "not found, and not excluded"
            said.append(
                f"Errors of A that vary with the configuration: {self.systematic_words}, {found} "
                f"(2 log likelihood {self.systematic_evidence:+.0f}). The constant part, which residuals do not show, "
                "is assumed to be as large."
            )
        return tuple(said)

    def __str__(self) -> str:
        return " ".join(self.sentences)

    def _words(self, component: Component) -> str:
        unit, factor = _UNITS[component]
        of = self.deviations[component]
        separator = "" if unit == "°" else " "
        return f"{of.value * factor:.2g}{separator}{unit} ({of.low * factor:.2g} to {of.high * factor:.2g})"
