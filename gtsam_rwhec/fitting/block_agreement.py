"""The last judge of a noise model: answers from blocks of the log may scatter as it says, and not more.

The log is cut into blocks of time, and, without a random walk, into blocks of the carriers' configuration. A block's
measurements have, under the model, information I_j about the unknowns and the gradient b_j = I_j (what they say alone).
With the whole answer d and its covariance C, the block moves the answer by

    e_j = C (b_j - I_j d),    cov(e_i, e_j) = C (I_i [i = j] - I_i C I_j) C

if blocks are independent under the model (Hausman 1978, section 2: what is left of an efficient estimate). The sum of
the e_j's squares, frame by frame and in the units of its expectation, is 6; its degrees of freedom are Satterthwaite's.
An error that no component of the model is like (a map that bends, a scale that drifts, a loop that closes) makes it
larger, and no residual needs to be large for that.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.drift import DriftPrior
from gtsam_rwhec.fitting.fit_options import C
from gtsam_rwhec.fitting.noise_likelihood import NoiseModel
from gtsam_rwhec.fitting.noise_search import Settled, Task
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.geometry.poses import Array

#: Numbers of blocks of time, and of the configuration along its widest direction.
OF_TIME, OF_CONFIGURATION = (2, 4, 8), (2, 4)
#: A block has at least so many instants; of 300 logs of 12 to 19 without a fault the halves disagreed in one.
FEWEST = 6
#: The unknowns have this share of the whole information in each block, so that none is free there.
HELD = 1e-4
#: A frame's blocks scatter too much where chance makes so much in fewer logs than this.
BY_CHANCE = 1e-3
#: Standard deviations that are too small by more than this factor are those of errors that nobody knows.
LARGELY = 2.0
#: Blocks are not independent where they should move a frame by less than this share of its variance.
ALL_OF_IT = 1e-6
#: Degrees of freedom of the noise beside which the scatter is judged, and those of the widened covariance, at least.
LEAST_FREEDOM = 3.0


@dataclass(frozen=True)
class Scatter:
    """How much the answers of some blocks scatter about a frame."""

    frame: str
    #: How the log was cut: "time" or "configuration", and into how many blocks
    by: str
    blocks: int
    #: The scatter's variance over the one that the model expects, and the degrees of freedom of that
    ratio: float
    freedom: float
    #: How often chance alone makes as much
    chance: float
    #: The root mean square of what one block moves the frame by
    rotation_rad: float
    translation_m: float

    @property
    def is_too_much(self) -> bool:
        """Whether chance hardly makes so much."""
        return self.chance < BY_CHANCE

    @property
    def is_by_far(self) -> bool:
        """Whether the errors are of another kind than the model's, so that no factor makes up for it."""
        return self.ratio > LARGELY**2

    def __str__(self) -> str:
        cut = "halves" if self.blocks == 2 else f"{self.blocks} blocks"
        where = "in time" if self.by == "time" else "by the carriers' configuration"
        return (
            f"{cut} of the log ({where}) move {self.frame} by {rounded(np.degrees(self.rotation_rad))} degrees and "
            f"{rounded(1e3 * self.translation_m)} mm each, which is {rounded(np.sqrt(self.ratio))} times what the "
            "noise model expects"
        )


def scatter_of_blocks(task: Task, found: Settled) -> tuple[Scatter, ...]:
    """The scatter of each way to cut the log, for the frame for which it is most beyond chance; empty of few instants.

    Frames of which a direction is free are left out.
    """
    model, sigma = found.model, found.fit.sizes.values(found.fit.logs)
    frames = {
        unknown.owner: model.basis[place]
        for unknown, place in task.layout.slots.items()
        if unknown.kind is UnknownKind.FRAME and not task.layout.free[place].any()
    }
    if not frames:
        return ()
    whole = model.evaluate(sigma)
    spread = carried_on(model, sigma)
    result: list[Scatter] = []
    # A random walk goes on between the visits of a configuration: such blocks share it, and are not independent.
    cuts = [("time", OF_TIME)] + [("configuration", OF_CONFIGURATION)] * (spread is None)
    for by, counts in cuts:
        place = place_of_instants(task, model, by)
        for count in counts:
            if model.rows.instants.count < count * FEWEST:
                continue
            block = place * count // len(place)
            parts = [block_of(model, sigma, block == j, whole.covariance, spread) for j in range(count)]
            result += most_beyond_chance(
                scatter_about(name, rows, by, parts, whole.step, whole.covariance) for name, rows in frames.items()
            )
    return tuple(result)


