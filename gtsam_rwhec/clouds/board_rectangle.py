"""The rectangle of a board in its plane, by which rays hit it, pass beside it, or are mixed: importance sampling."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr, logsumexp

from gtsam_rwhec.geometry.poses import Array

#: A beam that hits or misses against the rectangle, by chance: first, when the pole or the hand that holds the board
#: may count as board, and then, without those that were far off.
STRAY_AT_FIRST = 0.02
STRAY = 0.001
#: A ray that looks mixed and is not, by chance: a pole behind the board has edges too.
STRAY_MIXED = 0.1
#: Far off is this many standard deviations of the first rectangle, and as much of its edges' softness.
FAR_OFF = 4.0
#: At least this share of the beams near the edges of a board agrees with its rectangle.
AGREEING = 0.93
#: Softness of the rectangle's edges, metres, in the rounds before the last: from a guess to the edges themselves.
SOFT_M = (0.08, 0.04, 0.02, 0.01)
#: Standard deviation of the logarithm of how soft edges are, before the data.
SOFT_SPREAD = 0.7
#: Random rectangles tried in each round, and how many of them must count in the last.
SAMPLES = 800
EFFECTIVE = 100.0
#: Rays that count in the rounds before the last.
ROUGH_RAYS = 200
#: Rounds with the edges as sharp as they are, at most.
ROUNDS = 12
#: What a ray hit: the board, what is behind it, both, or something that stands before the board.
HIT, MISS, MIXED, UNKNOWN = 1, 0, 2, -1


class Rays(NamedTuple):
    """Rays about a board: where they meet its plane (N, 3), what each hit (HIT, MISS, MIXED, UNKNOWN)."""

    at: Array
    hit: np.ndarray
    point: np.ndarray  #: (N,) which of the cloud; -1 for pulses that came back from nowhere
    mixed: int


def board_turns(size_m: Sequence[float] | Array) -> list[Array]:
    """The rotations (3, 3) about z after which a board looks the same."""
    steps = 4 if abs(size_m[0] - size_m[1]) < 0.05 * max(size_m) else 2
    turns = []
    for angle in np.arange(steps) * 2.0 * np.pi / steps:
        c, s = np.round(np.cos(angle)), np.round(np.sin(angle))
        turns.append(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
    return turns


class Rectangle(NamedTuple):
    """The rectangle's posterior: mean (5,) of [u, v, angle, inset, log of softness], covariance (5, 5); metres, rad."""

    mean: Array
    covariance: Array

    def spread_m(self, size_m: Array) -> float:
        """Standard deviation of where a corner is, at most."""
        C = self.covariance
        return float(np.sqrt(np.linalg.eigvalsh(C[:2, :2])[1] + C[2, 2] * (size_m @ size_m) / 4.0))


def inside_m(at: Array, rectangles: Array, size_m: Sequence[float] | Array) -> Array:
    """How far points (N, 2) are inside of rectangles (M, 4 or more) [u, v, angle, inset], metres: (M, N)."""
    c, s = np.cos(rectangles[:, 2]), np.sin(rectangles[:, 2])
    depth, other = (
        np.abs(axis @ at.T - (axis * rectangles[:, :2]).sum(axis=1, keepdims=True))
        for axis in (np.stack([c, s], axis=1), np.stack([-s, c], axis=1))
    )
    np.subtract(0.5 * size_m[0], depth, out=depth)
    np.subtract(0.5 * size_m[1], other, out=other)
    np.minimum(depth, other, out=depth)
    depth -= rectangles[:, 3, None]
    result: Array = depth
    return result


