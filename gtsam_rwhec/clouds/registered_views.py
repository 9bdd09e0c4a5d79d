"""Registrations of pairs of views and the certified pose of the sensor on its carrier, in turn until both are still."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import chain, islice

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.first_registration import first_poses
from gtsam_rwhec.clouds.point_to_plane import ONE_PLACE
from gtsam_rwhec.clouds.registration import Registrations, aligned, overlapping_pairs, registered
from gtsam_rwhec.clouds.surfaces import (
    FEWEST_POINTS,
    FINER,
    Spacing,
    Surface,
    reachable,
    size_of,
    spacing_of,
    surface_of,
    without_border,
)
from gtsam_rwhec.errors import CloudError, RwhecWarning
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.geometry.poses import (
    Array,
    PoseLike,
    PosesLike,
    as_transforms,
    checked_rows,
    one_transform,
    rows_to_transforms,
)
from gtsam_rwhec.problem.knowledge import Stretch
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
#: Registrations that differ from the poses by more than this share of the thing's size are none of this thing.
CONTRADICTION = 0.15
#: Clouds of one thing differ in size by less than this factor: beside one that is so large no others were registered.
OTHER_SIZE = 15.0
#: Numbers in the first unit are so many times as large as in the second; sizes of views tell it to a factor.
UNITS = {1e3: ("mm", "m"), 100.0: ("cm", "m"), 39.37: ("inches", "m"), 25.4: ("mm", "inches"), 10.0: ("0.1 mm", "mm")}
LIKE = 1.2
#: Clouds are one if their points differ by less than this share of their distance: files round them, and order them.
COPIED = 1e-5
#: Poses are the same if they differ by less than this, rad and m.
SAME = 1e-6
#: The spacing is taken from this many views.
SPACED = 9
#: Noise along rays makes clouds look shorter across the axis: thinned faces are off by so many of its squares over the
#: distance of points (0 to 0.5, by the thing).
SHORTER, UNSURE = 0.2, 0.15
#: And they are off by this share of the distance of points, however little noise they have: 2 um of a real plate.
NEVER_BELOW = 5e-4
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
    #: It is far larger or smaller than the others: its unit of length is another.
    OTHER_SIZE = "other_size"
    #: It is another view's cloud: the same points, in any order.
    SAME = "same"


@dataclass(frozen=True)
class ViewFinding:
    """A view that is left out, and why; ``str()`` is a sentence.

    The thing was ``off_m`` elsewhere, or the view is ``off_m`` large: ``times`` as large as most others.
    """

    view: int
    name: str
    fault: ViewFault
    off_m: float = 0.0
    neighbours: tuple[str, ...] = ()
    times: float = 1.0

    def __str__(self) -> str:
        if self.fault is ViewFault.MOVED:
            return (
                f"{self.name} shows the thing {1e3 * self.off_m:.1f} mm from where its pose puts it: it was elsewhere "
                "in this view alone, or the pose is of another"
            )
        if self.fault is ViewFault.FEW_POINTS:
            return f"{self.name} has too few points to tell a pose"
        if self.fault is ViewFault.OTHER_SIZE:
            return (
                f"{self.name} shows a thing of {rounded(self.off_m)} m, {rounded(self.times)} times as large as most "
                f"others, {like_units(self.times, 'its points')} (unit_m is for all), or it shows a wall behind"
            )
        if self.fault is ViewFault.SAME:
            others = ", ".join(self.neighbours)
            return f"{self.name} has the same points as {others}: one cloud is stored twice, and has one pose only"
        return (
            f"{self.name} overlaps no view of the others where its pose puts it (nearest by rotation: "
            f"{', '.join(self.neighbours)}): it sees another side, the thing moved, or the pose is of another view"
        )


def like_units(times: float, what: str) -> str:
    """In which unit lengths may be that are so many times as large as others, and by what to multiply ``what``."""
    unit = min(UNITS, key=lambda each: abs(abs(np.log(times)) - np.log(each)))
    if abs(abs(np.log(times)) - np.log(unit)) > np.log(LIKE):
        return "perhaps in another unit of length"
    one, other = UNITS[unit][:: 1 if times > 1.0 else -1]
    return f"like {one} beside {other}: multiply {what} by {rounded(1.0 / unit if times > 1.0 else unit, 4)}"


@dataclass(frozen=True)
class Views:
    """Views that have a surface: their places among all, surfaces, and A of these; and those that are left out."""

    at: np.ndarray
    surfaces: Sequence[Surface]
    A: Array
    spacing: Spacing
    left_out: Sequence[ViewFinding]

    def selected(self, mask: np.ndarray) -> Views:
        """The views where ``mask`` is true."""
        surfaces = [each for each, yes in zip(self.surfaces, mask, strict=True) if yes]
        return replace(self, at=self.at[mask], surfaces=surfaces, A=self.A[mask])

    def posed(self, A: PosesLike) -> Views:
        """The same surfaces at other A of all views that were given."""
        return replace(self, A=_checked(A)[self.at])


def _checked(A: PosesLike) -> Array:
    transforms = as_transforms(A, None, "A")
    return rows_to_transforms(checked_rows(transforms, 0, "A").rows) if len(transforms) else transforms


def prepared(clouds: Iterable[Cloud], A: PosesLike, options: ObjectOptions) -> Views:
    """The surfaces of all views, but for those that have too few points, another unit, or another view's cloud."""
    transforms = _checked(A)
    given = Cloud.each(clouds)
    first = list(islice(given, SPACED))
    count = len(transforms)
    spacing = spacing_of([each.points for each in first], count) if count else Spacing(0.0, 0.0, 0.0)
    if options.spacing_m is not None:
        spacing = Spacing(options.spacing_m, spacing.edges_m and options.spacing_m / FINER, spacing.noise_m)
    surfaces: list[Surface] = []
    marks: list[Array] = []
    for cloud in chain(first, given):
        surfaces.append(surface_of(cloud, cloud.source or f"clouds[{len(surfaces)}]", spacing))
        marks.append(_mark(reachable(cloud.points)))
        del cloud  # before the next is read: what is kept of that one would lie in this one's room
    if len(surfaces) != len(transforms):
        raise CloudError(f"{len(surfaces)} clouds and {len(transforms)} poses in A; give one A for each cloud")
    if len(transforms) > 1 and np.abs(se3.logmap(se3.inverse(transforms[:1]) @ transforms[1:])).max() < SAME:
        raise CloudError(f"all {len(surfaces)} poses are the same: nothing moved, so nothing tells where the sensor is")
    few = _left_out(surfaces, np.array(marks), transforms) if surfaces else []
    at = np.setdiff1d(np.arange(len(surfaces)), [each.view for each in few])
    if len(at) < FEWEST_VIEWS:
        raise CloudError(
            f"{len(at)} views have {FEWEST_POINTS} points and more; at least {FEWEST_VIEWS} are needed, and about ten "
            "are good" + "".join(f"; {each}" for each in few)
        )
    kept = without_border([surfaces[k] for k in at], GATE * spacing.faces_m)
    return Views(at, kept, transforms[at], spacing, few)


