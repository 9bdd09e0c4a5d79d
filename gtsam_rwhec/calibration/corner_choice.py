"""Which model of a refinement from corners predicts images best that it has not seen.

A refinement that frees A's errors, or sizes, always fits its own images better. A model is chosen by the error on the
target in images that were left out, of a part of the images where they are many.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import CountError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.fit_options import CarrierNoise, CornerOptions
from gtsam_rwhec.fitting.held_out import LeftOut, left_out
from gtsam_rwhec.fitting.observations import Observations, Views
from gtsam_rwhec.geometry.poses import PoseLike

#: At most so many images are looked at, and of a pair at least so many.
MOST_IMAGES, FEWEST_OF_PAIR = 120, 8
#: Images are left out in so many blocks; of so few images, in more: the rest must still tell what all of them tell.
FOLDS, FEW, FOLDS_OF_FEW = 4, 50, 8
#: A counts as exact where the error is below this share of that with its noise.
BETTER = 0.95


@dataclass(frozen=True)
class Score:
    """A model with its error in images that were left out, and the one that its covariances make one expect."""

    words: str
    px: float
    mm: float
    expected_px: float

    @property
    def in_words(self) -> str:
        """The error on the target, with the model."""
        size = f"{self.mm:.3g} mm" if np.isfinite(self.mm) else "a target behind its camera"
        return f"{size} with {self.words}"


@dataclass(frozen=True, eq=False)
class Tried:
    """The model that was chosen.

    Attributes
    ----------
    options : CornerOptions
    words : str
        What it takes as known of A and of sizes.
    evidence : str
    scores : tuple of Score
        Of all models, the chosen one first; empty where images are too few.
    left_out : LeftOut
        Of the chosen one; empty where images are too few.
    """

    options: CornerOptions
    words: str
    evidence: str
    scores: tuple[Score, ...]
    left_out: LeftOut


def chosen_model(
    observations: Observations,
    X: Mapping[str, PoseLike],
    Y: Mapping[str, PoseLike],
    options: CornerOptions,
    tell: Progress,
) -> Tried:
    """The options under which images that were left out are predicted best: those given, or with A as exact.

    Raises as ``refine_corners`` does.
    """
    some = thinned(observations)
    try:
        first = _scored(some, X, Y, options, tell)
    except CountError as error:
        return Tried(options, in_words(options), f"no other was tried: {error}", (), LeftOut({}, {}))
    every = [first]
    if options.carrier_noise != "exact":
        every.append(_scored(some, X, Y, replace(options, carrier_noise="exact"), tell))
    chosen, score, found = every[-1] if every[-1][1].mm < BETTER * first[1].mm else first
    rest = tuple(one for _, one, _ in every if one is not score)
    evidence = f"it predicts images that were left out to {score.px:.3g} px, and {score.mm:.3g} mm on the target"
    if rest:
        evidence += f" ({', '.join(one.in_words for one in rest)})"
    return Tried(chosen, score.words, evidence, (score, *rest), found)


def thinned(observations: Observations) -> Observations:
    """At most so many images of each pair, evenly over their order."""
    most = max(MOST_IMAGES // len(observations.views), FEWEST_OF_PAIR)

    def some(view: Views) -> Views:
        number = len(view.A)
        at = np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(np.int64))
        return view.selected(at)

    return replace(observations, views={pair: some(view) for pair, view in observations.views.items()})


def _scored(
    observations: Observations,
    X: Mapping[str, PoseLike],
    Y: Mapping[str, PoseLike],
    options: CornerOptions,
    tell: Progress,
) -> tuple[CornerOptions, Score, LeftOut]:
    refined = refine_corners(observations, X, Y, options, tell)
    folds = FOLDS_OF_FEW if len(refined.point.A) < FEW else FOLDS
    found = left_out(observations, refined, options, folds=folds, progress=tell)
    errors = found.errors
    weights = np.array([one.corners for one in errors.values()], dtype=float)

    def mean(values: list[float]) -> float:
        return float(np.sqrt(weights @ np.square(values) / weights.sum()))

    px, mm, expected = (
        mean([getattr(one, name) for one in errors.values()]) for name in ("rms_px", "rms_mm", "expected_px")
    )
    return options, Score(in_words(options), px, mm, expected), found


def in_words(options: CornerOptions) -> str:
    """What the options take as known of A and of sizes."""
    noise = options.carrier_noise
    if isinstance(noise, CarrierNoise):
        of_A = f"A's noise as stated ({np.degrees(noise.rotation_rad):.2g}° and {1e3 * noise.translation_m:.2g} mm)"
    else:
        of_A = "A as exact" if noise == "exact" else "A's noise estimated"
    shares = options.size_share.values() if isinstance(options.size_share, Mapping) else (options.size_share,)
    if not any(shares):
        return f"{of_A} and sizes as stated"
    if not isinstance(options.size_share, Mapping):
        return f"{of_A} and sizes estimated"
    free = [name for name, share in options.size_share.items() if share]
    return f"{of_A} and {f'the size of {free[0]}' if len(free) == 1 else 'some sizes'} estimated"
