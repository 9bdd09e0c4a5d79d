"""Anything that stands still before a 3D sensor as a target: its pose in each view, from clouds alone."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.joint_registration import JointPoses, fitted, joint_poses
from gtsam_rwhec.clouds.moved_views import move_of
from gtsam_rwhec.clouds.point_to_plane import units
from gtsam_rwhec.clouds.registered_views import (
    FEWEST_VIEWS,
    GATE,
    ObjectOptions,
    ViewFault,
    ViewFinding,
    Views,
    certified_pose,
    check_agreement,
    first_pose,
    noise_of_A,
    prepared,
    registered_in_turn,
    stretch_of,
)
from gtsam_rwhec.clouds.registration import Registrations, largest_group
from gtsam_rwhec.clouds.surfaces import Spacing, Surface, size_of
from gtsam_rwhec.errors import CloudError, OutliersWarning
from gtsam_rwhec.geometry.poses import Array, PosesLike, as_transforms
from gtsam_rwhec.problem.directions import centre_of_slides, shifted_and_turned, with_common_slides
from gtsam_rwhec.problem.knowledge import Stretch
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem

#: Clouds are all shifted alike by this (standard deviation), in deviations of their points: noise along rays and edges
#: that are thinned move what every view sees in one direction, by 0.03 to 0.06 mm of 0.1 mm of noise.
SHIFTED = 0.3
#: And by this many squares of the deviation over the distance of points: noise that is large beside it bends normals,
#: and chooses wrong neighbours. By simulations of 1 to 3 mm of noise on things of 12 cm.
BENT = 2.0
#: And by this share of the distance of points, however little noise they have: normals bend over that distance.
FINEST = 0.01
#: If the thing was elsewhere in a larger share of the views, nobody knows where it was.
MOST_MOVED = 0.25


@dataclass(frozen=True, eq=False)
class SeenObject:
    """A thing in N views: a target without a pattern.

    Attributes
    ----------
    A : (N, 4, 4)
        T_sensorcarrier_targetcarrier, as given.
    T_sensor_object : (N, 4, 4)
        Poses of the thing, metres; nan where a view is not used. The object's frame is turned as the target carrier,
        and its origin is where turns and shifts of its surface mix least: a sphere's centre, a cylinder's axis.
    covariances : (N, 6, 6)
        Of the same: right perturbation, rotation first; of what slides 100 (rad^2, m^2).
    used : (N,) bool
        Which views are used.
    left_out : {view: ViewFinding}
        Why others are not.
    registrations : Registrations
        Of pairs of views.
    T_sensorcarrier_sensor : (4, 4)
        The certified answer of the registrations, in which noise of A is not modelled: ``calibrate`` has a better one.
    is_certified : bool
        Whether it is.
    sigma_m : (2,)
        Deviations of points across faces and across edges, m; of residuals between two views.
    spacing_m : float
        Distance of neighbouring points after thinning.
    noise_m : float
        Standard deviation of a point along its ray, m.
    alike_m, alike_rad : float
        What all views are shifted by alike, and turned by about the thing (standard deviations): no residual shows it.
    by_groups : (6, 6)
        How the sensor is off by errors that groups of views have together (columns, one standard deviation each): of
        these, ``T_sensor_object`` is without what the robot's poses show.
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
    noise_m: float
    alike_m: float
    alike_rad: float
    by_groups: Array

    def __str__(self) -> str:
        (faces, edges), certified = 1e3 * self.sigma_m, "certified" if self.is_certified else "not certified"
        head = f"A thing in {self.used.sum()} of {len(self.used)} views, by {len(self.registrations)} registrations"
        points = f"points of two views are {faces:.2g} mm apart across faces and {edges:.2g} mm across edges"
        lines = [f"{head}; the sensor's pose by them is {certified}", f"  {points} (one standard deviation)"]
        return "\n".join([*lines, *(f"  left out: {finding}" for finding in self.left_out.values())])

    def add_to(self, problem: Problem, target: str, sensor: str) -> None:
        """Add the views that are used to a problem, as measurements of a target.

        An OutliersWarning says which are not, and why. A CloudError if clouds of another sensor have given the target a
        frame: each gives the thing one of its own.
        """
        others = [pair.sensor for pair in problem.alike if pair.target == target and pair.sensor != sensor]
        if others:
            raise CloudError(
                f"{target} has a frame by the clouds of {others[0]}, and those of {sensor} give the thing another; add "
                f"it as a target of its own, such as {target}_{sensor}"
            )
        used = self.used
        if self.left_out:
            words = f"{len(self.left_out)} of {len(used)} views of {target} are left out: "
            warnings.warn(words + "; ".join(map(str, self.left_out.values())), OutliersWarning, stacklevel=2)
        problem.add(
            target,
            sensor,
            self.A[used],
            self.T_sensor_object[used],
            covariances=self.covariances[used],
            directional=True,
            source="clouds",
        )
        off = shifted_and_turned(self.alike_m, self.alike_rad, self.T_sensor_object[used])
        problem.alike[Pair(target, sensor)] = np.hstack([off, self.by_groups])
        problem.stretched[Pair(target, sensor)] = self.stretch_of(sensor)

    def stretch_of(self, sensor: str) -> Stretch:
        """How the clouds are stretched, as a sensor's wrong focal length makes them."""
        return stretch_of(self.registrations, sensor, Spacing(self.spacing_m, 0.0, self.noise_m))


