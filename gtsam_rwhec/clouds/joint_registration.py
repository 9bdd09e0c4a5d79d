"""One registration of all views: their poses about the thing, by points to planes and edges, robust; GTSAM solves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.clouds.point_to_plane import (
    SHARED_BY_GROUPS,
    SHARED_BY_VIEWS,
    alike,
    joined,
    known,
    matches,
    sigmas,
    units,
)
from gtsam_rwhec.clouds.registration import Registrations
from gtsam_rwhec.clouds.surfaces import Surface
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.directions import SEEN

#: Times that points are matched anew.
ROUNDS = 4
#: Poses that move less than this (share of the spacing, at the thing) have settled.
SETTLED = 1e-3
#: Groups of views err together where all know a direction so many times worse than each among the others.
LOOSE = 1.3
#: Rounding, in shares of what each view among the others knows.
NOTHING = 1e-9
#: A fit of some numbers ends with a step that is this small beside their deviations.
STILL, MOST_STEPS = 1e-6, 20
#: Variances of predicted poses, in those of A: a prior that leaves residuals of A as they are.
WEAK = 9.0
#: All points of a view are off together by this share of the gate, however little noise they have.
OF_EACH_VIEW = 0.0025
#: Huber's constant for six dimensions.
HUBER = 1.869

noise = gtsam.noiseModel


@dataclass(frozen=True)
class JointPoses:
    """Poses of all views, and what is known of them (right perturbations, rotation first)."""

    T_common_sensor: Array  #: (N, 4, 4)
    alone: Array  #: (N, 6, 6): Covariances of each among the others
    groups: Array  #: (N, 6, m): How errors of groups of views move them, one standard deviation each
    sigma_m: Array  #: (2,): Of the residuals of faces and of edges
    alike_m: float  #: What neighbouring points are off by together

    @property
    def covariances(self) -> Array:
        """(N, 6, 6): Such that independent views claim no more than all together know.

        For any shares p_k that sum to one, g g' of one error of groups is no more than the block diagonal
        g_k g_k' / p_k. Here p_k ~ |g_k| in units of what the view knows alone.
        """
        lengths = np.sqrt(
            np.maximum(np.einsum("nim,nij,njm->nm", self.groups, np.linalg.inv(self.alone), self.groups), 0.0)
        )
        shares = np.where(lengths > 0.0, lengths.sum(axis=0) / np.maximum(lengths, 1e-12), 0.0)
        return np.asarray(self.alone + np.einsum("nim,njm,nm->nij", self.groups, self.groups, shares))


def _square_root(information: Array) -> Array:
    """R with R'R = information, which may be singular."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)


