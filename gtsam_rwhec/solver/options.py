"""Options of the certified solver."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import OptionError

Method = Literal["auto", "sdp", "local"]


@dataclass(frozen=True)
class SolveOptions:
    """How to solve; every default is meant to be left alone.

    Attributes
    ----------
    relative_tolerance : float
        A gap of at most this times max(cost, 1) is called certified: the cost is half a chi-square, so 1 is nothing
        (with unit weights, of which that cannot be said, times the cost alone).
    max_descent_iterations : int
        Riemannian Newton steps from one start; three to ten are usual.
    random_starts : int
        Random rotations tried when no certificate is found, before the full relaxation.
    seed : int
        Of the random starts: the same problem gives the same answer.
    max_dense_frames : int
        Above this many free frames the small dual and the semidefinite relaxation, which are dense, are not tried.
    relaxation_tolerance : float
        Relative gap at which the semidefinite solver stops; the rounded solution is polished anyway.
    max_relaxation_iterations : int
        Interior-point iterations.
    nonnegative_scale : bool
        Constrain the shared scale to be at least zero (Section 4.3), for very noisy data; solved by relaxation.
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
        for option in fields(self):
            value = getattr(self, option.name)
            if option.name == "nonnegative_scale":
                if not isinstance(value, bool):
                    raise OptionError(f"SolveOptions.nonnegative_scale={value!r}; it is True or False")
                continue
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if (
                not number
                or not np.isfinite(value)
                or value < 0
                or (value == 0 and option.name not in ("random_starts", "seed"))
            ):
                raise OptionError(f"SolveOptions.{option.name}={value!r}; it must be positive and finite")


def check_method(method: str) -> None:
    """Refuse an unknown method by name."""
    if method not in get_args(Method):
        raise OptionError(f"method={method!r} is not one of {', '.join(map(repr, get_args(Method)))}")
