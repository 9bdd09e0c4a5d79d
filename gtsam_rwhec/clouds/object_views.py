"""Anything that stands still before a 3D sensor as a target: its pose in each view, from clouds alone."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain, islice

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.first_registration import Start, first_poses
from gtsam_rwhec.clouds.joint_registration import JointPoses, joint_poses
from gtsam_rwhec.clouds.moved_views import move_of
from gtsam_rwhec.clouds.point_to_plane import units
from gtsam_rwhec.clouds.registration import (
    Registrations,
    aligned,
    largest_group,
    overlapping_pairs,
    registered,
)
from gtsam_rwhec.clouds.surfaces import FEWEST_POINTS, FINER, Spacing, Surface, spacing_of, surface_of
from gtsam_rwhec.errors import CloudError, RwhecWarning
from gtsam_rwhec.geometry.poses import Array, PoseLike, PosesLike, as_transforms, one_transform
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.certificate import Status
from gtsam_rwhec.solver.solution import solve

#: Fewer views leave the sensor's pose on its carrier free.
FEWEST_VIEWS = 3
#: Rounds of registrations and certified solutions.
ROUNDS = 4
#: Gates of GICP, and of points to planes after it, in spacings.
WIDE, GATE = 4.0, 2.0
#: A round is the last if predicted poses move by less than this share of the spacing.
STILL = 0.05
#: Added to variances (rad^2, m^2): arms and registrations are no better.
TINY = 1e-12
#: If the thing was elsewhere in a larger share of the views, nobody knows where it was.
MOST_MOVED = 0.25
#: Registrations that differ from the poses by more than this share of the thing's size are none of this thing.
CONTRADICTION = 0.15
#: The spacing is taken from this many views.
SPACED = 9
#: The name of the sensor in problems of motions.
SENSOR = "sensor"


@dataclass(frozen=True)
class ObjectOptions:
    """Options of `seen_object` and `motions`; the defaults leave every choice to the clouds."""

    #: T_sensorcarrier_sensor, roughly, where the clouds alone leave a choice. None: it is searched for.
    start: PoseLike | None = None
    #: Distance (m) of neighbouring points after thinning. None: about 3000 points a view.
    spacing_m: float | None = None


class ViewFault(StrEnum):
    """What is wrong with a view."""

    #: It overlaps no other view where the carrier's pose puts it.
    APART = "apart"
    #: It shows the thing elsewhere than the carrier's pose and all other views do.
    MOVED = "moved"
    #: Too few of its points are left to tell a pose.
    FEW_POINTS = "few_points"


@dataclass(frozen=True)
class ViewFinding:
    """A view that is left out, and why (the thing was ``off_m`` elsewhere); ``str()`` is a sentence."""

    view: int
    name: str
    fault: ViewFault
    off_m: float = 0.0
    neighbours: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.fault is ViewFault.MOVED:
            return (
                f"{self.name} shows the thing {1e3 * self.off_m:.1f} mm from where its pose puts it: it was elsewhere in this "
                "view alone, or the pose is of another"
            )
        if self.fault is ViewFault.FEW_POINTS:
            return f"{self.name} has too few points to tell a pose"
        return (
            f"{self.name} overlaps no view of the others where its pose puts it (nearest by rotation: "
            f"{', '.join(self.neighbours)}): it sees another side, the thing moved, or the pose is of another view"
        )


@dataclass(frozen=True, eq=False)
class SeenObject:
    """A thing in N views: a target without a pattern.

    Attributes
    ----------
    A : (N, 4, 4)
        T_sensorcarrier_targetcarrier, as given.
    T_sensor_object : (N, 4, 4)
        Poses of the thing, metres; nan where a view is not used. The object's frame is turned as the target carrier, and
        its origin is where turns and shifts of its surface mix least: the centre of a sphere, the axis of a cylinder.
    covariances : (N, 6, 6)
        Of the same: right perturbation, rotation first; as large as the thing where its surface slides on itself.
    used : (N,) bool
        Which views are used.
    left_out : {view: ViewFinding}
        Why others are not.
    registrations : Registrations
        Of pairs of views.
    T_sensorcarrier_sensor : (4, 4)
        The certified answer of the registrations, in which noise of A is not modelled: ``calibrate`` gives a better one.
    is_certified : bool
        Whether it is.
    sigma_m : (2,)
        Deviations of points across faces and across edges, m; of residuals between two views.
    spacing_m : float
        Distance of neighbouring points after thinning.
    """

    A: Array
    T_sensor_object: Array
    covariances: Array
    used: np.ndarray
    left_out: Mapping[int, ViewFinding]
    registrations: Registrations
    T_sensorcarrier_sensor: Array
    is_certified: bool
    sigma_m: Array
    spacing_m: float

    def add_to(self, problem: Problem, target: str, sensor: str) -> None:
        """Add the views that are used to a problem, as measurements of a target."""
        used = self.used
        problem.add(
            target, sensor, self.A[used], self.T_sensor_object[used], covariances=self.covariances[used], directional=True, source="clouds"
        )


def seen_object(clouds: Iterable[Cloud], A: PosesLike, options: ObjectOptions | None = None) -> SeenObject:
    """A thing that stands still (or is held) as a target, from clouds of it: a pose in each view, with its covariance.

    Parameters
    ----------
    clouds : iterable of Cloud
        N views. Each is read once and thinned, so they need not be in memory together.
    A : (N, 4, 4) array or list of gtsam.Pose3
        T_sensorcarrier_targetcarrier of each view, metres: T_flange_base of a sensor on a robot's flange, T_base_flange of
        a fixed sensor that sees a thing on the flange.
    options : ObjectOptions, optional

    Raises
    ------
    CloudError
        There are too few views, they do not overlap where the poses put them, several poses of the sensor explain them
        equally well, or the poses are in another unit or belong to other views.

    Notes
    -----
    Views are registered in pairs (Segal et al. 2009, "Generalized-ICP"; small_gicp), in turn with the certified solution of
    the motions, and then all at once by points to planes and edges.
    """
    views, out = _prepared(clouds, A, options or ObjectOptions())
    registrations, Y, _ = _in_turn(views, options or ObjectOptions())
    together = largest_group(len(views.at), registrations.i, registrations.j)
    out += [_apart(views, k) for k in np.flatnonzero(~together)]
    kept, place = views.selected(together), np.cumsum(together) - 1
    if len(kept.at) < FEWEST_VIEWS:
        raise CloudError(f"only {len(kept.at)} views overlap each other: " + "; ".join(map(str, out)))
    inside = registrations.selected(together[registrations.i] & together[registrations.j]).renamed(place)
    joint = joint_poses(kept.surfaces, se3.inverse(kept.A) @ Y, inside, GATE * views.spacing.faces_m)
    origin = se3.pose(np.eye(3), _centre(kept.surfaces, joint.T_common_sensor))
    stays, Y, is_certified = _where_it_was(kept, joint, inside, origin)
    out += [_moved(kept, k, far) for k, far in stays.items()]
    B = se3.inverse(joint.T_common_sensor) @ origin
    turn = se3.adjoint(se3.inverse(B))
    covariances = turn @ joint.covariances @ turn.transpose(0, 2, 1)
    used = np.setdiff1d(np.arange(len(kept.at)), list(stays))
    transforms = as_transforms(A, None, "A")
    poses, of_poses = np.full((len(transforms), 4, 4), np.nan), np.full((len(transforms), 6, 6), np.nan)
    poses[kept.at[used]] = B[used]
    of_poses[kept.at[used]] = 0.5 * (covariances + covariances.transpose(0, 2, 1))[used]
    return SeenObject(
        transforms,
        poses,
        of_poses,
        np.isin(np.arange(len(transforms)), kept.at[used]),
        {each.view: each for each in sorted(out, key=lambda each: each.view)},
        registrations.renamed(views.at),
        Y,
        is_certified,
        joint.sigma_m,
        views.spacing.faces_m,
    )


def motions(clouds: Iterable[Cloud], A: PosesLike, options: ObjectOptions | None = None) -> Registrations:
    """Motions of a sensor by its clouds, for ``problem.add_motion(sensor, m.A, m.B, covariances=m.covariances)``.

    Arguments and errors as in `seen_object`, which is better where the sensor sees one thing: it registers all at once.
    """
    views, _ = _prepared(clouds, A, options or ObjectOptions())
    return _in_turn(views, options or ObjectOptions())[0].renamed(views.at)


@dataclass(frozen=True)
class _Views:
    """Views that have a surface: their places among all, surfaces, and A of these."""

    at: np.ndarray
    surfaces: Sequence[Surface]
    A: Array
    spacing: Spacing

    def selected(self, mask: np.ndarray) -> _Views:
        surfaces = [each for each, yes in zip(self.surfaces, mask, strict=True) if yes]
        return _Views(self.at[mask], surfaces, self.A[mask], self.spacing)


def _prepared(clouds: Iterable[Cloud], A: PosesLike, options: ObjectOptions) -> tuple[_Views, list[ViewFinding]]:
    """The surfaces of all views, and those that have too few points."""
    transforms = as_transforms(A, None, "A")
    given = iter(clouds)
    first = list(islice(given, SPACED))
    spacing = spacing_of([each.points for each in first]) if first else Spacing(0.0, 0.0)
    if options.spacing_m is not None:
        spacing = Spacing(options.spacing_m, spacing.edges_m and options.spacing_m / FINER)
    surfaces, few = [], []
    for view, cloud in enumerate(chain(first, given)):
        surface = surface_of(cloud, f"view {view}" + (f" ({cloud.source})" if cloud.source else ""), spacing)
        if len(surface.faces.points) < FEWEST_POINTS:
            few.append(ViewFinding(view, surface.name, ViewFault.FEW_POINTS))
        surfaces.append(surface)
    if len(surfaces) != len(transforms):
        raise CloudError(f"{len(surfaces)} clouds and {len(transforms)} poses in A; give one A for each cloud")
    at = np.setdiff1d(np.arange(len(surfaces)), [each.view for each in few])
    if len(at) < FEWEST_VIEWS:
        raise CloudError(
            f"{len(at)} views have {FEWEST_POINTS} points and more; at least {FEWEST_VIEWS} are needed, and about ten are good"
            + "".join(f"; {each}" for each in few)
        )
    return _Views(at, [surfaces[k] for k in at], transforms[at], spacing), few


def _in_turn(views: _Views, options: ObjectOptions) -> tuple[Registrations, Array, bool]:
    """Registrations of pairs and the certified pose of the sensor on its carrier, in turn until both are still."""
    spacing = views.spacing.faces_m
    Y = _first(views, options).T_sensorcarrier_sensor
    i, j = overlapping_pairs(views.surfaces, se3.inverse(views.A) @ Y, GATE * spacing)
    starts = np.zeros((0, 4, 4))
    is_certified = False
    for _ in range(ROUNDS):
        poses = se3.inverse(views.A) @ Y
        predicted = se3.inverse(poses[i]) @ poses[j]
        if not len(starts):
            tried = zip(i, j, predicted, strict=True)
            starts = np.array([aligned(views.surfaces, *pair, WIDE * spacing) for pair in tried])
        pairs = registered(views.surfaces, views.A, i, j, starts, predicted, GATE * spacing)
        if len(pairs) < FEWEST_VIEWS - 1:
            raise CloudError(_no_overlap(views, i, j))
        i, j, starts = pairs.i, pairs.j, pairs.B
        before = Y
        Y, is_certified = _certified(pairs, Y)
        moved = _at_middle(views, se3.inverse(views.A) @ (Y - before), np.arange(len(views.at)))
        if np.ptp(moved, axis=0).max() < STILL * spacing:
            break
    off = np.linalg.norm(_at_middle(views, poses[pairs.i] @ pairs.B - poses[pairs.j], pairs.j), axis=1)
    size = float(np.median([each.size_m for each in views.surfaces]))
    if np.median(off) > CONTRADICTION * size:
        raise CloudError(
            f"registrations of the clouds contradict the poses: they differ by {1e3 * np.median(off):.1f} mm (median of "
            f"{len(off)} pairs of views) for a thing of {1e3 * size:.0f} mm. Look whether the thing stood still, and whether "
            "A is T_sensorcarrier_targetcarrier with the right order of angles"
        )
    return pairs, Y, is_certified


def _certified(pairs: Registrations, Y: Array) -> tuple[Array, bool]:
    """The sensor's pose (4, 4) on its carrier by motions, and whether it is certified; ``Y`` is the one before."""
    off = se3.logmap(se3.inverse(pairs.B) @ se3.inverse(Y) @ pairs.A @ Y)
    # What A is off counts as well, and is the same in all directions.
    floor = np.median(off**2, axis=0).reshape(2, 3).mean(axis=1).repeat(3)
    problem = Problem()
    covariances = pairs.covariances + np.diag(floor + TINY)
    problem.add_motion(SENSOR, pairs.A, pairs.B, covariances=covariances, directional=True)
    with warnings.catch_warnings():
        # The caller's own problem is judged by `calibrate`, with A's noise.
        warnings.simplefilter("ignore", RwhecWarning)
        solution = solve(problem)
    return solution.Y[SENSOR].matrix(), solution.certificate.status is Status.CERTIFIED