def seen_object(clouds: Iterable[Cloud], A: PosesLike, options: ObjectOptions | None = None) -> SeenObject:
    """A thing that stands still (or is held) as a target, from clouds of it: a pose in each view, with its covariance.

    Parameters
    ----------
    clouds : iterable of Cloud
        N views. Each is read once and thinned, so they need not be in memory together.
    A : (N, 4, 4) array or list of gtsam.Pose3
        T_sensorcarrier_targetcarrier of each view, metres: T_flange_base of a sensor on a robot's flange, T_base_flange
        of a fixed sensor that sees a thing on the flange.
    options : ObjectOptions, optional

    Raises
    ------
    CloudError
        There are too few views, they do not overlap where the poses put them, several poses of the sensor explain them
        equally well, or the poses are in another unit or belong to other views.

    Notes
    -----
    Views are registered in pairs (Segal et al. 2009, "Generalized-ICP"; small_gicp), in turn with the certified
    solution of the motions, and then all at once by points to planes and edges.
    """
    options = options or ObjectOptions()
    views = prepared(clouds, A, options)
    return seen_from(views, as_transforms(A, None, "A"), first_pose(views, options))


def seen_from(views: Views, A: Array, Y: Array) -> SeenObject:
    """As `seen_object`, of `prepared` views, from a pose (4, 4) that explains them."""
    registrations, Y, is_certified = registered_in_turn(views, Y)
    together = largest_group(len(views.at), registrations.i, registrations.j)
    out = [*views.left_out, *(_apart(views, int(k)) for k in np.flatnonzero(~together))]
    kept, place = views.selected(together), np.cumsum(together) - 1
    if len(kept.at) < FEWEST_VIEWS:
        raise CloudError(f"only {len(kept.at)} views overlap each other: " + "; ".join(map(str, out)))
    inside = registrations.selected(together[registrations.i] & together[registrations.j]).renamed(place)
    of_A = noise_of_A(inside, Y)
    spacing_m, noise_m = views.spacing.faces_m, views.spacing.left_m
    joint = joint_poses(kept.surfaces, se3.inverse(kept.A) @ Y, of_A, inside, GATE * spacing_m, noise_m)
    origin = se3.pose(np.eye(3), _centre(kept.surfaces, joint.T_common_sensor))
    of_all = (Y, is_certified) if together.all() else certified_pose(inside)
    stays, Y, is_certified = _where_it_was(kept, joint, inside, of_all, origin)
    check_agreement(kept, inside, Y)
    out += [_moved(kept, k, far) for k, far in stays.items()]
    turn = _about(origin, joint)[1]
    centre = centre_of_slides(turn @ joint.covariances @ turn.transpose(0, 2, 1))
    used = np.setdiff1d(np.arange(len(kept.at)), list(stays))
    B, turn = _about(origin @ se3.pose(np.eye(3), centre), joint)
    covariances = with_common_slides(turn @ joint.alone @ turn.transpose(0, 2, 1))
    # A's noise is that of the carrier in whose frame it is less: elsewhere turns at a distance are shifts, too.
    sides = np.broadcast_to(Y, kept.A.shape), se3.inverse(kept.A) @ Y
    least, frames = min(((noise_of_A(inside, Y, side), side) for side in sides), key=lambda each: each[0].prod())
    G = (turn @ joint.groups)[used]
    B[used], moves = fitted(kept.A[used], B[used], covariances[used], G, least, frames[used], Y)
    poses, of_poses = np.full((len(A), 4, 4), np.nan), np.full((len(A), 6, 6), np.nan)
    poses[kept.at[used]] = B[used]
    of_poses[kept.at[used]] = covariances[used]
    return SeenObject(
        A,
        poses,
        of_poses,
        np.isin(np.arange(len(A)), kept.at[used]),
        {each.view: each for each in sorted(out, key=lambda each: each.view)},
        registrations.renamed(views.at),
        Y,
        is_certified,
        joint.sigma_m,
        spacing_m,
        views.spacing.noise_m,
        *_alike(float(joint.sigma_m[0]), spacing_m, joint.alike_m, size_of(kept.surfaces)),
        moves,
    )


