"""Requests made without ``solve``, and answers as gtsam.Pose3."""

from gtsam_rwhec.geometry.poses import to_pose3
from gtsam_rwhec.methods.hand_eye_request import Request
from gtsam_rwhec.methods.motions import cost_of, motions_of


def request_of(C, H, alpha=1.0, weights=None, covariances=None, prior=None, scale="known", rng=None):
    motions = motions_of(C, H)
    cost = cost_of(motions, alpha, weights, covariances)
    if prior is not None:
        cost = prior.added_to(cost)
    return Request(motions, cost, alpha, weights, covariances, prior, scale, rng)


def pose(X):
    return to_pose3(X[:3, :3], X[:3, 3])