def _where_it_was(
    views: _Views, joint: JointPoses, pairs: Registrations, origin: Array
) -> tuple[dict[int, float], Array, bool]:
    """Views in which the thing was elsewhere, with the distance (m); the certified pose of the sensor by the others.

    A CloudError says from which view on the thing was elsewhere, or that too many views contradict each other.
    """
    to_middle = se3.inverse(origin)
    unit = np.array([units(each.faces.points)[0] for each in views.surfaces])
    size = float(np.median([each.size_m for each in views.surfaces]))
    moved: dict[int, float] = {}
    Y = np.eye(4)
    for _ in views.at:
        still = ~np.isin(np.arange(len(views.at)), list(moved))
        chosen = pairs.selected(still[pairs.i] & still[pairs.j])
        Y, is_certified = _certified(chosen, Y)
        at = np.flatnonzero(still)
        predicted = se3.inverse(views.A[at]) @ Y
        move = move_of(to_middle @ joint.T_common_sensor[at], to_middle @ predicted, joint.covariances[at], unit[at], size)
        if move is None:
            break
        name = views.surfaces[at[move.first]].name
        if move.stays:
            raise CloudError(
                f"the thing moved by {1e3 * move.distance_m:.1f} mm before {name}, and stayed there: calibrate with the views "
                "before it, or with those from it on, or give each part a target of its own"
            )
        moved[int(at[move.first])] = move.distance_m
        if len(moved) > MOST_MOVED * len(views.at):
            raise CloudError(
                "views contradict each other in where the thing was: "
                + "; ".join(str(_moved(views, k, far)) for k, far in moved.items())
            )
    return moved, Y, is_certified