def _mark(points: Array) -> Array:
    """By which points (N, 3) are known in any order: their number, size, means and deviations, (8,)."""
    mean, off = points.mean(axis=0), points.std(axis=0)
    size, scale = np.linalg.norm(off), np.sqrt(len(points) / (mean @ mean + off @ off))
    return np.asarray(np.r_[len(points), size, scale * mean, scale * off])


def _left_out(surfaces: Sequence[Surface], marks: Array, A: Array) -> list[ViewFinding]:
    """Views of few points or of another unit, and those that are one cloud: all, or all but the first of one pose."""
    found: list[ViewFinding] = []
    alike: dict[int, list[int]] = {}
    sizes = np.maximum(marks[:, 1], ONE_PLACE)
    for view, (surface, mark, times) in enumerate(zip(surfaces, marks, sizes / np.median(sizes), strict=True)):
        if mark[0] >= FEWEST_POINTS and not 1.0 / OTHER_SIZE < times < OTHER_SIZE:
            found.append(ViewFinding(view, surface.name, ViewFault.OTHER_SIZE, sizes[view], times=times))
        elif len(surface.faces.points) < FEWEST_POINTS:
            found.append(ViewFinding(view, surface.name, ViewFault.FEW_POINTS))
        else:
            alike.setdefault(int((np.abs(marks - mark) < COPIED).all(axis=1).argmax()), []).append(view)
    if len(alike) == 1 < len(surfaces) - len(found):
        raise CloudError(f"all {len(surfaces)} clouds are the same points; give each pose the cloud seen there")
    for views in alike.values():
        is_one_pose = np.abs(se3.logmap(se3.inverse(A[views[:1]]) @ A[views])).max() < SAME
        for view in views[1:] if is_one_pose else views if len(views) > 1 else []:
            others = tuple(surfaces[other].name for other in views if other != view)
            found.append(ViewFinding(view, surfaces[view].name, ViewFault.SAME, 0.0, others))
    return found


