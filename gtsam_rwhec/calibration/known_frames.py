"""What an answer knows and what it does not, by name: poses known to nothing, heights of a vehicle, relative poses.

A covariance is of first order. Where it says 40 degrees, or more metres than a target was away, the pose is no
knowledge, whatever the residuals are. Frames of one carrier may still be known in one another: two cameras that see the
same targets, on a body whose path drifts or turns too little.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from gtsam_rwhec.calibration.point_uncertainty import Carriers, SensorView
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.files.terminal_text import rounded, some
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.free_directions import all_slide

#: Of standard deviations, the largest about and along any axis that a pose may have; the second one, metres, is the
#: median distance of what was seen where that is known.
MOST_RAD, MOST_M = float(np.radians(30.0)), 1.0
#: A relative pose is known if its deviations are below this share of those.
KNOWN = 0.1
#: Words name at most so many frames.
MOST_NAMED = 5
#: The carriers turn about one axis if they turn about no other one by more than this share.
ONE_AXIS = 0.2
#: That axis is the vertical of a vehicle within this angle of z.
VERTICAL_RAD = float(np.radians(10.0))
#: A height is weak if its deviation is so many times those along the ground, and not small, metres.
WEAK, WEAK_M = 3.0, 0.02


def of_knowledge(
    problem: Problem,
    inliers: Mapping[Pair, np.ndarray],
    refined: Refined,
    views: Mapping[str, SensorView],
    carriers: Carriers,
) -> list[Finding]:
    """The findings: frames that are known to nothing, and free or weak heights; what is known all the same."""
    most_m, is_seen = _most_m(views)
    findings = list(_known_to_nothing(refined, most_m, carriers, is_seen=is_seen))
    if findings or not all_slide(refined.free_directions):
        ground = Ground.KNOWN_TO_NOTHING if findings else Ground.NOT_UNIQUE
        findings += known_all_the_same(refined, views, ground)
    return [*findings, *_heights(problem, inliers, refined, carriers)]


def known_all_the_same(refined: Refined, views: Mapping[str, SensorView], ground: Ground) -> list[Finding]:
    """The finding that names what is known beside what is not, under the ground of that; empty if nothing is."""
    known = list(_known(refined, _most_m(views)[0]))
    if not known:
        return []
    are = "is" if len(known) == 1 else "are"
    return [Finding(ground, f"known all the same {are} {some(known, MOST_NAMED)} (standard deviations)")]


def _most_m(views: Mapping[str, SensorView]) -> tuple[float, bool]:
    """The largest deviation that a position may have, metres, and whether it is the distance of what was seen."""
    seen_m = [float(np.linalg.norm(view.point_m)) for view in views.values()]
    return (float(np.median(seen_m)), True) if seen_m else (MOST_M, False)


def deviations_of(covariance: Array) -> tuple[float, float]:
    """The largest standard deviations of a right perturbation (6, 6), about and along any axis: rad, m."""
    if not np.isfinite(covariance).all():
        return np.inf, np.inf
    about, along = (float(np.linalg.eigvalsh(covariance[at, at])[-1]) for at in (slice(0, 3), slice(3, 6)))
    return float(np.sqrt(max(about, 0.0))), float(np.sqrt(max(along, 0.0)))


def _known_to_nothing(refined: Refined, most_m: float, carriers: Carriers, *, is_seen: bool) -> Iterator[Finding]:
    """A finding for each carrier's frames whose finite deviations are those of no knowledge."""
    for side, poses in (("sensor", refined.Y), ("target", refined.X)):
        found = {name: deviations_of(refined.covariance(name)) for name in poses if name in refined.names}
        bad = {
            name: (rad, m)
            for name, (rad, m) in found.items()
            if np.isfinite(rad + m) and (rad > MOST_RAD or m > most_m)
        }
        if bad:
            rad, m = (max(of) for of in zip(*bad.values(), strict=True))
            than = f"{most_m:.2g} m, from which targets were seen" if is_seen else f"{most_m:g} m"
            yield Finding(
                Ground.KNOWN_TO_NOTHING,
                f"{some(list(bad), MOST_NAMED)} on {carriers.of(side) or f'the carrier of the {side}s'} "
                f"{'is' if len(bad) == 1 else 'are'} known to nothing: standard deviations are up to "
                f"{rounded(1e3 * m)} mm and {rounded(float(np.degrees(rad)))} degrees (a pose has less than {than}, "
                f"and less than {np.degrees(MOST_RAD):g} degrees)",
            )


