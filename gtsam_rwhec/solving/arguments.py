"""Checks of the arguments of ``solve`` and ``certify``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gtsam_rwhec.errors import FrameError, OptionError, PriorError, ScaleError
from gtsam_rwhec.geometry.poses import PoseLike, one_transform
from gtsam_rwhec.problem.knowledge import difference
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.options import SolveOptions

Poses = Mapping[str, PoseLike]
Scale = float | Mapping[str, float]

#: An answer's fixed frames (entries, rad and m) and scales may differ from the problem's by this much, as files round.
ROUNDING = 1e-9


def check_types(problem: Problem, options: SolveOptions | None) -> None:
    """Raise an ``OptionError`` for a problem or options of a wrong type."""
    if not isinstance(problem, Problem):
        raise OptionError(f"the problem is a {type(problem).__name__}; give a gtsam_rwhec.Problem")
    if options is not None and not isinstance(options, SolveOptions):
        raise OptionError(f"options is a {type(options).__name__}; give a gtsam_rwhec.SolveOptions")


def check_against_knowledge(problem: Problem, X: Poses, Y: Poses, scale: Scale) -> None:
    """Raise an error for an answer that lacks a frame, or contradicts a fixed frame or scale of the problem."""
    for what, poses, names in (("X", X, problem.targets), ("Y", Y, problem.sensors)):
        if not isinstance(poses, Mapping):
            raise OptionError(f"{what} is a {type(poses).__name__}; give poses by name: {{name: pose}}")
        missing = [name for name in names if name not in poses and name not in problem.fixed]
        if missing:
            raise FrameError(f"{what} has no pose of {missing[0]!r}; it has {', '.join(map(repr, poses)) or 'none'}")
        unknown = [name for name in poses if name not in names]
        if unknown:
            raise FrameError(f"{what} has {unknown[0]!r}, which the problem does not; it has {', '.join(names)}")
    if problem.scale == "known" and scale != 1.0:
        raise ScaleError(
            f"the answer's scale is {scale!r}, but this problem has scale='known', which is 1; leave it out"
        )
    if isinstance(scale, Mapping):
        for name, known in problem.fixed_scales.items():
            if name in scale and not np.isclose(scale[name], known, rtol=ROUNDING, atol=0.0):
                raise ScaleError(f"the answer's scale of {name} is {scale[name]!r}, but it is fixed at {known!r}")
    for name, T in problem.fixed.items():
        poses, what = (X, "X") if name in problem.targets else (Y, "Y")
        if name in poses:
            given = one_transform(poses[name], f"{what}[{name!r}]")
            if not np.allclose(given, T, rtol=ROUNDING, atol=ROUNDING):
                raise PriorError(
                    f"{what}[{name!r}] is not the pose at which {name} is fixed: {difference(given, T)}; leave it out, "
                    "or do not fix the frame"
                )