def registered_in_turn(views: Views, Y: Array) -> tuple[Registrations, Array, bool]:
    """Registrations of pairs and the certified pose of the sensor on its carrier, in turn until both are still.

    ``Y`` (4, 4) is the pose from which they start. The last result is whether the pose is certified.
    """
    spacing = views.spacing.faces_m
    i, j = overlapping_pairs(views.surfaces, se3.inverse(views.A) @ Y, GATE * spacing)
    starts: Array = np.zeros((0, 4, 4))
    for _ in range(ROUNDS):
        poses = se3.inverse(views.A) @ Y
        predicted = se3.inverse(poses[i]) @ poses[j]
        if not len(starts):
            tried = zip(i, j, predicted, strict=True)
            starts = np.array([aligned(views.surfaces, *pair, WIDE * spacing) for pair in tried])
        pairs = registered(views.surfaces, views.A, i, j, starts, predicted, GATE * spacing)
        if len(pairs) < FEWEST_VIEWS - 1:
            raise CloudError(_unexplained(views, first_poses(views.surfaces, views.A, spacing, Y)[0].misfit))
        i, j, starts = pairs.i, pairs.j, pairs.B
        before = Y
        Y, is_certified = certified_pose(pairs)
        moved = _at_middle(views, se3.inverse(views.A) @ (Y - before), np.arange(len(views.at)))
        if np.ptp(moved, axis=0).max() < STILL * spacing:
            break
    return pairs, Y, is_certified


def check_agreement(views: Views, pairs: Registrations, Y: Array) -> None:
    """Raise a CloudError if registrations are none of a thing that stood still at these poses."""
    poses = se3.inverse(views.A) @ Y
    off = np.linalg.norm(_at_middle(views, poses[pairs.i] @ pairs.B - poses[pairs.j], pairs.j), axis=1)
    size = size_of(views.surfaces)
    if np.median(off) > CONTRADICTION * size:
        raise CloudError(
            f"registrations of the clouds contradict the poses: they differ by {1e3 * np.median(off):.1f} mm (median "
            f"of {len(off)} pairs of views) for a thing of {1e3 * size:.0f} mm. Look whether the thing stood still, "
            "and whether A is T_sensorcarrier_targetcarrier with the right order of angles"
        )


def _at_middle(views: Views, change: Array, at: np.ndarray) -> Array:
    """How far (M, 3) changes of poses (M, 4, 4) move the middle of each view, m."""
    middle = np.array([each.faces.points.mean(axis=0) for each in views.surfaces])[at]
    return np.asarray(np.einsum("nij,nj->ni", change[:, :3, :3], middle) + change[:, :3, 3])


def certified_pose(pairs: Registrations) -> tuple[Array, bool]:
    """The sensor's pose (4, 4) on its carrier by motions, and whether it is certified."""
    return _by_motions(pairs, noise_of_A(pairs, _by_motions(pairs, np.zeros(6))[0]))


def noise_of_A(pairs: Registrations, Y: Array, T_frame_sensor: Array | None = None) -> Array:
    """The variances (6,) of A, the same along all axes: what motions are off where a pair knows most.

    It has the axes and origins of ``T_frame_sensor`` (N, 4, 4) of each view, or the sensor's.
    """
    off = se3.logmap(se3.inverse(pairs.B) @ se3.inverse(Y) @ pairs.A @ Y)
    moved = se3.adjoint(np.eye(4)[None] if T_frame_sensor is None else T_frame_sensor[pairs.j])
    off, covariances = (moved @ off[..., None])[..., 0], moved @ pairs.covariances @ moved.transpose(0, 2, 1)
    result = np.zeros(6)
    for part in (slice(0, 3), slice(3, 6)):
        best = np.linalg.eigh(covariances[:, part, part])[1][:, :, 0]
        result[part] = np.median(np.einsum("ni,ni->n", best, off[:, part]) ** 2)
    return result


