"""The information of each image, what would change without it, and how many images have nearly all information.

At the level of poses, with independent noise: an image is all that one sensor measured at one stamp; without stamps
each measurement counts by itself.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from gtsam_rwhec.fitting.joint_covariance import EliminationOrder
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.file_record import Count, FileRecord, PositiveCount, Row
from gtsam_rwhec.results.linear_model import OWN, LinearModel, equilibrated, inverse_of

#: If there are more images than this, neighbours are chosen together.
MOST_CHOSEN_FROM = 125
#: The choice begins with this share of all information, so that every direction has a finite deviation.
BEGIN = 1e-6
#: A parameter of which all but this share is along free directions has no deviation.
FREE_SHARE = 1e-6
#: Of a direction that only one image tells, this share at least is left without it.
LOST = 1e-9
#: How much larger the worst standard deviation may be.
GROWTHS = (0.05, 0.1, 0.25, 0.5)
#: So many measurements are looked at together.
AT_ONCE = 512
#: So many images are listed.
LISTED = 10


class ImageContribution(FileRecord):
    """The contribution of one image."""

    sensor: str
    targets: tuple[str, ...]  #: What it saw
    time: float  #: Seconds since the first measurement, or the place of the measurement in its pair
    stamp_ns: int | None  #: Its stamp
    share: float  #: Of all that was learnt: the trace of its part of the hat matrix over unknowns
    moved: float  #: Without it the pose that moves most moves so many of its standard deviations
    moved_frame: str  #: Which pose that is
    moved_mm: float  #: How far that pose's origin moves, millimetres
    growth: float  #: Without it the standard deviation that grows most grows by this share


class Fewer(FileRecord):
    """How many images have nearly as much information as all."""

    growth: float  #: No standard deviation is larger by more than this share
    bundles: Count  #: So many bundles of images are enough, if they are chosen well


class ContributionEvidence(FileRecord):
    """How much each image contributed."""

    has_stamps: bool  #: Whether an image is known by its stamp; else each measurement is one
    images: Count  #: In the answer
    bundle: PositiveCount  #: Images are chosen in bundles of so many neighbours
    bundles: Count  #: Bundles among which the choice was
    important: tuple[ImageContribution, ...]  #: Those that tell most, the first most of all
    influential: tuple[ImageContribution, ...]  #: Those without which the answer moves most
    shares: Row  #: Of all images, the largest first
    fewer: tuple[Fewer, ...]  #: How many images are enough
    curve: Row  #: The largest growth of a standard deviation with the first 1, 2, ... chosen bundles


def contribution_of(model: LinearModel) -> ContributionEvidence | None:
    """What each image of a model contributed; None where nothing is in the answer, or no frame is unknown."""
    r, J = model.whitened()
    which = np.flatnonzero(model.used)
    if not len(which):
        return None
    covariance = inverse_of(model.information(J, model.used))
    padded = np.pad(covariance, ((0, 1), (0, 1)))
    images = _images(model, which)
    own = [np.linalg.pinv(covariance[where, where], hermitian=True) for where in model.frames.values()]
    if not own:
        return None
    blocks = np.array(own)
    found = _left_out(model, r, J, padded, blocks, images)
    by_share = sorted(found, key=lambda one: -one.share)
    by_move = sorted(found, key=lambda one: -one.moved)
    each = -(-len(images) // MOST_CHOSEN_FROM)
    bundles = [np.concatenate(images[i : i + each]) for i in range(0, len(images), each)]
    curve = _chosen(model, J, covariance, bundles)
    return ContributionEvidence(
        has_stamps=model.stamps_ns is not None,
        images=len(images),
        bundle=each,
        bundles=len(bundles),
        important=tuple(by_share[:LISTED]),
        influential=tuple(by_move[:LISTED]),
        shares=tuple(float(f"{one.share:.6g}") for one in by_share[:1000]),
        fewer=tuple(_fewer(curve, growth) for growth in GROWTHS),
        curve=tuple(float(f"{value:.6g}") for value in curve),
    )


def _images(model: LinearModel, which: np.ndarray) -> list[np.ndarray]:
    """The measurements of each image."""
    if model.stamps_ns is None:
        return [np.array([i]) for i in which]
    sensor = np.sum([i * mine for i, mine in enumerate(model.by_sensor.values())], axis=0)
    keys = np.column_stack([sensor[which], model.stamps_ns[which] - model.stamps_ns.min()])
    _, image = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(image.ravel(), kind="stable")
    return np.split(which[order], np.flatnonzero(np.diff(image.ravel()[order])) + 1)


def _left_out(
    model: LinearModel, r: Array, J: Array, covariance: Array, blocks: Array, images: list[np.ndarray]
) -> list[ImageContribution]:
    """Leave-one-out of images, all of one size together: d = -S J' (1 - J S J')^-1 r, and S + S J' (1 - J S J')^-1 J S.

    ``covariance`` S has a last row and column of zeros; ``blocks`` (F, 6, 6) are the inverses of the frames' own
    covariances, zero along free directions.
    """
    found: dict[int, ImageContribution] = {}
    sizes = np.array([len(rows) for rows in images])
    for size in np.unique(sizes).tolist():
        alike = np.flatnonzero(sizes == size)
        for part in np.array_split(alike, -(-len(alike) * size // AT_ONCE)):
            rows = np.array([images[i] for i in part])
            found |= dict(zip(part.tolist(), _alike(model, r, J, covariance, blocks, rows), strict=True))
    return [found[i] for i in range(len(images))]


def _alike(
    model: LinearModel, r: Array, J: Array, covariance: Array, blocks: Array, rows: np.ndarray
) -> Iterator[ImageContribution]:
    """The same for images with as many measurements each: their places (n, k)."""
    n, k = rows.shape
    places, derivative = model.places[rows], J[rows]
    spread = np.einsum("dnkp,nkip->ndki", covariance[:, places], derivative, optimize=True)  # S J'
    spread = spread.reshape(n, len(covariance), 6 * k)
    there = np.take_along_axis(spread, places.reshape(n, -1, 1), axis=1).reshape(n, k, OWN, 6 * k)
    hat = np.einsum("nkip,nkpj->nkij", derivative, there).reshape(n, 6 * k, 6 * k)
    root = np.array([_inverse_root(each) for each in np.eye(6 * k) - hat])
    half = spread @ root.transpose(0, 2, 1)
    step = -(half @ (root @ r[rows].reshape(n, 6 * k, 1)))[:, :, 0]
    variance = np.diagonal(covariance)
    known = variance > 0.0
    ratio = (half**2).sum(axis=2)[:, known] / variance[known]
    growth = np.sqrt(1.0 + ratio.max(axis=1, initial=0.0)) - 1.0
    by_frame = step[:, : 6 * len(blocks)].reshape(n, -1, 6)
    squares = np.maximum(np.einsum("nfi,fij,nfj->nf", by_frame, blocks, by_frame, optimize=True), 0.0)
    most = squares.argmax(axis=1)
    share = np.einsum("nii->n", hat) / max(int(known.sum()), 1)
    names, seconds = list(model.frames), model.seconds
    for i, first in enumerate(rows[:, 0].tolist()):
        frame = int(most[i])
        yield ImageContribution(
            sensor=model.pairs[model.pair[first]].sensor,
            targets=tuple(model.pairs[pair].target for pair in model.pair[rows[i]].tolist()),
            time=float(seconds[first]),
            stamp_ns=None if model.stamps_ns is None else int(model.stamps_ns[first]),
            share=float(share[i]),
            moved=float(np.sqrt(squares[i, frame])),
            moved_frame=names[frame],
            moved_mm=1e3 * float(np.linalg.norm(by_frame[i, frame, 3:])),
            growth=float(growth[i]),
        )


def _inverse_root(matrix: Array) -> Array:
    """W (m, m) with W' W = matrix^-1.

    Where only this image tells something, a direction is lost without it: its eigenvalue is zero up to rounding.
    """
    factor, failed = dpotrf(matrix, lower=1)
    root: Array = dtrtri(factor, lower=1)[0]
    if not failed and (root**2).sum() * LOST < 1.0:  # then no eigenvalue is smaller
        return root
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors / np.sqrt(np.maximum(values, LOST))).T)


def _chosen(model: LinearModel, J: Array, covariance: Array, images: list[np.ndarray]) -> list[float]:
    """The largest growth of a standard deviation after each image, if the most informative image comes next each time.

    The gain of the information's log det falls as images are added, so an image whose old gain is below another's new
    one need not be looked at again.
    """
    whole, unit = equilibrated(model.information(J, model.used))
    least = covariance / unit[:, None] / unit
    free = np.eye(len(whole)) - least @ whole  # along these directions nothing is known
    if np.trace(free) < 0.5:
        free = np.zeros_like(free)
    known = np.diagonal(free) < 1.0 - FREE_SHARE
    order = EliminationOrder.of(whole + free)
    each = (model.information(J, np.isin(np.arange(len(J)), rows)) for rows in images)
    parts = [order.split(one * unit[:, None] * unit) for one in each]
    now = order.split(BEGIN * whole + free)
    gains, log_det = [(-np.inf, i) for i in range(len(parts))], now.inverse().log_det
    heapq.heapify(gains)
    curve = []
    while gains:
        while True:
            _, i = heapq.heappop(gains)
            inverse = (now + parts[i]).inverse()
            gain = inverse.log_det - log_det
            if not gains or -gain <= gains[0][0]:
                break
            heapq.heappush(gains, (-gain, i))
        now, log_det = inverse.of, inverse.log_det
        ratio = (inverse.diagonal - np.diagonal(free))[known] / np.diagonal(least)[known]
        curve.append(float(np.sqrt(ratio.max(initial=1.0)) - 1.0))
    return curve


def _fewer(curve: list[float], growth: float) -> Fewer:
    enough = next((i + 1 for i, value in enumerate(curve) if value <= growth), len(curve))
    return Fewer(growth=growth, bundles=enough)
