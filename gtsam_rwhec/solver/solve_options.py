"""Options of the certified solver."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import FrameError, OptionError, PriorError, ScaleError
from gtsam_rwhec.files.progress import Progress, check_progress
from gtsam_rwhec.files.terminal_text import brief, some
from gtsam_rwhec.geometry.poses import PoseLike, one_transform
from gtsam_rwhec.geometry.real_numbers import LARGEST_WHOLE, check_kind, is_one_of, is_real, is_whole
from gtsam_rwhec.problem.knowledge import checked_scale, difference
from gtsam_rwhec.problem.problem import Problem

Method = Literal["auto", "sdp", "local"]


@dataclass(frozen=True)
class SolveOptions:
    """How to solve; the defaults suit all ordinary problems."""

    #: A gap of at most this times max(cost, 1) counts as zero: the cost is half a chi-square, so 1 is little. With unit
    #: weights, at most this times the cost.
    relative_tolerance: float = 1e-6
    max_descent_iterations: int = 200  #: Riemannian Newton steps from one start; three to ten are usual
    #: Number of random starts that are tried before the relaxation, when the first answer is not proven; in a part with
    #: more than ``max_dense_frames`` frames, after the relaxation of a few of them
    random_starts: int = 8
    seed: int = 0  #: Seed of the random starts. The same problem gives the same answer.
    #: The dense methods (small dual, semidefinite relaxation: multipliers of all constraints) take at most this many
    #: frames. In a part with more free frames these are the frames where the multipliers of R'R = I do not suffice, and
    #: those that help them most; all others are eliminated.
    max_dense_frames: int = 120
    relaxation_tolerance: float = 1e-9  #: Relative gap at which the semidefinite solver stops; a descent follows anyway
    max_relaxation_iterations: int = 100  #: Interior-point iterations
    #: Constrain the shared scale to at least zero (Section 4.3), for very noisy data; a relaxation solves it.
    nonnegative_scale: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.nonnegative_scale, bool):
            raise OptionError(f"SolveOptions.nonnegative_scale={brief(self.nonnegative_scale)}; it is True or False")
        for option in fields(self)[:-1]:
            value, is_float = getattr(self, option.name), isinstance(option.default, float)
            least = 0 if option.name in ("random_starts", "seed") else 1
            if not (is_real(value) and 0.0 < value <= sys.float_info.max if is_float else is_whole(value, least)):
                whole = "" if is_float else f": a whole number from {least} to {LARGEST_WHOLE}"
                raise OptionError(f"SolveOptions.{option.name}={brief(value)}; it must be positive and finite{whole}")


def check_method(method: str) -> None:
    """Raise an ``OptionError`` for an unknown method."""
    if not is_one_of(method, get_args(Method)):
        raise OptionError(f"method={brief(method)} is not one of {', '.join(map(repr, get_args(Method)))}")


Poses = Mapping[str, PoseLike]
Scale = float | Mapping[str, float]

#: An answer's fixed frames (entries, rad and m) and scales may differ from the problem's by this much, as files round.
ROUNDING = 1e-9


def check_types(problem: Problem, options: SolveOptions | None, progress: Progress | None = None) -> None:
    """Raise an ``OptionError`` for a problem, options or progress of a wrong type."""
    check_kind(problem, Problem, "the problem", "a gtsam_rwhec.Problem")
    check_kind(options, SolveOptions | None, "options", "a gtsam_rwhec.SolveOptions")
    check_progress(progress)


def check_against_knowledge(problem: Problem, X: Poses, Y: Poses, scale: Scale) -> None:
    """Raise an error for an answer that lacks a frame, or contradicts a fixed frame or scale of the problem."""
    for what, poses, names in (("X", X, problem.targets), ("Y", Y, problem.sensors)):
        check_kind(poses, Mapping, what, "poses by name: {name: pose}")
        strange = [name for name in poses if not isinstance(name, str)]
        if strange:
            raise FrameError(f"{what} has the name {brief(strange[0])}; names are strings: {{name: pose}}")
        missing = [name for name in names if name not in poses and name not in problem.fixed]
        if missing:
            raise FrameError(f"{what} has no pose of {missing[0]!r}; it has {_listed(poses)}")
        unknown = [name for name in poses if name not in names]
        if unknown:
            raise FrameError(f"{what} has {brief(unknown[0])}, which the problem does not; it has {_listed(names)}")
    _check_scale(problem, scale)
    for name, T in problem.fixed.items():
        poses, what = (X, "X") if name in problem.targets else (Y, "Y")
        if name in poses:
            given = one_transform(poses[name], f"{what}[{name!r}]")
            if not np.allclose(given, T, rtol=ROUNDING, atol=ROUNDING):
                raise PriorError(
                    f"{what}[{name!r}] is not the pose at which {name} is fixed: {difference(given, T)}; leave it out, "
                    "or do not fix the frame"
                )


def _check_scale(problem: Problem, scale: Scale) -> None:
    """Raise a ``ScaleError`` for a scale that is no scale, or not one of this problem."""
    if problem.scale == "known":
        if not (is_real(scale) and scale == 1.0):
            raise ScaleError(
                f"the answer's scale is {brief(scale)}, but this problem has scale='known', which is 1; leave it out"
            )
        return
    if not isinstance(scale, Mapping):
        checked_scale(scale, "the answer's scale")
        return
    if problem.scale == "shared":
        raise ScaleError(
            f"the answer's scale is {brief(scale)}, but all targets share one scale; give a positive number"
        )
    owners = tuple(dict.fromkeys(pair.target for pair in problem.pairs))
    for name in scale:
        if name not in owners:
            raise ScaleError(
                f"the answer's scale has {brief(name)}, which has no scale; give a positive number for each of "
                f"{_listed(owners)}"
            )
    for name in owners:
        fixed = problem.fixed_scales.get(name)
        if name in scale:
            given = checked_scale(scale[name], f"the answer's scale of {name}")
            if fixed is not None and abs(given - fixed) > ROUNDING * fixed:
                raise ScaleError(f"the answer's scale of {name} is {given!r}, but it is fixed at {fixed!r}")
        elif fixed is None:
            raise ScaleError(f"the answer's scale lacks {name!r}; it has {_listed(scale)}")


def _listed(names: Iterable[object]) -> str:
    """Names for a message: the first ten."""
    return some(list(map(brief, names)), 10) or "none"
