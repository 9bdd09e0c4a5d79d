"""What the stages of one ``calibrate`` share: the problem, the options, and the record that they write."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from gtsam_rwhec.calibration.choices import Choice
from gtsam_rwhec.calibration.options import CalibrateOptions
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import NotCertifiedWarning, NotUniqueWarning, OutliersWarning, RwhecWarning, WeightsWarning
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.problem.problem import Problem

#: The verdict says better what these warn of.
SAID_BY_THE_VERDICT = (NotUniqueWarning, NotCertifiedWarning, WeightsWarning, OutliersWarning)


@dataclass
class Record:
    """What the stages chose and found, in the order in which they did."""

    choices: list[Choice] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    notes: dict[str, None] = field(default_factory=dict)

    def choose(self, what: str, chosen: str, evidence: str) -> None:
        """Say what was chosen, and why."""
        self.choices.append(Choice(what, chosen, evidence))

    def find(self, ground: Ground, words: str) -> None:
        """Say what was found against the poses."""
        self.findings.append(Finding(ground, words))

    def start_again(self, ground: Ground, words: str) -> None:
        """Forget all that was chosen and found: the answer to which it belongs is not given, for this reason."""
        self.choices, self.findings = [], [Finding(ground, words)]
        self.notes.clear()

    def take(self, other: Record) -> None:
        """Take over what an attempt chose and found, now that it counts."""
        self.choices += other.choices
        self.findings += other.findings

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Warnings of this library become notes, but for those that the verdict says better; others stay warnings."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
        for warning in caught:
            if not isinstance(warning.message, RwhecWarning):
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
            elif not isinstance(warning.message, SAID_BY_THE_VERDICT):
                self.notes.setdefault(str(warning.message))


@dataclass(frozen=True)
class Run:
    """One run of ``calibrate``, or an attempt within it.

    Attributes
    ----------
    problem : Problem
    options : CalibrateOptions
    tell : Progress
        Is called with the name of each step.
    record : Record
    times : int
        How often it was begun, since poses of targets were computed again.
    cameras : dict of str to Camera
        The intrinsics by which they were, where these are not the stated ones.
    """

    problem: Problem
    options: CalibrateOptions
    tell: Progress
    record: Record = field(default_factory=Record)
    times: int = 1
    cameras: Mapping[str, Camera] = field(default_factory=dict)

    def again(self, problem: Problem, cameras: Mapping[str, Camera]) -> Run:
        """The run of a problem with other poses of targets, from its beginning."""
        return Run(problem, self.options, self.tell, times=self.times + 1, cameras=cameras)

    def attempt(self) -> Run:
        """The same with an empty record: it may be thrown away."""
        return replace(self, record=Record())

    def with_time_offsets(self, of: tuple[str, ...]) -> Run:
        """The same, told of which sensors to estimate the time offsets; the record is shared."""
        return replace(self, options=replace(self.options, time_offsets=of))