def _solved(
    predicted: Array, i: np.ndarray, j: np.ndarray, T_i_j: Array, roots: Array, weak: Array, *, robust: bool
) -> Array:
    """Poses of a graph of relative poses and weak priors."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (pose, covariance) in enumerate(zip(predicted, weak, strict=True)):
        values.insert(k, gtsam.Pose3(pose))
        graph.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(pose), noise.Gaussian.Covariance(covariance)))
    for a, b, T, root in zip(i, j, T_i_j, roots, strict=True):
        gaussian = noise.Gaussian.SqrtInformation(root)
        loss = noise.mEstimator.Huber.Create(HUBER)
        model = noise.Robust.Create(loss, gaussian) if robust else gaussian
        graph.add(gtsam.BetweenFactorPose3(int(a), int(b), gtsam.Pose3(T), model))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.array([solved.atPose3(k).matrix() for k in range(len(predicted))])


def joint_poses(
    surfaces: Sequence[Surface], predicted: Array, of_A: Array, pairs: Registrations, gate_m: float, noise_m: float
) -> JointPoses:
    """Poses of all views at once.

    First a graph of the registrations, in which a wrong one does not count (Huber); then points are matched at the
    poses of the whole, and each pair gives a quadratic of its relative pose (Gauss-Newton), until poses have settled.
    Directions in which little is known stay as predicted (N, 4, 4), by A with variances (6,): edges may match wrongly.
    ``noise_m`` is that of points along their rays.
    """
    unit = [units(each.faces.points) for each in surfaces]
    weak = np.array([gate_m**2 * U @ U.T for U, _ in unit]) + WEAK * np.diag(of_A)
    roots = np.array([_square_root(each) for each in pairs.information])
    poses = _solved(predicted, pairs.i, pairs.j, pairs.B, roots, weak, robust=True)
    i, j = pairs.i, pairs.j
    for _ in range(ROUNDS):
        T = se3.inverse(poses[i]) @ poses[j]
        several = [matches(surfaces[b], surfaces[a], M, gate_m) for a, b, M in zip(i, j, T, strict=True)]
        at = [k for k, each in enumerate(several) if each.overlap > 0.0]
        sigma_m = sigmas([several[k] for k in at], gate_m)
        tell = [known(several[k], sigma_m) for k in at]
        measured = T[at] @ se3.expmap(np.array([each.step for each in tell]))
        roots = np.array([_square_root(each.information) for each in tell])
        before, poses = poses, _solved(predicted, i[at], j[at], measured, roots, weak, robust=False)
        moved = np.linalg.solve(np.array([U for U, _ in unit]), se3.logmap(se3.inverse(before) @ poses)[..., None])
        if np.abs(moved).max() < SETTLED * gate_m:
            break
    of_faces = alike(float(sigma_m[0]), noise_m)
    of_view = np.hypot(of_faces, OF_EACH_VIEW * gate_m) / sigma_m[0]
    by_views, by_groups = (
        (float(np.hypot(faces, of_view)), edges) for faces, edges in (SHARED_BY_VIEWS, SHARED_BY_GROUPS)
    )
    alone = _covariances(surfaces, poses, i, j, gate_m, sigma_m, by_views)
    count = np.bincount(np.r_[i[at], j[at]], minlength=len(surfaces))
    # The same points, and what they are off by together, are in many pairs.
    many = (count[i[at]] + count[j[at]] + 2) / 4.0
    of_pairs = [
        known(several[k], sigma_m, n, (np.sqrt(n) * by_groups[0], np.sqrt(n) * by_groups[1])).information
        for k, n in zip(at, many.tolist(), strict=True)
    ]
    groups = of_groups(poses, i[at], j[at], np.array(of_pairs), np.array([U for U, _ in unit]))
    return JointPoses(poses, alone, groups, sigma_m, of_faces)


def of_groups(poses: Array, i: np.ndarray, j: np.ndarray, information: Array, unit: Array) -> Array:
    """How errors that groups of views have together move them, (N, 6, m), beyond what each tells beside the others.

    The views of one side of a box know each other well, and those of the other side little: its width is told by edges
    alone. With C the covariance of all poses and D that of each view among the others, D^-1/2 C D^-1/2 then has large
    eigenvalues. Where they are at most ``LOOSE``, nothing is added.
    """
    N = len(unit)
    T_i_j = se3.inverse(poses[i]) @ poses[j]
    to = np.concatenate([-se3.adjoint(se3.inverse(T_i_j)) @ unit[i], unit[j]], axis=2)
    parts = to.transpose(0, 2, 1) @ information @ to
    whole = np.zeros((N, N, 6, 6))
    for rows, a in ((slice(0, 6), i), (slice(6, 12), j)):
        for columns, b in ((slice(0, 6), i), (slice(6, 12), j)):
            np.add.at(whole, (a, b), parts[:, rows, columns])
    values, along = np.linalg.eigh(whole[np.arange(N), np.arange(N)])
    known_at_all = values > SEEN * values[:, -1:]
    roots = along * np.where(known_at_all, np.abs(values), np.inf)[:, None, :] ** -0.5
    white = np.einsum("aki,abkl,blj->aibj", roots, whole, roots).reshape(6 * N, 6 * N)
    # All views together may be anywhere: the thing's own pose is free.
    anywhere = np.sqrt(np.where(known_at_all, values, 0.0))[:, :, None] * (
        along.transpose(0, 2, 1) @ np.linalg.solve(unit, se3.adjoint(se3.inverse(poses)))
    )
    free = np.linalg.svd(anywhere.reshape(6 * N, 6), full_matrices=False)[0]
    told, modes = np.linalg.eigh(white + free @ free.T)
    loose = (told > NOTHING) & (told < 1.0 / LOOSE)
    w = modes[:, loose].reshape(N, 6, -1)
    return np.asarray(unit @ roots @ w * np.sqrt(1.0 / told[loose] - 1.0))


def fitted(
    A: Array, B: Array, covariances: Array, groups: Array, of_A: Array, T_frame_sensor: Array, Y: Array
) -> tuple[Array, Array]:
    """Poses of a thing without the errors that groups of views have together, and how what is left of these moves Y.

    A X exp(x) = Y exp(y) F^-1 exp(n) F B exp(G z + b): n has the variances ``of_A`` (6,) in the frames F (N, 4, 4), b
    the covariances of B (N, 6, 6), and z, by which G (N, 6, m) moves the views, 1 each. Least squares has them all, and
    B exp(G z) is given. At this z, Y lacks of its covariance the squares of its moves (6, 6) by z's uncertainty.
    """
    z, X = np.zeros(groups.shape[2]), se3.inverse(A[:1])[0] @ Y @ B[0]
    for _ in range(MOST_STEPS):
        M = B @ se3.expmap(groups @ z)
        back, of_n = se3.adjoint(se3.inverse(M)), se3.adjoint(se3.inverse(T_frame_sensor @ M))
        residual = se3.logmap(se3.inverse(M) @ se3.inverse(Y) @ A @ X)
        J = np.concatenate([-back, np.broadcast_to(np.eye(6), back.shape), -groups], axis=2)
        weighted = np.linalg.solve(covariances + of_n * of_A @ of_n.transpose(0, 2, 1), J)
        information = np.einsum("nia,nib->ab", J, weighted)
        information[12:, 12:] += np.eye(len(z))
        gradient = np.einsum("nia,ni->a", weighted, residual) + np.r_[np.zeros(12), z]
        known = np.linalg.pinv(information, hermitian=True)
        step = -known @ gradient
        Y, X = Y @ se3.expmap(step[None, :6])[0], X @ se3.expmap(step[None, 6:12])[0]
        z = z + step[12:]
        if np.abs(information @ step @ step) < STILL**2:
            break
    by_z = np.linalg.pinv(information[:12, :12], hermitian=True)[:6] @ information[:12, 12:]
    values, along = np.linalg.eigh(by_z @ known[12:, 12:] @ by_z.T)
    return B @ se3.expmap(groups @ z), along * np.sqrt(np.maximum(values, 0.0))


def _covariances(
    surfaces: Sequence[Surface],
    poses: Array,
    i: np.ndarray,
    j: np.ndarray,
    gate_m: float,
    sigma_m: Array,
    shared: tuple[float, float],
) -> Array:
    """Of each view among the others: each of its points counts once, however many views it is seen in."""
    result = []
    for view, surface in enumerate(surfaces):
        others = np.r_[i[j == view], j[i == view]]
        T = se3.inverse(poses[others]) @ poses[view]
        found = joined([matches(surface, surfaces[k], each, gate_m) for k, each in zip(others, T, strict=True)])
        counts = np.bincount(found.at)[found.at]
        # A residual has the noise of two points, the view's own and the other's; of the others there are many.
        share = (1.0 + 1.0 / len(others)) / 2.0
        result.append(known(found, sigma_m, counts * share, shared).covariance)
    return np.array(result)