def _alike(sigma_m: float, spacing_m: float, alike_m: float, size_m: float) -> tuple[float, float]:
    """What all clouds of a thing are shifted (m) and turned (rad) by alike: neighbours off together lift its rim."""
    shifts = SHIFTED * sigma_m, BENT * sigma_m**2 / spacing_m, FINEST * spacing_m, alike_m
    return float(np.linalg.norm(shifts)), alike_m / size_m


def _about(origin: Array, joint: JointPoses) -> tuple[Array, Array]:
    """The thing's poses T_sensor_object with its origin here in the common frame, and how the sensors' move them."""
    B = se3.inverse(joint.T_common_sensor) @ origin
    return B, -se3.adjoint(se3.inverse(B))


def motions(clouds: Iterable[Cloud], A: PosesLike, options: ObjectOptions | None = None) -> Registrations:
    """Motions of a sensor by its clouds, for ``problem.add_motion(sensor, m.A, m.B, covariances=m.covariances)``.

    Arguments and errors as in `seen_object`, which is better where the sensor sees one thing: it registers all at once.
    """
    options = options or ObjectOptions()
    views = prepared(clouds, A, options)
    registrations, Y, _ = registered_in_turn(views, first_pose(views, options))
    check_agreement(views, registrations, Y)
    return registrations.renamed(views.at)


def _where_it_was(
    views: Views, joint: JointPoses, pairs: Registrations, of_all: tuple[Array, bool], origin: Array
) -> tuple[dict[int, float], Array, bool]:
    """Views in which the thing was elsewhere, with the distance (m); the certified pose of the sensor by the others.

    ``of_all`` is that by all pairs. A CloudError says from which view on the thing was elsewhere, or that too many
    views contradict each other.
    """
    to_middle = se3.inverse(origin)
    unit = np.array([units(each.faces.points)[0] for each in views.surfaces])
    size = size_of(views.surfaces)
    moved: dict[int, float] = {}
    at, (Y, is_certified) = np.arange(len(views.at)), of_all
    for _ in views.at:
        predicted = se3.inverse(views.A[at]) @ Y
        move = move_of(
            to_middle @ joint.T_common_sensor[at], to_middle @ predicted, joint.covariances[at], unit[at], size
        )
        if move is None:
            break
        name = views.surfaces[at[move.first]].name
        if move.stays:
            raise CloudError(
                f"the thing moved by {1e3 * move.distance_m:.1f} mm before {name}, and stayed: calibrate with the "
                "views before it, or with those from it on, or give each part a target of its own"
            )
        moved[int(at[move.first])] = move.distance_m
        if len(moved) > MOST_MOVED * len(views.at):
            raise CloudError(
                "views contradict each other in where the thing was: "
                + "; ".join(str(_moved(views, k, far)) for k, far in moved.items())
            )
        at = np.setdiff1d(at, list(moved))
        Y, is_certified = certified_pose(pairs.selected(np.isin(pairs.i, at) & np.isin(pairs.j, at)))
    return moved, Y, is_certified


def _moved(views: Views, view: int, off_m: float) -> ViewFinding:
    return ViewFinding(int(views.at[view]), views.surfaces[view].name, ViewFault.MOVED, off_m)


def _apart(views: Views, view: int) -> ViewFinding:
    """The finding of a view that overlaps no other of the group."""
    turns = se3.so3_logmap((views.A @ se3.inverse(views.A[view]))[:, :3, :3])
    far = np.linalg.norm(turns, axis=1)
    far[view] = np.inf
    near = np.argsort(far)[:2]
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
    return np.asarray(middle + np.linalg.solve(across + 1e-6 * len(points) * np.eye(3), right))