def _moved(views: _Views, view: int, off_m: float) -> ViewFinding:
    return ViewFinding(int(views.at[view]), views.surfaces[view].name, ViewFault.MOVED, off_m)


def _at_middle(views: _Views, change: Array, at: np.ndarray) -> Array:
    """How far (M, 3) changes of poses (M, 4, 4) move the middle of each view, m."""
    middle = np.array([each.faces.points.mean(axis=0) for each in views.surfaces])[at]
    return np.asarray(np.einsum("nij,nj->ni", change[:, :3, :3], middle) + change[:, :3, 3])


def _first(views: _Views, options: ObjectOptions) -> Start:
    """The one start that explains the clouds; a CloudError if there are none or several."""
    guess = None if options.start is None else one_transform(options.start, "ObjectOptions.start")
    spacing = views.spacing.faces_m
    found = first_poses(views.surfaces, views.A, spacing, guess)
    if not found[0].explains:
        raise CloudError(_unexplained(views, found[0].misfit))
    if len(found) > 1:
        words = "; ".join(
            f"translation {np.round(1e3 * each.T_sensorcarrier_sensor[:3, 3], 1)} mm, rotation vector "
            f"{np.round(np.degrees(se3.so3_logmap(each.T_sensorcarrier_sensor[None, :3, :3])[0]), 1)} degrees"
            for each in found
        )
        raise CloudError(
            f"{len(found)} poses of the sensor on its carrier explain the clouds equally well ({words}): the thing looks the "
            "same from several sides. State roughly where the sensor is (ObjectOptions.start), or take a thing without "
            "symmetry"
        )
    return found[0]