def _known(refined: Refined, most_m: float) -> Iterator[str]:
    """The frames of each carrier that are known in the first one, in words."""
    for poses in (refined.Y, refined.X):
        first, *others = [name for name in poses if name in refined.names] or [""]
        for name in others:
            rad, m = deviations_of(refined.relative(first, name)[1])
            if rad < KNOWN * MOST_RAD and m < KNOWN * most_m:
                yield f"{name} in {first} to {rounded(1e3 * m)} mm and {rounded(float(np.degrees(rad)))} degrees"


def _heights(
    problem: Problem, inliers: Mapping[Pair, np.ndarray], refined: Refined, carriers: Carriers
) -> Iterator[Finding]:
    """Sensors whose height the motion of a vehicle does not tell, or hardly: it turns about its vertical alone."""
    axes = vertical_axes(problem, inliers)
    vehicle = carriers.sensors or "the vehicle"
    for name, axis in axes.items():
        if name not in refined.Y or name not in refined.names:
            continue
        R = refined.Y[name].rotation().matrix()
        along = axis @ R
        frame = np.linalg.svd(along[None])[2]  # the first row is along the axis
        frame[0] = along
        J = np.hstack([np.zeros((3, 3)), frame])
        variances = np.diagonal(refined.covariance_of({name: J}))
        turned = f"since it turns about its vertical alone (z of {vehicle})"
        if not np.isfinite(variances[0]):
            yield Finding(Ground.NOT_UNIQUE, f"the height of {name} on {vehicle} is free, {turned}")
        elif variances[0] > max(WEAK**2 * variances[1:].mean(), WEAK_M**2):
            height = float(axis @ refined.Y[name].translation())
            deviation, ground = np.sqrt([variances[0], variances[1:].mean()]).tolist()
            yield Finding(
                Ground.HEIGHT_WEAK,
                f"the height of {name} on {vehicle} is {height:.3g} +- {rounded(deviation)} m, and hardly told by the "
                f"motion, {turned}; along the ground it is known to {rounded(1e3 * ground)} mm",
            )


def vertical_axes(problem: Problem, inliers: Mapping[Pair, np.ndarray]) -> dict[str, Array]:
    """By sensor, the vertical (3,) of its carrier in the carrier's axes, where it turns about that axis alone."""
    turns: dict[str, list[Array]] = {}
    if not problem.has_measurements or problem.fixed or problem.priors:
        return {}
    for pair in problem.pairs:
        A = problem.measurements(*pair).A
        A = A[inliers[pair]] if pair in inliers else A
        if len(A) > 2:
            rotations = Rotation.from_matrix(A[:, :3, :3])
            if not pair.is_motion:
                rotations = rotations * rotations[0].inv()
                rotations = rotations * rotations.mean().inv()
            turns.setdefault(pair.sensor, []).append(rotations.as_rotvec())
    found = {}
    for name, each in turns.items():
        every = np.concatenate(each)
        values, vectors = np.linalg.eigh(every.T @ every / len(every))
        axis = vectors[:, -1] * np.sign(vectors[2, -1] or 1.0)
        spread = np.sqrt(np.maximum(values, 0.0))
        if spread[1] < ONE_AXIS * spread[2] and axis[2] > np.cos(VERTICAL_RAD):
            found[name] = axis
    return found
