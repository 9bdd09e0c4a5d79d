"""A first rig file for a folder of clouds: of all readings of the poses, the one that lets the clouds agree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.trial_fits import ROUNDS, Spread, fitted
from gtsam_rwhec.clouds.first_registration import first_poses
from gtsam_rwhec.clouds.named_fields import cloud_of_record
from gtsam_rwhec.clouds.object_views import SeenObject, seen_from
from gtsam_rwhec.clouds.registered_views import ObjectOptions, like_units, prepared
from gtsam_rwhec.clouds.surfaces import spacing_of, surface_of
from gtsam_rwhec.errors import CloudError, RigError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.files.terminal_text import natural_key, rounded, some
from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import CloudRecord, Log, Topic
from gtsam_rwhec.logs.image_folder import TABLES
from gtsam_rwhec.logs.pose_tables import PoseStatement
from gtsam_rwhec.logs.pose_trees import TREES
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig.carrier_roles import Role
from gtsam_rwhec.rig.folder_contents import (
    FAR_UNITS,
    LEAST_CLOUDS,
    CloudFolder,
    FolderPoses,
    poses_read,
    readable_cloud,
    why_not_read,
)
from gtsam_rwhec.rig.log_contents import camera_name, free_name
from gtsam_rwhec.rig.rig import Rig
from gtsam_rwhec.rig.rig_file import first_rig_text
from gtsam_rwhec.rig.section_types import is_text
from gtsam_rwhec.rig.sections import Carriers, Intrinsics, PoseSource, Sensor
from gtsam_rwhec.rig.target_sections import ObjectTarget

#: Why clouds of other sensors are not in a proposed rig file.
ONE_SENSOR = "a rig file calibrates the clouds of one sensor, as each gives the object a frame of its own"
#: Readings are judged by at most this number of clouds, spread evenly.
LOOKED_AT = 12
#: A reading lets clouds agree if their points are nearer to each other than this share of the gate's square.
AGREES = 0.45
#: So many of the best readings after one round of weights are fitted with all rounds.
FITTED_WELL = 4
#: Lengths in depth images may be so many times those of the poses: some cameras write tenths of a millimetre.
DEPTHS = (10.0, 0.1)
#: Another reading explains the registered clouds as well if its residuals' product is below this many times the best.
AS_WELL = 2.0
#: Names for the frames of a folder's poses; files do not name them.
PARENT, CHILD, OBJECT = "base", "flange", "object"
#: Units that files may leave open, in the order in which they are tried.
LENGTHS: tuple[Literal["mm"] | None, ...] = (None, "mm")
ANGLES: tuple[Literal["radians", "degrees"], ...] = ("radians", "degrees")
#: Conventions of three angles, the commonest first.
AXES = ("xyz", "ZYX", "XYZ", "rotation_vector", "ZYZ", "zyx")


@dataclass(frozen=True, eq=False)
class _Reading:
    """How the poses are read, which carrier has the sensor, and the poses T_parent_child (n, 4, 4) of the clouds."""

    poses: FolderPoses
    role: Role

    @property
    def A(self) -> Array:
        """T_sensorcarrier_targetcarrier of each cloud."""
        return se3.inverse(self.poses.T) if self.role == "child" else self.poses.T

    def __str__(self) -> str:
        said = self.poses.stated
        words = f"quaternions {said.quaternion}" if said.quaternion else "matrices or quaternions"
        if said.euler:
            words = f"angles {said.euler} in {said.angles}" + (" before the position" if said.columns else "")
        return f"{words}, {'mm' if said.length else 'm'}, the sensor on {CHILD if self.role == 'child' else PARENT}"


@dataclass(frozen=True, eq=False)
class CloudProposal:
    """A first rig file: its text, notes, and the clouds as they were registered for it, where that settled all."""

    text: str
    notes: tuple[str, ...]
    registered: SeenObject | None


def propose_cloud_rig(folder: Path, found: Sequence[CloudFolder], tell: Progress) -> CloudProposal:
    """A first rig file for folders of clouds with poses beside them; its notes say what was seen and chosen.

    Raises `RigError` if no file of poses fits the clouds.
    """
    by_table = {clouds.path: list(_tables(folder, clouds)) for clouds in found}
    usable = [clouds for clouds in found if by_table[clouds.path] and is_text(clouds.path)]
    notes = [f"not used: {of.path}, no poses fit its {len(of.files)} clouds" for of in found if of not in usable]
    notes += [f"not used: {of.path}, {ONE_SENSOR}" for of in usable[1:]]
    if not usable:
        whys = [words for clouds in found for words in _why_none(folder, clouds)][:3]
        raise RigError(
            f"{folder}: clouds in {some([each.path for each in found], 5)}, and no file of poses that fits them"
            f"{''.join(f'; {each}' for each in whys)}. "
            "Put the robot's pose at each cloud beside them, as poses.csv with a line a cloud: name, x, y, z, qx, qy, "
            "qz, qw (metres)"
        )
    clouds = usable[0]
    if clouds.size is not None and clouds.camera is None:
        raise RigError(_no_intrinsics(folder, clouds, clouds.size))
    tell(f"trying readings of the poses in {', '.join(by_table[clouds.path])}")
    reading, words, is_sure, registered = _best(folder, clouds, by_table[clouds.path], tell)
    name = free_name("camera" if clouds.path in (".", "*") else camera_name(clouds.path, ""), {PARENT, CHILD, OBJECT})
    place = "this folder" if clouds.path == "." else clouds.path
    what = "clouds" if clouds.size is None else "depth images"
    beside = f", intrinsics in {clouds.intrinsics}" if clouds.intrinsics else ""
    notes.append(f"sensor {name}: {len(clouds.files)} {what} in {place}, poses in {reading.poses.path}{beside}")
    if clouds.unit_m is not None:
        notes.append(f"the points of {clouds.path} are more than {FAR_UNITS:g} units away: millimetres")
    notes.append(words)
    said = reading.poses.stated
    source = PoseSource(
        frames=(PARENT, CHILD), quaternion=said.quaternion, euler=said.euler, angles=said.angles,
        columns=None if said.columns is None else tuple(said.columns.split()), length=said.length,
    )  # fmt: skip
    on_hand = reading.role == "child"
    carriers = Carriers(sensors=CHILD if on_hand else PARENT, targets=PARENT if on_hand else CHILD, poses=source)
    remark = words if is_sure else f"TODO {words}"
    if is_sure:
        remark += (
            f". If the files have T_{CHILD}_{PARENT}, exchange the two frames here, and sensors and targets above: no "
            "measurement tells these apart"
        )
    stated = Intrinsics(file=clouds.intrinsics, camera=clouds.camera_name or None) if clouds.intrinsics else None
    sensor = Sensor(clouds=clouds.path, poses=reading.poses.path, unit_m=clouds.unit_m, intrinsics=stated)
    rig = Rig(carriers=carriers, sensors={name: sensor}, targets={OBJECT: ObjectTarget(type="object")})
    remarks: dict[KeyPath, str] = {("carriers", "poses"): remark}
    remarks["targets", OBJECT] = "anything that stood still in front of the sensor"
    head = "# Paths start from that folder.\n"
    text = first_rig_text("folder", folder.resolve().name, rig, remarks, head)
    return CloudProposal(text, tuple(notes), registered)


def _no_intrinsics(folder: Path, clouds: CloudFolder, size: tuple[int, int]) -> str:
    """Words for depth images without intrinsics: the file that lacks, in the form of ROS."""
    width, height = size
    beside = clouds.files[0].parent.relative_to(folder)
    return (
        f"{folder}: depth images of {width} x {height} in {clouds.path}, and no file of intrinsics of this size. Write "
        f"{(beside / 'depth.yaml').as_posix()} with the numbers of the depth camera: {{image_width: {width}, "
        f"image_height: {height}, camera_matrix: {{rows: 3, cols: 3, data: [fx, 0, cx, 0, fy, cy, 0, 0, 1]}}, "
        "distortion_model: plumb_bob, distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}, or put the "
        "driver's camera_info there"
    )


def _near(folder: Path, clouds: CloudFolder) -> Iterator[Path]:
    """Files, or folders of files, that may have poses of the clouds; the nearest first."""
    places = [clouds.files[0].parent]
    while places[-1] != folder:
        places.append(places[-1].parent)
    for place in places:
        for path in sorted(place.iterdir(), key=lambda path: natural_key(path.name)):
            if path.suffix.lower() in (*TREES, *TABLES) or (path.is_dir() and "pose" in path.name.lower()):
                yield path


def _tables(folder: Path, clouds: CloudFolder) -> Iterator[str]:
    """Those whose poses fit the clouds, as paths from the folder."""
    for path in _near(folder, clouds):
        if next(_statements(folder, clouds, path), None) is not None:
            yield path.relative_to(folder).as_posix()


def _why_none(folder: Path, clouds: CloudFolder) -> Iterator[str]:
    """Why files that have poses fit none of the clouds."""
    stated = [PoseStatement(length="m"), *(PoseStatement(euler=axes, angles="degrees", length="mm") for axes in AXES)]
    for path in _near(folder, clouds):
        if why := why_not_read(folder, clouds.files, path, stated):
            yield why


def _statements(folder: Path, clouds: CloudFolder, path: Path) -> Iterator[FolderPoses]:
    """The poses of a file under each statement by which it can be read; angles within a turn are radians."""
    read = partial(poses_read, folder, clouds.files, path)
    plain = next((poses for length in LENGTHS if (poses := read(PoseStatement(length=length))) is not None), None)
    if plain is not None:
        yield plain
        other = read(replace(plain.stated, quaternion="wxyz"))
        if other is not None and not np.allclose(other.T, plain.T, rtol=0.0, atol=1e-9, equal_nan=True):
            yield other
        return
    for axes in AXES:
        about = "xyz" if axes == "rotation_vector" else axes.lower()
        names = " ".join([*(f"r{axis}" for axis in about), "tx ty tz"])
        for columns in (None,) if len(set(about)) < 3 else (None, names):  # the position first, or the angles
            statements = (
                PoseStatement(euler=axes, angles=angles, length=length, columns=columns)
                for angles in ANGLES
                for length in LENGTHS
            )
            first = next((poses for stated in statements if (poses := read(stated)) is not None), None)
            if first is not None:
                yield first


def _readings(folder: Path, clouds: CloudFolder, tables: Sequence[str]) -> Iterator[_Reading]:
    """All readings that differ, those with the sensor on the child first."""
    every = [poses for path in tables for poses in _statements(folder, clouds, folder / path)]
    different: list[FolderPoses] = []
    for poses in every:
        if not any(np.allclose(poses.T, other.T, rtol=0.0, atol=1e-9, equal_nan=True) for other in different):
            different.append(poses)
    for role in ("child", "parent"):
        yield from (_Reading(poses, role) for poses in different)


def _best(
    folder: Path, clouds: CloudFolder, tables: Sequence[str], tell: Progress
) -> tuple[_Reading, str, bool, SeenObject | None]:
    """The reading that lets the clouds agree, with words, whether it is sure, and the clouds registered under it.

    A start is searched for under one reading after the other, until one explains the clouds. With it they are
    registered, and all readings are compared by how they explain the registrations.
    """
    readings = list(_readings(folder, clouds, tables))
    posed = np.flatnonzero(np.isfinite(readings[0].poses.T[:, 0, 0]))
    at = posed[np.unique(np.linspace(0, len(posed) - 1, LOOKED_AT).round().astype(int))]
    read = partial(readable_cloud, unit_m=clouds.unit_m, camera=clouds.camera)
    seen = {int(i): cloud for i in at if (cloud := read(clouds.files[i])) is not None}
    at = np.array(list(seen))
    readings = [reading for reading in readings if np.isfinite(reading.poses.T[at]).all()]
    named = (replace(cloud, source=clouds.files[i].relative_to(folder).as_posix()) for i, cloud in seen.items())
    views = prepared(named, readings[0].A[at], ObjectOptions())
    misfits = []
    # Where no reading lets clouds agree, depths may be in another unit, and poses of the clouds beside theirs.
    mistakes = {"": (0, 1.0)}
    for times in DEPTHS if clouds.size is not None else ():
        why = f"lengths in the depth images are {times:g} times those of the poses, {like_units(times, 'unit_m')}"
        mistakes[f"{why} (0.001 if not stated)"] = 0, times
    row = "the poses belong to other clouds: each cloud fits the pose one row {} its own"
    mistakes |= {row.format("before"): (1, 1.0), row.format("after"): (-1, 1.0)}
    for (why, (rows, times)), (number, reading) in product(mistakes.items(), enumerate(readings, start=1)):
        tell(f"reading the poses as {reading} ({number} of {len(readings)})")
        places = np.searchsorted(posed, at) - rows
        is_there = np.isin(places, np.arange(len(posed)))
        A = reading.A[posed].take(places, axis=0, mode="clip")
        if not np.isfinite(A).all() or is_there.sum() < LEAST_CLOUDS:
            continue
        under = views.posed(se3.pose(A[:, :3, :3], times * A[:, :3, 3])).selected(is_there[views.at])
        start, *others = first_poses(under.surfaces, under.A, under.spacing.faces_m)
        misfits.append(start.misfit)
        if start.misfit > AGREES:
            continue
        if why:
            return reading, f"{why}; with that, poses read as {reading} let the clouds agree", False, None
        registered = seen_from(under, reading.A[at], start.T_sensorcarrier_sensor)
        used = registered.used
        residuals = [_residual(other.A[at][used], registered.T_sensor_object[used], 1) for other in readings]
        for k in sorted(range(len(readings)), key=lambda k: _product(residuals[k]))[:FITTED_WELL]:
            residuals[k] = _residual(readings[k].A[at][used], registered.T_sensor_object[used])
        best, *next_best = sorted(range(len(readings)), key=lambda k: _product(residuals[k]))
        kept = None if others or readings[best] is not reading else registered
        words = (
            f"of {len(readings)} readings of the poses, {readings[best]}, lets the clouds agree: "
            f"{_figures(residuals[best])}"
        )
        if not next_best:
            return reading, words, True, kept
        second = next_best[0]
        words += f" (the next, {readings[second]}: {_figures(residuals[second])})"
        return readings[best], words, _product(residuals[second]) > AS_WELL * _product(residuals[best]), kept
    best = int(np.argmin(misfits[: len(readings)]))
    words = (
        f"none of {len(readings)} readings of the poses lets the clouds agree; {readings[best]} is a guess. State "
        "euler, angles, length, and which frame carries the sensor; look whether the thing stood still, and whether "
        "neighbouring clouds share a third of what they see"
    )
    return readings[best], "; ".join([*map(str, views.left_out), words]), False, None


@dataclass(frozen=True)
class CloudEvidence:
    """What a topic's clouds say: the frame of the poses that carries the sensor (None: nothing), and their unit."""

    role: Role | None
    unit_m: float
    misfits: Mapping[str, float]  #: By the frame that would carry the sensor; 0 is perfect, 1 is apart

    def __str__(self) -> str:
        each = ", ".join(f"{rounded(misfit, 2)} on {frame}" for frame, misfit in self.misfits.items())
        return f"misfit of the clouds with the sensor {each} (0: they agree, 1: they are apart)"


