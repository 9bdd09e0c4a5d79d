"""The options of ``calibrate``, each of which overrules a choice, and the record of what its stages chose and found."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal

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
from gtsam_rwhec.fitting.fit_options import (
    About,
    ArmAccuracy,
    CornerOptions,
    Drift,
    PoseOptions,
    RefineOptions,
    check_choices,
)
from gtsam_rwhec.geometry.real_numbers import check_kind
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.solver.solution import Solution, solve
from gtsam_rwhec.solver.solve_options import SolveOptions

RobustChoice = Literal["auto", "gnc", "none"]
SizesChoice = Literal["check", "known", "correct", "estimate"]
ObservationChoice = Literal["auto", "corners", "poses"]


@dataclass(frozen=True)
class CalibrateOptions(PoseOptions):
    """The options of ``calibrate``; the defaults leave every choice to the data."""

    #: Errors of measurements that are neighbours in time: "auto" (the data decide), a random walk (odometry), errors
    #: with a correlation time, or independent errors.
    drift: Drift = "auto"
    #: Whether A may have errors that vary with the configuration (an arm's kinematics), if the data show them. Their
    #: constant part shows in no residual: it is assumed to be twice as large, weighted by the probability that the data
    #: give such errors. An ``ArmAccuracy`` states how large the constant part is.
    systematic: bool | ArmAccuracy = True
    #: The carrier in whose frame errors of A are modelled, such as an arm's hand. None: the data decide.
    hand: About | None = None
    #: "auto" and "gnc": measurements that contradict the others are left out, and the rest is certified again. "auto"
    #: leaves this out where there are too few measurements to tell. "none": every measurement counts.
    robust: RobustChoice = "auto"
    #: Look for likely mistakes in the reading of A and B. If one is found, nothing else is computed. The same holds for
    #: residuals that no sensor has, which are always looked for.
    misreadings: bool = True
    #: Where rows of A and B are shifted against each other, all or from some row on, shift them back. The verdict is
    #: then "use with care" at best, and names the rows. Not for logs, whose A and B belong together by their stamps.
    repair: bool = False
    #: For targets with known sizes (``scale="known"``). "check": report a stated size that the motion contradicts.
    #: "known": do not check sizes. "correct": report such a size, and estimate it. "estimate": estimate all sizes.
    sizes: SizesChoice = "check"
    #: Estimate the offset of each sensor's clock, or of the named ones. The measurements need stamps. "auto": of each
    #: sensor where stamps and motion determine it, also where it is small; not over standstill, nor between stations
    #: without a ``carrier_path``.
    time_offsets: Literal["auto"] | bool | tuple[str, ...] = "auto"
    #: What the answer is refined from. "auto": from the corners where the problem holds them for every measurement
    #: (``problem.add_corners``) and they give a better answer than the poses. "corners": such a problem is asked for.
    observations: ObservationChoice = "auto"
    #: Options of the refinement from corners: where the intrinsics come from, what of the boards is free. None:
    #: intrinsics are nominal, boards are as stated, and A's noise is estimated, or as in ``carrier_noise``.
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
        check_kind(self.systematic, bool | ArmAccuracy, "CalibrateOptions.systematic", "True, False or an ArmAccuracy")
        for name in ("misreadings", "repair"):
            if not isinstance(getattr(self, name), bool):
                raise OptionError(f"CalibrateOptions.{name}={brief(getattr(self, name))}; give True or False")
        if self.repair and not self.misreadings:
            raise OptionError(
                "CalibrateOptions.repair=True needs the misreadings that are looked for: leave out misreadings=False"
            )
        offsets = self.time_offsets
        is_word = isinstance(offsets, bool) or (isinstance(offsets, str) and offsets == "auto")
        if not is_word and not (isinstance(offsets, tuple) and all(isinstance(name, str) for name in offsets)):
            raise OptionError(
                f"CalibrateOptions.time_offsets={brief(self.time_offsets)}; give 'auto', True, False, or a tuple of "
                "sensors' names: ('cam_0',)"
            )
        check_kind(self.corners, CornerOptions | None, "CalibrateOptions.corners", "a CornerOptions")
        check_kind(self.solve, SolveOptions, "CalibrateOptions.solve", "a SolveOptions")
        if self.carrier_path is not None and self.time_offsets is False:
            raise OptionError("CalibrateOptions.carrier_path has no use with time_offsets=False; leave out one of them")

    def refinement(self, time_offsets: bool | tuple[str, ...], **others: Any) -> RefineOptions:
        """The options of a refinement by these, in which some clocks' offsets are estimated; ``others`` overrule."""
        same = {name: getattr(self, name) for name in ("noise_groups", "inlier_confidence", "carrier_noise")}
        same["noise"] = "given" if self.noise == "given" else "estimate"
        path = self.carrier_path if time_offsets else None
        return RefineOptions(**{**same, "time_offsets": time_offsets, "carrier_path": path, **others})


#: Which measurements of each pair count, (N,) booleans.
Inliers = dict[Pair, np.ndarray]


def agreeing(problem: Problem, inliers: Inliers) -> Problem:
    """The problem of the inliers; without a choice of inliers, or where all agree, the problem itself."""
    return problem if all(mask.all() for mask in inliers.values()) else selected(problem, inliers)