def _unexplained(views: _Views, misfit: float) -> str:
    """Words for poses that explain nothing: with the reading of them that would explain the clouds, if there is one."""
    shifted = {
        f"the poses belong to other views: shifted by {'one row' if by == 1 else 'minus one row'} they fit": np.roll(views.A, by, axis=0)
        for by in (1, -1)
    }
    scaled = {}
    for factor, unit in ((1e-3, "poses look like millimetres and clouds like metres"), (1e3, "clouds look like millimetres and poses like metres")):
        other = views.A.copy()
        other[:, :3, 3] *= factor
        scaled[f"{unit}: with A's translations times {factor:g} they fit"] = other
    readings = {**shifted, **scaled, "A is inverted: give T_sensorcarrier_targetcarrier": se3.inverse(views.A)}
    for words, A in readings.items():
        best = first_poses(views.surfaces, A, views.spacing.faces_m)[0]
        if best.explains and best.misfit < 0.6 * misfit:
            return words
    names = f"{views.surfaces[0].name} to {views.surfaces[-1].name}"
    return (
        f"{names}: at no pose of the sensor on its carrier do the clouds overlap (misfit {misfit:.2f}; 0 is perfect, 1 is "
        "apart). Look whether the thing stood still, whether A is T_sensorcarrier_targetcarrier with the right unit and order "
        "of angles, and whether neighbouring views share a third of what they see"
    )