def evidence_of_clouds(log: Log, topic: Topic, path: Trajectory, parent: str, child: str) -> CloudEvidence:
    """Register some of a topic's clouds with the sensor on either frame of the poses T_parent_child."""
    wanted = set(np.linspace(0, topic.count - 1, LOOKED_AT).round().astype(int).tolist())
    stamps, clouds = [], []
    for number, record in enumerate(log.records([topic.name])):
        if number in wanted and isinstance(record, CloudRecord):
            with suppress(CloudError):  # calibration says what is wrong with it
                clouds.append(cloud_of_record(record))
                stamps.append(record.stamp_ns)
    T, gap_s = path.at(np.array(stamps, dtype=np.int64))
    posed = np.flatnonzero(np.isfinite(gap_s))
    if len(posed) < LEAST_CLOUDS:
        return CloudEvidence(None, 1.0, {})
    middle = np.median([np.median(np.linalg.norm(clouds[i].points, axis=1)) for i in posed])
    unit_m = 1e-3 if middle > FAR_UNITS else 1.0
    clouds = [replace(clouds[i], points=unit_m * clouds[i].points) for i in posed]
    spacing = spacing_of([cloud.points for cloud in clouds], len(clouds))
    surfaces = [surface_of(cloud, topic.name, spacing) for cloud in clouds]
    child_misfit, parent_misfit = (
        first_poses(surfaces, A, spacing.faces_m)[0].misfit for A in (se3.inverse(T[posed]), T[posed])
    )
    better, worse = sorted((child_misfit, parent_misfit))
    tells = better <= AGREES < worse
    role: Role | None = None if not tells else "child" if child_misfit < parent_misfit else "parent"
    return CloudEvidence(role, unit_m, {child: child_misfit, parent: parent_misfit})


def _residual(A: Array, B: Array, rounds: int = ROUNDS) -> Spread:
    """The residuals of a robust fit of registered clouds under a reading; infinite without an answer."""
    fit = fitted(Problem(), {Pair(OBJECT, "sensor"): (A, B)}, rounds=rounds)
    return Spread(np.inf, np.inf) if fit is None else fit.residual


def _product(spread: Spread) -> float:
    return spread.rotation_rad * spread.translation_m


def _figures(spread: Spread) -> str:
    return f"{rounded(np.degrees(spread.rotation_rad), 2)} degrees and {rounded(1e3 * spread.translation_m, 2)} mm"
