"""What the data say of their noise, as a record that says so in words."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.fit_options import About, CarrierNoise, Component, DriftFrame
from gtsam_rwhec.fitting.noise_components import CARRIER, DRIFT, SYSTEMATIC

C = Component
#: A kind of noise is found where it raises twice the log likelihood by more than this, a parameter.
EVIDENCE = 5.0
#: Twice the log likelihood's rise that systematic errors of rotation and of translation must exceed.
MOST_BY_CHANCE = EVIDENCE * len(SYSTEMATIC)
_UNITS = {
    C.JITTER: ("ms", 1e3), C.DRIFT_SCALE: ("%", 1e2),
    **dict.fromkeys((C.ROTATION, C.CARRIER_ROTATION, C.DRIFT_ROTATION, C.SYSTEMATIC_ROTATION), ("°", 180.0 / math.pi)),
    **dict.fromkeys(
        (C.TRANSLATION, C.DEPTH, C.CARRIER_TRANSLATION, C.DRIFT_TRANSLATION, C.SYSTEMATIC_TRANSLATION), ("mm", 1e3)
    ),
}  # fmt: skip


def ratio_words(evidence: float) -> str:
    """A likelihood ratio: how much twice the log likelihood rose; a fall, which rounding and priors make, is none."""
    rise = max(evidence, 0.0)
    return f"evidence {rounded(rise) if rise < 10.0 else f'{rise:.0f}'}"


@dataclass(frozen=True)
class Deviation:
    """A component's standard deviation, with the interval that holds it with 90 % probability; rad, m, s or a ratio."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class NoiseInData:
    """The noise that the data have."""

    deviations: dict[Component, Deviation]
    #: The carrier poses at which something was measured.
    instants: int
    #: As many instants with independent noise would determine the unknowns as well.
    worth: float
    #: The carrier to which errors of A are fixed.
    hand: About
    #: Of a track's errors from one step to the next; 1 is a random walk, None no drift.
    correlation: float | None
    #: In whose frame these errors are; "detection": rotations in the target's axes, translations along the sensor's.
    frame: DriftFrame | None
    #: How much twice the log likelihood rose with drift, and with errors that vary with the configuration.
    drift_evidence: float
    systematic_evidence: float
    #: Why no drift was looked for; empty where it was, or an option says that there is none.
    drift_not_sought: str
    #: Whether the order in time is known; without stamps it is that of rows.
    has_stamps: bool
    #: Whether residuals are correlated in time, and there are too many tracks for a model of it.
    is_drift_untried: bool
    #: Whether the covariance has a constant error of A, which no residual shows, tied to the part that varies.
    arms_assumed: bool
    #: That such errors are there: the covariance averages over both.
    systematic_probability: float
    #: Of the constant errors that the covariance has, [omega, v] in rad and m: of the targets' carrier in its own axes,
    #: A Expmap(c), and of the sensors', Expmap(c) A.
    constant_deviations: tuple[tuple[float, ...], ...] = ((0.0,) * 6,) * 2

    @property
    def has_systematic(self) -> bool:
        """Whether the data show errors that vary with the configuration."""
        return self.systematic_evidence > MOST_BY_CHANCE

    @property
    def carrier_noise(self) -> CarrierNoise | None:
        """The noise of A, independent from measurement to measurement; None where A counts as exact."""
        if not all(component in self.deviations for component in (C.CARRIER_ROTATION, C.CARRIER_TRANSLATION)):
            return None
        rotation, translation = (self.deviations[c].value for c in (C.CARRIER_ROTATION, C.CARRIER_TRANSLATION))
        return CarrierNoise(rotation, translation, about=self.hand)

    @property
    def size_words(self) -> str:
        """How large the noise of B and of A is, in short."""
        said = f"{self.size_words_of_B} for B"
        if self.carrier_noise is None:
            return f"{said}; A counts as exact"
        return f"{said}, {self._size(C.CARRIER_ROTATION)} and {self._size(C.CARRIER_TRANSLATION)} for A"

    @property
    def size_words_of_B(self) -> str:
        """How large the noise of B is, in short."""
        return f"{self._size(C.ROTATION)} and {self._size(C.TRANSLATION)}"

    @property
    def systematic_words(self) -> str:
        """The size of these errors."""
        return (
            f"{self._words(C.SYSTEMATIC_ROTATION)} and {self._words(C.SYSTEMATIC_TRANSLATION)} between poses far apart"
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
                + " Only frames far from their carrier tell it from B's; the sum of both is known better."
            )
        if self.correlation is not None:
            steps = [self._words(component) for component in DRIFT if component in self.deviations]
            kind = "Drift in a step" if self.correlation == 1.0 else f"Correlated errors ({self.correlation:g} a step)"
            kind += " of detections" if self.frame == "detection" else f" in the {self.frame}'s frame"
            said.append(
                f"{kind}: {', '.join(steps)} ({ratio_words(self.drift_evidence)}). "
                f"{self.instants} frames are worth about {self.worth:.0f}."
            )
        elif self.worth < 0.8 * self.instants:
            said.append(f"{self.instants} frames are worth about {self.worth:.0f}.")
        if self.arms_assumed:
            found = "found" if self.has_systematic else "not found, and not excluded"
            said.append(
                f"Errors of A that vary with the configuration: {self.systematic_words}, {found} "
                f"({ratio_words(self.systematic_evidence)}): {100.0 * self.systematic_probability:.0f} % probable. "
                "Their constant part, which residuals do not show, is assumed to be twice as large."
            )
        return tuple(said)

    def __str__(self) -> str:
        return " ".join(self.sentences)

    def _size(self, component: Component) -> str:
        unit, factor = _UNITS[component]
        separator = "" if unit == "°" else " "
        return f"{rounded(self.deviations[component].value * factor)}{separator}{unit}"

    def _words(self, component: Component) -> str:
        _, factor = _UNITS[component]
        of = self.deviations[component]
        return f"{self._size(component)} ({rounded(of.low * factor)} to {rounded(of.high * factor)})"