def _no_overlap(views: _Views, i: np.ndarray, j: np.ndarray) -> str:
    pairs = ", ".join(f"{views.at[a]} and {views.at[b]}" for a, b in zip(i, j, strict=True))
    return f"views do not overlap where their poses put them (tried: {pairs or 'no pair shares a fifth of its points'})"


def _apart(views: _Views, view: int) -> ViewFinding:
    """The finding of a view that overlaps no other of the group."""
    turns = se3.so3_logmap((views.A @ se3.inverse(views.A[view]))[:, :3, :3])
    near = np.argsort(np.linalg.norm(turns, axis=1))[1:3]
    names = tuple(views.surfaces[k].name for k in near)
    return ViewFinding(int(views.at[view]), views.surfaces[view].name, ViewFault.APART, 0.0, names)


def _centre(surfaces: Sequence[Surface], poses: Array) -> Array:
    """The point (3,) about which turns and shifts of all surfaces mix least: sum |(p - c) x n|^2 is least."""
    points = np.concatenate([s.faces.points @ T[:3, :3].T + T[:3, 3] for s, T in zip(surfaces, poses, strict=True)])
    normals = np.concatenate([s.faces.normals @ T[:3, :3].T for s, T in zip(surfaces, poses, strict=True)])
    middle = points.mean(axis=0)
    across = len(points) * np.eye(3) - normals.T @ normals
    local = points - middle
    right = local.sum(axis=0) - normals.T @ np.einsum("ij,ij->i", normals, local)
    return np.asarray(middle + np.linalg.solve(across + 1e-3 * len(points) * np.eye(3), right))