def rectangle_by(
    rays: Rays, axes: Array, size_m: Array, divergence_rad: float, range_m: float, before: Rectangle | None
) -> Rectangle | str:
    """The rectangle by which rays hit and which miss, by importance sampling; or why it is none.

    A ray at depth d inside of an edge hits with probability Phi(d / s), s to be found; one that is mixed is within half
    a footprint of an edge. The inset is by how much all edges seem further in, since a pulse that hits partly comes
    back from somewhere else: it has a prior of half a footprint.
    """
    known = rays.hit != UNKNOWN
    stray = STRAY_AT_FIRST
    if before is not None:
        stray = STRAY
        depth = inside_m(rays.at @ axes, before.mean[None], size_m)[0]
        off = np.where(rays.hit == HIT, -depth, np.where(rays.hit == MISS, depth, np.abs(depth)))
        known &= off < FAR_OFF * (np.exp(before.mean[4]) + before.spread_m(size_m))
    at, hit, is_mixed = rays.at[known] @ axes, rays.hit[known] == HIT, rays.hit[known] == MIXED
    sign = np.where(hit | is_mixed, 1.0, -1.0)
    footprint = 0.5 * divergence_rad * range_m
    sharp = 0.3 * footprint + 0.0005
    prior, spread_of_prior = np.array([0.0, np.log(sharp)]), np.array([0.5 * footprint, SOFT_SPREAD])

    # log(P(agree)) over z in steps of 0.01, of clear rays and of mixed ones
    z_of_table = log_ndtr(np.linspace(-8.0, 8.0, 1601))
    tables = np.array([np.logaddexp(np.log(p), np.log1p(-2.0 * p) + z_of_table) for p in (stray, STRAY_MIXED)])
    kind = is_mixed.astype(int)

    def log_posterior(rectangles: Array, soft: float, who: np.ndarray) -> Array:
        z, mixed = inside_m(at[who], rectangles, size_m), is_mixed[who]
        z[:, mixed] = footprint - np.abs(z[:, mixed])
        z *= sign[who] * (100.0 / np.maximum(np.exp(rectangles[:, 4:]), soft))
        votes = tables[kind[who], (np.clip(z, -800.0, 800.0) + 800.5).astype(np.int32)].sum(axis=1)
        result: Array = votes - 0.5 * (((rectangles[:, 3:] - prior) / spread_of_prior) ** 2).sum(axis=1)
        return result

    rng = np.random.default_rng(0)

    def samples(mean: Array, covariance: Array) -> tuple[Array, Array, np.ndarray]:
        """Rectangles about the last round's, the logarithm of their density, and the rays that tell them apart."""
        root = np.linalg.cholesky(1.5 * covariance + np.diag([1e-8, 1e-8, 1e-8, 1e-10, 1e-4]))
        drawn = rng.normal(size=(SAMPLES, 5))
        drawn /= np.sqrt(rng.chisquare(6.0, (SAMPLES, 1)) / 6.0)  # heavier tails than the posterior's
        reach = FAR_OFF * (np.exp(mean[4]) + Rectangle(mean, covariance).spread_m(size_m))
        who = np.flatnonzero(np.abs(inside_m(at, mean[None], size_m)[0]) < reach)
        return mean + drawn @ root.T, -5.5 * np.log1p((drawn**2).sum(axis=1) / 6.0), who

    if before is not None:
        mean, covariance = before.mean, before.covariance
    else:
        period = 2.0 * np.pi / len(board_turns(size_m))
        about = 0.25 * min(size_m)
        tried: Array = rng.normal(size=(3 * SAMPLES, 5)) * [about, about, 0.0, *spread_of_prior]
        tried += np.r_[np.median(at[hit], axis=0), 0.0, prior]
        tried[:, 2] = rng.uniform(0.0, period, len(tried))
        log_proposed: Array = np.zeros(len(tried))
        for soft in SOFT_M:
            some = np.arange(0, len(at), 1 + len(at) // ROUGH_RAYS)
            log_weight = log_posterior(tried, soft, some) - log_proposed
            best = tried[np.argmax(log_weight), 2]  # angles of one turn alone
            tried[:, 2] = best + np.mod(tried[:, 2] - best + 0.5 * period, period) - 0.5 * period
            mean, covariance = _moments(_weights(log_weight)[0], tried)
            tried, log_proposed, _ = samples(mean, covariance)
    for _ in range(ROUNDS):
        tried, log_proposed, who = samples(mean, covariance)
        weight, is_tempered = _weights(log_posterior(tried, 1e-4, who) - log_proposed)
        mean, covariance = _moments(weight, tried)
        if not is_tempered:
            break
    depth = inside_m(at, mean[None], size_m)[0]
    close = (np.abs(depth) < 0.25 * min(size_m)) & ~is_mixed
    agreeing = ((depth > 0.0) == hit)[close]
    if not len(agreeing) or agreeing.mean() < AGREEING:
        return "a flat piece of another size or shape"
    return Rectangle(mean, covariance)


def _moments(weight: Array, samples: Array) -> tuple[Array, Array]:
    """Mean and covariance of weighted samples."""
    mean = weight @ samples
    return mean, (weight[:, None] * (samples - mean)).T @ (samples - mean)


def _weights(log_weight: Array) -> tuple[Array, bool]:
    """Weights of samples, tempered where few have nearly all the weight, and whether they are tempered."""
    power = 1.0
    while True:
        weight = np.exp(power * log_weight - logsumexp(power * log_weight))
        if 1.0 / (weight**2).sum() > EFFECTIVE:
            return weight, power < 1.0
        power *= 0.7
