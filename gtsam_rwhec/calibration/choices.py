"""The choices of a calibration: what was chosen, and the evidence for it."""

from __future__ import annotations

from dataclasses import dataclass

#: What is chosen where the choice says why there is no refined calibration.
REFINEMENT = "covariances"
#: What is chosen of the frames and units of A and B.
READING = "reading of A and B"
#: What is chosen of outliers.
OUTLIERS = "outliers"


@dataclass(frozen=True)
class Choice:
    """One choice that ``calibrate`` made, or could not make; ``str()`` is one sentence.

    Attributes
    ----------
    what : str
        What was to be chosen: "outliers", "noise of B", "time offsets", ...
    chosen : str
        What was chosen, in words.
    evidence : str
        Why: what the data show, what an option said, or why no choice could be made.
    """

    what: str
    chosen: str
    evidence: str

    def __str__(self) -> str:
        return f"{self.what[:1].upper()}{self.what[1:]}: {self.chosen}, because {self.evidence}."
