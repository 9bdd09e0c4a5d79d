"""Options of the certified solver."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from typing import Literal, get_args

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.real_numbers import LARGEST_WHOLE, is_one_of, is_real, is_whole

Method = Literal["auto", "sdp", "local"]


@dataclass(frozen=True)
class SolveOptions:
    """How to solve; the defaults suit all ordinary problems.

    Attributes
    ----------
    relative_tolerance : float
        A gap of at most this times max(cost, 1) counts as zero: the cost is half a chi-square, so 1 is little. With
        unit weights, at most this times the cost.
    max_descent_iterations : int
        Riemannian Newton steps from one start; three to ten are usual.
    random_starts : int
        Number of random starts that are tried before the relaxation, when the first answer is not proven; in a part
        with more than ``max_dense_frames`` frames, after the relaxation of a few of them.
    seed : int
        Seed of the random starts. The same problem gives the same answer.
    max_dense_frames : int
        So many frames at once have the multipliers of all constraints (small dual, semidefinite relaxation), which are
        dense. In a part with more free frames these are the frames where the multipliers of R'R = I do not suffice,
        and those that help them most; all others are eliminated.
    relaxation_tolerance : float
        Relative gap at which the semidefinite solver stops; a descent follows anyway.
    max_relaxation_iterations : int
        Interior-point iterations.
    nonnegative_scale : bool
        Constrain the shared scale to at least zero (Section 4.3), for very noisy data; a relaxation solves it.
    """

    relative_tolerance: float = 1e-6
    max_descent_iterations: int = 200
    random_starts: int = 8
    seed: int = 0
    max_dense_frames: int = 120
    relaxation_tolerance: float = 1e-9
    max_relaxation_iterations: int = 100
    nonnegative_scale: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.nonnegative_scale, bool):
            raise OptionError(f"SolveOptions.nonnegative_scale={brief(self.nonnegative_scale)}; it is True or False")
        for option in fields(self)[:-1]:
            value = getattr(self, option.name)
            if isinstance(option.default, float):
                if not (is_real(value) and 0.0 < value <= sys.float_info.max):
                    raise OptionError(f"SolveOptions.{option.name}={brief(value)}; it must be positive and finite")
            elif not is_whole(value, least := 0 if option.name in ("random_starts", "seed") else 1):
                raise OptionError(
                    f"SolveOptions.{option.name}={brief(value)}; it must be positive and finite: a whole number from "
                    f"{least} to {LARGEST_WHOLE}"
                )


def check_method(method: str) -> None:
    """Raise an ``OptionError`` for an unknown method."""
    if not is_one_of(method, get_args(Method)):
        raise OptionError(f"method={brief(method)} is not one of {', '.join(map(repr, get_args(Method)))}")