def offsets_of(problem: Problem, options: CalibrateOptions) -> bool | tuple[str, ...]:
    """The sensors whose time offsets are estimated, of those that the problem has."""
    if options.time_offsets == "auto":
        return False
    if isinstance(options.time_offsets, bool):
        return options.time_offsets
    return tuple(name for name in options.time_offsets if name in problem.sensors)


#: Warnings that do not become notes, because the verdict reports them.
SAID_BY_THE_VERDICT = (NotUniqueWarning, NotCertifiedWarning, WeightsWarning, OutliersWarning)


@dataclass
class Record:
    """What the stages chose and found, in the order in which they did."""

    choices: list[Choice] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    notes: dict[str, None] = field(default_factory=dict)

    def choose(self, what: str, chosen: str, evidence: str) -> None:
        """Record a choice and its evidence."""
        self.choices.append(Choice(what, chosen, evidence))

    def find(self, ground: Ground, words: str) -> None:
        """Record a finding against the poses."""
        self.findings.append(Finding(ground, words))

    def start_again(self, ground: Ground, words: str) -> None:
        """Discard all choices and findings, because their answer is not returned; record the reason."""
        self.choices, self.findings = [], [Finding(ground, words)]
        self.notes.clear()

    def take(self, other: Record) -> None:
        """Add the choices and findings of an attempt whose answer is kept."""
        self.choices += other.choices
        self.findings += other.findings

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Turn this library's warnings into notes, except those that the verdict reports; others stay warnings."""
        with warnings.catch_warnings(record=True, action="always") as caught:
            yield
        for warning in caught:
            if not isinstance(warning.message, RwhecWarning):
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
            elif not isinstance(warning.message, SAID_BY_THE_VERDICT):
                self.notes.setdefault(str(warning.message))


@dataclass(frozen=True, eq=False)
class Recording:
    """What ``calibrate`` uses of a log besides its measurements."""

    #: All measurements, including those that cleaning removed because they contradict the carriers' motion: a
    #: misreading may be the cause
    uncleaned: Problem | None = None
    is_detected: bool = False  #: Whether this library found B in images: it was not misread
    #: Whether A is the inverse of the carriers' poses in the log; then the poses in the log may have been misread
    is_inverse: bool = False
    #: Stated clock offsets that the carriers' rotation contradicts; if there are any, nothing else is computed
    late: tuple[Finding, ...] = ()
    #: Sensors whose corners strongly contradict their stated intrinsics; if those give no answer, they count as unknown
    far_off: tuple[str, ...] = ()


@dataclass(frozen=True)
class Run:
    """One run of ``calibrate``, or an attempt within it."""

    problem: Problem
    options: CalibrateOptions
    tell: Progress  #: Is called with the name of each step
    recording: Recording | None = None  #: None for measurements of no log
    record: Record = field(default_factory=Record)
    times: int = 1  #: The number of starts: one more each time that target poses were computed again
    #: The intrinsics with which target poses were computed again, where they differ from the stated ones
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    #: The problem with sizes as they were stated, where some are estimated in their place
    stated: Problem | None = None
    #: By sensor: the time that was added to its stamps when A was taken from the carriers' path
    moved_s: Mapping[str, float] = field(default_factory=dict)
    is_repaired: bool = False  #: Whether rows of A and B were shifted, as an option says
    #: The certified solution of the measurements that agree, and which these are, if the stage of clocks and sizes
    #: found them
    agreed: tuple[Solution, Inliers] | None = None
    #: The last two problems that were solved, with their solutions: several stages ask for the same
    solved: list[tuple[Problem, Solution]] = field(default_factory=list, repr=False)

    def solution_of(self, problem: Problem) -> Solution:
        """The certified solution of a problem."""
        for known, solution in self.solved:
            if known is problem:
                return solution
        solution = solve(problem, options=self.options.solve, progress=self.tell)
        self.solved[:] = [(problem, solution), *self.solved[:1]]
        return solution

    @property
    def says_so(self) -> str:
        """Why a choice was not made from the data."""
        return "an option says so" if self.recording is None else "the rig file says so"

    def again(self, problem: Problem, cameras: Mapping[str, Camera]) -> Run:
        """A new run, from the first stage, of a problem whose target poses were computed again."""
        if self.stated is not None:
            problem = with_sizes_of(problem, self.stated)
        return replace(
            self, problem=problem, record=Record(), times=self.times + 1, cameras=cameras, stated=None, agreed=None
        )

    def attempt(self) -> Run:
        """The same run with an empty record, which may be discarded."""
        return replace(self, record=Record())

    def with_time_offsets(self, of: tuple[str, ...]) -> Run:
        """The same run, with time offsets estimated for the named sensors; the record is shared."""
        return replace(self, options=replace(self.options, time_offsets=of))


def with_sizes_of(problem: Problem, other: Problem) -> Problem:
    """The same measurements, with the sizes that another problem states."""
    result = copy.copy(problem)  # the measurements are shared, what was stated is not
    result.scale, result.fixed_scales = other.scale, dict(other.fixed_scales)
    return result
