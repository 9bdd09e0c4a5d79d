"""The noise that a calibration counts with, as a record."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.problem.pairs import Pair


@dataclass(frozen=True)
class NoiseFound:
    """The noise that a calibration counts with, one standard deviation an axis; ``str()`` is a sentence.

    Attributes
    ----------
    source : str
        Where it comes from: "estimated from the residuals", "as given".
    rotation_rad, translation_m : dict of (target, sensor) to float
        Of B, by pair: of the pair's median measurement, root mean square over axes.
    carriers : str
        The noise of A, in words.
    model : NoiseInData or None
        All that the data say of their noise, of A's, in time and over the configuration; None where B's alone was
        estimated, or noise was given.
    simple : str
        Why B's alone was estimated; empty with a model.
    has_failed : bool
        Whether the model of all noise could not be computed, or the noise that was stated for A not used.
    """

    source: str
    rotation_rad: dict[Pair, float]
    translation_m: dict[Pair, float]
    carriers: str
    model: NoiseInData | None = None
    simple: str = ""
    has_failed: bool = False

    def __str__(self) -> str:
        if self.model is not None:
            return str(self.model)
        if not self.rotation_rad:
            return f"Noise of B: {self.source}. Noise of A: {self.carriers}."
        degrees = [math.degrees(value) for value in self.rotation_rad.values()]
        millimetres = [1e3 * value for value in self.translation_m.values()]
        return (
            f"Noise of B: {_span(degrees)}° and {_span(millimetres)} mm for each axis of a typical measurement, "
            f"{self.source}. Noise of A: "
            f"{self.carriers}."
        )


def _span(values: list[float]) -> str:
    low, high = rounded(min(values)), rounded(max(values))
    return low if low == high else f"{low} to {high}"


#: Where nothing could be estimated.
NOT_KNOWN = NoiseFound("not known", {}, {}, "not known")