def most_beyond_chance(scatter: Iterable[Scatter | None]) -> list[Scatter]:
    """The scatter that is most beyond chance, which had as many chances as there are frames; none of none."""
    found = [one for one in scatter if one is not None]
    return [
        replace(one, chance=min(1.0, len(found) * one.chance)) for one in sorted(found, key=lambda one: one.chance)[:1]
    ]


def place_of_instants(task: Task, model: NoiseModel, by: str) -> np.ndarray:
    """The place (T,) of each instant, in time or along the widest direction of the configurations."""
    count = model.rows.instants.count
    if by == "time":
        seconds = task.instants.seconds
        along: Array = np.arange(count, dtype=np.float64) if seconds is None else seconds
    else:
        along = model.rows.features(model.side)[model.rows.instants.first][:, 0]
    place = np.empty(count, dtype=np.int64)
    place[np.argsort(along, kind="stable")] = np.arange(count)
    return place


def carried_on(model: NoiseModel, sigma: dict[C, float]) -> Array | None:
    """Variances (T, s) of the drift's unit states at each instant: a random walk has gone on before a block begins."""
    if model.drift is None or model.drift.correlation < 1.0:
        return None
    prior = model.drift
    F, result = prior.unit_transport(sigma), np.empty(prior.variance.shape)
    P = np.diag(prior.variance[0])
    result[0] = prior.variance[0]
    for k, (step, variance) in enumerate(zip(F, prior.variance[1:], strict=True), start=1):
        P = step @ P @ step.T + np.diag(variance)
        result[k] = np.diagonal(P)
    return result


def block_of(
    model: NoiseModel, sigma: dict[C, float], kept: np.ndarray, covariance: Array, spread: Array | None
) -> tuple[Array, Array]:
    """The information (p, p) and the gradient (p,) that the measurements of some instants have under the model."""
    rows = model.rows.of_instants(kept)
    drift = None
    if model.drift is not None:
        drift = DriftPrior.of(rows, model.drift.walk)
        if spread is not None:
            begins = rows.instants.step == 0.0
            drift = replace(drift, variance=np.where(begins[:, None], spread[kept], drift.variance))
    held = HELD * np.linalg.inv(covariance)
    alone = replace(
        model, rows=rows, drift=drift, features=model.features[kept[model.rows.instants.index]],
        prior_information=held, prior_gradient=np.zeros(len(held)), prior_cost=0.0,
    )  # fmt: skip
    estimate = alone.evaluate(sigma)
    information = np.linalg.inv(estimate.covariance)
    return information - held, information @ estimate.step


def scatter_about(
    frame: str, rows: Array, by: str, parts: list[tuple[Array, Array]], answer: Array, covariance: Array
) -> Scatter | None:
    """The scatter of what blocks say of a frame; None where one block knows as much of it as the whole.

    ``rows`` (6, p) make its twist of the unknowns; ``parts`` are the blocks' information (p, p) and gradient (p,);
    ``answer`` (p,) and ``covariance`` (p, p) are those of the whole.
    """
    reach = rows @ covariance
    moves = np.array([reach @ (b - information @ answer) for information, b in parts])
    reached = np.array([reach @ information for information, _ in parts])
    own = np.array([one @ reach.T for one in reached])
    both = -np.einsum("iap,jbp->ijab", reached @ covariance, reached, optimize=True)
    both[np.arange(len(parts)), np.arange(len(parts))] += own
    expected = np.einsum("iiab->ab", both)
    values, vectors = np.linalg.eigh(0.5 * (expected + expected.T))
    if not values[0] > ALL_OF_IT * float(np.diagonal(rows @ covariance @ rows.T).min()):
        return None
    root = vectors / np.sqrt(np.maximum(values, 1e-9 * values[-1]))
    squares = float(((moves @ root) ** 2).sum())
    unit = root.T @ both @ root
    mean, variance = float(np.einsum("iiaa->", unit)), 2.0 * float((unit**2).sum())
    freedom = max(2.0 * mean**2 / variance, LEAST_FREEDOM)
    ratio = squares / mean
    sizes = np.sqrt((moves.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    chance = float(fdtrc(freedom, 1e9, ratio))
    return Scatter(frame, by, len(parts), ratio, freedom, chance, float(sizes[0]), float(sizes[1]))


def too_much(scatter: Iterable[Scatter], *, is_drift_doubted: bool = False) -> Scatter | None:
    """The scatter that is most beyond chance, of those that chance hardly makes; None where the model holds all.

    Where a drift is seen that no model holds, blocks of time tell alone how large it is: then the largest counts.
    """
    if is_drift_doubted:
        of_time = (one for one in scatter if one.by == "time" and one.ratio > 1.0)
        return max(of_time, key=lambda one: one.ratio, default=None)
    return min((one for one in scatter if one.is_too_much), key=lambda one: one.chance, default=None)
