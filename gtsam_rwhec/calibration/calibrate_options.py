"""The options of ``calibrate``, each of which overrules a choice, and the record that its stages write."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from gtsam_rwhec.calibration.verdict import Choice, Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import (
    NotCertifiedWarning,
    NotUniqueWarning,
    OptionError,
    OutliersWarning,
    RwhecWarning,
    WeightsWarning,
)
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.fit_options import About, CornerOptions, Drift, PoseOptions, check_choices
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution
from gtsam_rwhec.solver.solve_options import SolveOptions

RobustChoice = Literal["auto", "gnc", "none"]
SizesChoice = Literal["check", "known", "correct", "estimate"]
ObservationChoice = Literal["auto", "corners", "poses"]


@dataclass(frozen=True)
class CalibrateOptions(PoseOptions):
    """The options of ``calibrate``; the defaults leave every choice to the data."""

    #: Errors of neighbours in time: found out, a random walk (odometry), with a correlation time, or independent.
    drift: Drift = "auto"
    #: Whether A has errors that vary with the configuration (an arm's kinematics). The constant part, which no residual
    #: shows, is assumed to be twice as large, as probably as the data say.
    systematic: bool = True
    #: The carrier to which errors of A are fixed: an arm's hand. None: found out.
    hand: About | None = None
    #: "auto" and "gnc": measurements that contradict the others are left out, and the rest is certified again. "auto"
    #: leaves this out where there are too few measurements to tell. "none": every measurement counts.
    robust: RobustChoice = "auto"
    #: Look for likely mistakes in the reading of A and B. Where there are any, or residuals that no sensor has (these
    #: are looked for whatever this says), nothing else is done.
    misreadings: bool = True
    #: Where the sizes of targets are said to be known (``scale="known"``). "check": a size that the motion contradicts
    #: is found. "known": it is not looked for. "correct": it is found, and estimated in place of the stated one.
    #: "estimate": all are.
    sizes: SizesChoice = "check"
    #: Estimate the offset of each sensor's clock, or of the named ones. The measurements need stamps. "auto": of each
    #: sensor where stamps and motion determine it, also where it is small; not over standstill, nor between stations
    #: without a ``carrier_path``.
    time_offsets: Literal["auto"] | bool | tuple[str, ...] = "auto"
    #: What the answer is refined from. "auto": from the corners where the problem holds them for every measurement
    #: (``problem.add_corners``) and they give a better answer than the poses. "corners": such a problem is asked for.
    observations: ObservationChoice = "auto"
    #: How: where the intrinsics are from, what of the boards is free. Left out: intrinsics are nominal, boards are as
    #: stated, and A's noise is estimated, or as in ``carrier_noise``.
    corners: CornerOptions | None = None
    #: Probability of the ellipsoids in the report, in task units.
    level: float = 0.95
    #: Options of the certified solver.
    solve: SolveOptions = field(default_factory=SolveOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        choices = {"drift": Drift, "robust": RobustChoice, "sizes": SizesChoice, "observations": ObservationChoice}
        check_choices(self, choices if self.hand is None else choices | {"hand": About})
        self.check_share("level", 0.0)
        for name in ("misreadings", "systematic"):
            if not isinstance(getattr(self, name), bool):
                raise OptionError(f"CalibrateOptions.{name}={brief(getattr(self, name))}; give True or False")
        offsets = self.time_offsets
        is_word = isinstance(offsets, bool) or (isinstance(offsets, str) and offsets == "auto")
        if not is_word and not (isinstance(offsets, tuple) and all(isinstance(name, str) for name in offsets)):
            raise OptionError(
                f"CalibrateOptions.time_offsets={brief(self.time_offsets)}; give 'auto', True, False, or a tuple of "
                "sensors' names: ('cam_0',)"
            )
        if self.corners is not None and not isinstance(self.corners, CornerOptions):
            raise OptionError(f"CalibrateOptions.corners is a {type(self.corners).__name__}; give a CornerOptions")
        if not isinstance(self.solve, SolveOptions):
            raise OptionError(f"CalibrateOptions.solve is a {type(self.solve).__name__}; give a SolveOptions")
        if self.carrier_path is not None and self.time_offsets is False:
            raise OptionError("CalibrateOptions.carrier_path has no use with time_offsets=False; leave out one of them")


#: Which measurements of each pair count, (N,) booleans.
Inliers = dict[Pair, np.ndarray]


def offsets_of(problem: Problem, options: CalibrateOptions) -> bool | tuple[str, ...]:
    """The sensors whose time offsets are estimated, of those that the problem has."""
    if options.time_offsets == "auto":
        return False
    if isinstance(options.time_offsets, bool):
        return options.time_offsets
    return tuple(name for name in options.time_offsets if name in problem.sensors)


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


@dataclass(frozen=True, eq=False)
class Recording:
    """What a log knows beside its measurements, and ``calibrate`` asks of it."""

    #: The measurements with those that cleaning removed because they contradict the carriers' motion: a misreading
    #: makes these
    uncleaned: Problem | None = None
    is_detected: bool = False  #: Whether this library found B in images: it was not misread
    #: Whether A is the inverse of the carriers' poses as they were written: these may be what was misread
    is_inverse: bool = False
    #: Stated clocks that the carriers' turning contradicts: nothing else is computed then
    late: tuple[Finding, ...] = ()
    #: Sensors whose corners contradict their stated intrinsics by far: where these lead nowhere, they are unknown
    far_off: tuple[str, ...] = ()


@dataclass(frozen=True)
class Run:
    """One run of ``calibrate``, or an attempt within it."""

    problem: Problem
    options: CalibrateOptions
    tell: Progress  #: Is called with the name of each step
    recording: Recording | None = None  #: None for measurements of no log
    record: Record = field(default_factory=Record)
    times: int = 1  #: How often it was begun, since poses of targets were computed again
    #: The intrinsics by which they were, where these are not the stated ones
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    #: The problem with sizes as they were stated, where some are estimated in their place
    stated: Problem | None = None
    #: By sensor: how much later than its stamps said A was taken along the carriers' path
    moved_s: Mapping[str, float] = field(default_factory=dict)
    #: The measurements that agree, where clocks and sizes told already, and their certified solution
    agreed: tuple[Solution, Inliers] | None = None

    @property
    def says_so(self) -> str:
        """Why a choice was not made from the data."""
        return "an option says so" if self.recording is None else "the rig file says so"

    def again(self, problem: Problem, cameras: Mapping[str, Camera]) -> Run:
        """The run of a problem with other poses of targets, from its beginning."""
        if self.stated is not None:
            problem = with_sizes_of(problem, self.stated)
        return replace(
            self, problem=problem, record=Record(), times=self.times + 1, cameras=cameras, stated=None, agreed=None
        )

    def attempt(self) -> Run:
        """The same with an empty record: it may be thrown away."""
        return replace(self, record=Record())

    def with_time_offsets(self, of: tuple[str, ...]) -> Run:
        """The same, told of which sensors to estimate the time offsets; the record is shared."""
        return replace(self, options=replace(self.options, time_offsets=of))


def with_sizes_of(problem: Problem, other: Problem) -> Problem:
    """The same measurements, with the sizes that another problem states."""
    result = copy.copy(problem)  # the measurements are shared, what was stated is not
    result.scale, result.fixed_scales = other.scale, dict(other.fixed_scales)
    return result
