"""Registrations of pairs of views, each with the information that it has, and which pairs overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from rwhec_factors import se3
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gtsam_rwhec.clouds.point_to_plane import known, matches, sigmas, told_of_stretch
from gtsam_rwhec.clouds.surfaces import Surface
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.geometry.poses import Array

with extra_named():
    import small_gicp

#: Views overlap if they share at least this part of the points of one.
OVERLAP = 0.2
#: Points by which an overlap is estimated before registration.
PROBED = 64
#: So many pairs of a view are registered where the views are many; all pairs of few views.
PAIRS_EACH = 8
ALL_PAIRS_TO = 10
#: Steps of points to planes after GICP, which ends before edges are in place.
STEPS = 5
#: A step is the last if it moves points by less than this share of the gate.
SETTLED = 2e-2
#: No more pairs than this are looked at for their overlap.
MOST_PROBED = 20_000


@dataclass(frozen=True)
class Registrations:
    """P registrations of views j to views i, each a motion of the sensor: ``problem.add_motion(sensor, A, B, ...)``.

    Attributes
    ----------
    i, j : (P,) integers
        The views.
    A : (P, 4, 4)
        The carrier's motion T_before_after, A_i A_j^-1.
    B : (P, 4, 4)
        The sensor's motion T_i_j: the pose of sensor j in the frame of sensor i, metres.
    information : (P, 6, 6)
        Of a right perturbation of B, rotation first; zero along what slides.
    covariances : (P, 6, 6)
        The same inverted, with a variance of 100 (rad^2, m^2) where it slides.
    overlap : (P,)
        The share of the points of j that lie on i.
    of_stretch : (P, 3)
        As `told_of_stretch`.
    """

    i: np.ndarray
    j: np.ndarray
    A: Array
    B: Array
    information: Array
    covariances: Array
    overlap: Array
    of_stretch: Array

    def __len__(self) -> int:
        return len(self.i)

    def selected(self, mask: np.ndarray) -> Registrations:
        """The registrations where ``mask`` (P,) is true."""
        return Registrations(*(getattr(self, part.name)[mask] for part in fields(self)))

    def renamed(self, names: np.ndarray) -> Registrations:
        """The same, with view k as ``names[k]``."""
        return replace(self, i=names[self.i], j=names[self.j])


def overlapping_pairs(surfaces: Sequence[Surface], poses: Array, gate_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs i < j of views that overlap at predicted poses T_common_sensor (N, 4, 4): all, or some of many views."""
    i, j = np.triu_indices(len(surfaces), 1)
    draw = np.random.default_rng(0)
    if len(i) > MOST_PROBED:
        at = np.sort(draw.permutation(len(i))[:MOST_PROBED])
        i, j = i[at], j[at]
    probes = [s.faces.points[draw.integers(0, len(s.faces.points), PROBED)] for s in surfaces]
    T = se3.inverse(poses[i]) @ poses[j]
    overlap = np.zeros(len(i))
    for k, (a, b, M) in enumerate(zip(i.tolist(), j.tolist(), T, strict=True)):
        distances, _ = surfaces[a].faces.nearest(probes[b] @ M[:3, :3].T + M[:3, 3], gate_m)
        overlap[k] = np.isfinite(distances).mean()
    enough = overlap >= OVERLAP
    i, j, overlap = i[enough], j[enough], overlap[enough]
    if len(surfaces) <= ALL_PAIRS_TO:
        return i, j
    chosen = np.zeros(len(i), dtype=bool)
    for view in range(len(surfaces)):
        # The best half, which hold; and others, which keep errors from adding up along a chain of neighbours.
        mine = np.flatnonzero((i == view) | (j == view))
        mine = mine[np.argsort(-overlap[mine])]
        chosen[mine[: PAIRS_EACH // 4]] = True
        rest = mine[PAIRS_EACH // 4 :]
        chosen[draw.permutation(rest)[: PAIRS_EACH // 4]] = True
    return i[chosen], j[chosen]


def aligned(surfaces: Sequence[Surface], i: int, j: int, T_i_j: Array, gate_m: float) -> Array:
    """T_i_j (4, 4) by GICP from a start."""
    result = small_gicp.align(
        surfaces[i].native,
        surfaces[j].native,
        surfaces[i].native_tree,
        init_T_target_source=T_i_j,
        registration_type="GICP",
        max_correspondence_distance=gate_m,
        rotation_epsilon=1e-4,
        translation_epsilon=1e-5,
    )
    return np.asarray(result.T_target_source)


def registered(
    surfaces: Sequence[Surface], A: Array, i: np.ndarray, j: np.ndarray, starts: Array, predicted: Array, gate_m: float
) -> Registrations:
    """Registrations of pairs from starts (P, 4, 4) by points to planes and edges.

    Where a pair slides, it lies as predicted (P, 4, 4). Pairs that turn out not to overlap are left out.
    """
    T = starts
    for _ in range(STEPS):
        several = [matches(surfaces[b], surfaces[a], each, gate_m) for a, b, each in zip(i, j, T, strict=True)]
        enough = np.array([each.overlap >= OVERLAP / 2.0 for each in several], dtype=bool)
        i, j, T, predicted = i[enough], j[enough], T[enough], predicted[enough]
        several = [each for each, yes in zip(several, enough, strict=True) if yes]
        sigma_m = sigmas(several, gate_m)
        # A point that many pairs have is still one point; a residual has the noise of two.
        degrees = np.bincount(np.r_[i, j], minlength=len(surfaces))
        tell = [known(m, sigma_m, (degrees[a] + degrees[b] + 2) / 4.0) for m, a, b in zip(several, i, j, strict=True)]
        if not tell:
            break
        guesses = se3.logmap(se3.inverse(T) @ predicted)
        steps = np.array([t.step + t.of_guess @ guess for t, guess in zip(tell, guesses, strict=True)])
        T = T @ se3.expmap(steps)
        reach = np.array([np.linalg.norm(surfaces[b].faces.points.mean(axis=0)) for b in j])
        moved = np.linalg.norm(steps[:, :3], axis=1) * reach + np.linalg.norm(steps[:, 3:], axis=1)
        if moved.max() < SETTLED * gate_m:
            break
    return Registrations(
        i,
        j,
        A[i] @ se3.inverse(A[j]),
        T,
        np.array([t.information for t in tell]).reshape(-1, 6, 6),
        np.array([t.covariance for t in tell]).reshape(-1, 6, 6),
        np.array([m.overlap for m in several]),
        np.array([told_of_stretch(m, each, sigma_m) for m, each in zip(several, T, strict=True)]).reshape(-1, 3),
    )


def largest_group(count: int, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Which of the views (count,) belong to the largest group that pairs connect."""
    graph = coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(labels == np.bincount(labels).argmax())