def stretch_of(pairs: Registrations, sensor: str, spacing: Spacing) -> Stretch:
    """How clouds are stretched across their z axis, by pairs of views, each of which may have any pose.

    The deviation is that of leaving out a view at a time, and of what noise does to faces. Smoothing changes how round
    a thing is, as a stretch does (1 % of a ball of 10 cm): smoothed clouds tell nothing.
    """
    information, gradient, points = pairs.of_stretch.T
    kept = np.array([(pairs.i != view) & (pairs.j != view) for view in np.unique((pairs.i, pairs.j))])
    if spacing.is_noisy or information.sum() <= 0.0 or (kept @ information <= 0.0).any():
        return Stretch(sensor, 0.0, np.inf)
    share = -gradient.sum() / information.sum()
    jackknife = (len(kept) - 1) * ((kept @ gradient) / (kept @ information)).var()
    by_metre = np.sqrt(points.sum() / information.sum())
    shorter = by_metre * spacing.noise_m**2 / spacing.faces_m
    variance = jackknife + (UNSURE * shorter) ** 2 + (NEVER_BELOW * by_metre * spacing.faces_m) ** 2
    return Stretch(sensor, float(share + SHORTER * shorter), float(np.sqrt(variance)))


def _by_motions(pairs: Registrations, of_A: Array) -> tuple[Array, bool]:
    problem = Problem()
    covariances = pairs.covariances + np.diag(of_A + TINY)
    problem.add_motion(SENSOR, pairs.A, pairs.B, covariances=covariances, directional=True)
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        # The caller's own problem is judged by `calibrate`, with A's noise.
        solution = solve(problem)
    return np.asarray(solution.Y[SENSOR].matrix()), solution.certificate.status is Status.CERTIFIED


def first_pose(views: Views, options: ObjectOptions) -> Array:
    """The one pose (4, 4) of the sensor that explains the clouds; a CloudError if there are none or several."""
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
            f"{len(found)} poses of the sensor on its carrier explain the clouds equally ({words}): the "
            "thing looks the same from several sides. State roughly where the sensor is (ObjectOptions.start), or take "
            "a thing without symmetry"
        )
    return found[0].T_sensorcarrier_sensor


def _unexplained(views: Views, misfit: float) -> str:
    """Words for poses that explain nothing: the reading of them that would explain the clouds, if there is one."""
    rows = "the poses belong to other views: with A shifted by {} row the clouds fit"
    points = "all points, or unit_m of the rig file,"
    readings = {rows.format("one"): np.roll(views.A, 1, axis=0), rows.format("minus one"): np.roll(views.A, -1, axis=0)}
    for times in (each for unit in UNITS for each in (unit, 1.0 / unit)):
        words = f"lengths in the clouds are {rounded(times, 4)} times those of the poses, {like_units(times, points)}"
        words += f", or A's translations by {rounded(times, 4)}, and the clouds fit"
        readings[words] = se3.pose(views.A[:, :3, :3], times * views.A[:, :3, 3])
    readings |= {
        "A is inverted: give T_sensorcarrier_targetcarrier, with which the clouds fit": se3.inverse(views.A),
        "most of what the clouds show does not move before the sensor (a wall, a table): cut it away, and leave the "
        "thing": np.repeat(views.A[:1], len(views.A), axis=0),
    }
    out = "".join(f"; {each}" for each in views.left_out)
    for words, A in readings.items():
        best = first_poses(views.surfaces, A, views.spacing.faces_m)[0]
        if best.explains and best.misfit < 0.6 * misfit:
            return words + out
    return (
        f"{views.surfaces[0].name} to {views.surfaces[-1].name}: at no pose of the sensor on its carrier do the clouds "
        f"overlap (misfit {misfit:.2f}; 0 is perfect, 1 is apart){out}. Look whether the thing stood still, whether A "
        "is T_sensorcarrier_targetcarrier with the right order of angles, and whether neighbours share a third of what "
        "they see"
    )
