"""The true scales of a simulated problem."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import get_args

import numpy as np

from gtsam_rwhec.errors import OptionError, ScaleError
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate.noise import Seed

#: A shared scale has this alpha, unless it is given. The paper's monocular simulations have it too.
SHARED_SCALE = 0.5


def true_scales(
    names: list[str],
    mode: ScaleMode,
    given: float | Mapping[str, float] | None,
    known_sizes: tuple[str, ...],
    seed: Seed,
) -> float | dict[str, float]:
    """Check the scales that a caller gives, and draw the scales that it leaves out: alpha, or alpha by name.

    With ``"per_target"`` each target, and each sensor with odometry, has its own scale in ``names``. Scales that are
    not given are 1 (known), 0.5 (shared), or log-uniform in [1/2, 2] with 1 for ``known_sizes``, whose scale the
    problem is told. Raises OptionError for an unknown mode or name, a missing name, or a kind of scale that does not go
    with the mode, and ScaleError if a scale is not positive and finite.
    """
    if mode not in get_args(ScaleMode):
        raise OptionError(f"true_scale: scale is {mode!r}; choose one of {', '.join(get_args(ScaleMode))}")
    if mode == "per_target":
        return _scales_by_name(names, given, known_sizes, np.random.default_rng(seed))
    if known_sizes:
        raise OptionError(f'true_scale: known_sizes need scale="per_target", not {mode!r}')
    if isinstance(given, Mapping):
        raise OptionError(f"true_scale: a mapping is given, but with scale={mode!r} there is one scale; give a number")
    default = 1.0 if mode == "known" else SHARED_SCALE
    alpha = _positive(default if given is None else given, "all targets")
    if mode == "known" and alpha != 1.0:
        raise OptionError(f'true_scale: {alpha!r} is given, but with scale="known" it is 1; choose scale="shared"')
    return alpha


def _scales_by_name(
    names: list[str],
    given: float | Mapping[str, float] | None,
    known_sizes: tuple[str, ...],
    generator: np.random.Generator,
) -> dict[str, float]:
    unknown = [name for name in known_sizes if name not in names]
    if unknown:
        raise OptionError(f"true_scale: known_sizes has {', '.join(unknown)}, but only {', '.join(names)} have a scale")
    if given is None:
        drawn = np.exp(generator.uniform(-math.log(2.0), math.log(2.0), len(names)))
        return {n: 1.0 if n in known_sizes else float(alpha) for n, alpha in zip(names, drawn, strict=True)}
    if not isinstance(given, Mapping):
        raise OptionError(f'true_scale: {given!r} is given; with scale="per_target" give a mapping from name to scale')
    missing = [name for name in names if name not in given]
    if missing:
        raise OptionError(f"true_scale: no scale is given for {', '.join(missing)}; give one for every target")
    return {name: _positive(given[name], name) for name in names}


def _positive(alpha: float, name: str) -> float:
    if not (math.isfinite(alpha) and alpha > 0.0):
        raise ScaleError(f"true_scale: the scale of {name} is {alpha!r}, but must be positive and finite")
    return float(alpha)
