"""One registration of all views: their poses about the thing, by points to planes and edges, robust; GTSAM solves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.clouds.point_to_plane import SHARED_BY_VIEWS, joined, known, matches, sigmas, units
from gtsam_rwhec.clouds.registration import Registrations
from gtsam_rwhec.clouds.surfaces import Surface
from gtsam_rwhec.geometry.poses import Array

#: Times that points are matched anew.
ROUNDS = 4
#: Poses that move less than this (share of the spacing, at the thing) have settled.
SETTLED = 1e-3
#: Huber's constant for six dimensions.
HUBER = 1.869

noise = gtsam.noiseModel


@dataclass(frozen=True)
class JointPoses:
    """Poses T_common_sensor (N, 4, 4), their covariances (N, 6, 6; right perturbation, rotation first), and the
    deviations (2,) of the residuals of faces and of edges, m."""

    T_common_sensor: Array
    covariances: Array
    sigma_m: Array


def _square_root(information: Array) -> Array:
    """R with R'R = information, which may be singular."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)


def _solved(
    start: Array, i: np.ndarray, j: np.ndarray, T_i_j: Array, roots: Array, weak: Array, *, robust: bool
) -> Array:
    """Poses of a graph of relative poses, about weak priors at the start."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (pose, covariance) in enumerate(zip(start, weak, strict=True)):
        values.insert(k, gtsam.Pose3(pose))
        graph.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(pose), noise.Gaussian.Covariance(covariance)))
    for a, b, T, root in zip(i, j, T_i_j, roots, strict=True):
        gaussian = noise.Gaussian.SqrtInformation(root)
        loss = noise.mEstimator.Huber.Create(HUBER)
        model = noise.Robust.Create(loss, gaussian) if robust else gaussian
        graph.add(gtsam.BetweenFactorPose3(int(a), int(b), gtsam.Pose3(T), model))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.array([solved.atPose3(k).matrix() for k in range(len(start))])


def joint_poses(surfaces: Sequence[Surface], predicted: Array, pairs: Registrations, gate_m: float) -> JointPoses:
    """Poses of all views at once.

    First a graph of the registrations, in which a wrong one does not count (Huber); then points are matched at the
    poses of the whole, and each pair gives a quadratic of its relative pose (Gauss-Newton), until poses have settled.
    Directions in which nothing is known stay as predicted (N, 4, 4).
    """
    unit = [units(each.faces.points) for each in surfaces]
    weak = np.array([size**2 * U @ U.T for U, size in unit])
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
        before, poses = poses, _solved(poses, i[at], j[at], measured, roots, weak, robust=False)
        moved = np.linalg.solve(np.array([U for U, _ in unit]), se3.logmap(se3.inverse(before) @ poses)[..., None])
        if np.abs(moved).max() < SETTLED * gate_m:
            break
    return JointPoses(poses, _covariances(surfaces, poses, i, j, gate_m, sigma_m), sigma_m)


def _covariances(
    surfaces: Sequence[Surface], poses: Array, i: np.ndarray, j: np.ndarray, gate_m: float, sigma_m: Array
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
        result.append(known(found, sigma_m, counts * share, SHARED_BY_VIEWS).covariance)
    return np.array(result)
