"""Read odometries, from a log or from files: the poses of each sensor that measures only its own motion."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import LogError, RwhecError
from gtsam_rwhec.geometry.odometry_track import OdometryNoise, OdometryTrack
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import Log, PoseRecord
from gtsam_rwhec.logs.image_folder import as_ns, read_poses
from gtsam_rwhec.logs.pose_tables import PoseStatement
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.odometry_sections import START, odometry_topic
from gtsam_rwhec.runs.carrier_motion import poses_of_tf, poses_of_topic

#: A track of fewer poses has no motion to compare.
FEWEST = 3


def read_odometry(log: Log, rig: Rig, sensor: str) -> OdometryTrack:
    """The track of a sensor with odometry, on its own clock.

    Raises `LogError` if it has too few poses, or if the rig file names a topic or file that does not exist;
    `TransformError`, `StampError` as for the carriers' poses.
    """
    source = rig.odometries[sensor].odometry
    place = rig.source.place(("sensors", sensor, "odometry"))
    of_log = odometry_topic(sensor)
    if source.tf is not None:
        start, child = source.tf
        upper, _, stamps, T = poses_of_tf(log, start, child, child)
        T = T if upper == start else se3.inverse(T)
    elif source.topic is not None:
        stamps, T = poses_of_topic(log, source.topic)
    elif any(topic.name == of_log for topic in log.topics()):  # an earlier stage wrote it
        stamps, T = poses_of_topic(log, of_log)
    else:
        raise LogError(
            f"{log.files[0].path} has no motion of {sensor} yet, which {place} has; gtsam-rwhec detect adds it"
        )
    if len(stamps) < FEWEST:
        raise LogError(f"{place}: {source.place} has {len(stamps)} poses; motions need at least {FEWEST}")
    noise = source.noise
    stated = None
    if noise is not None:
        stated = OdometryNoise(float(np.radians(noise.rotation_deg_per_sqrt_s)), 1e-3 * noise.translation_mm_per_sqrt_s)
    return OdometryTrack(sensor, stamps, T, stated, has_unknown_scale=source.scale == "estimate")


def read_file(rig: Rig, sensor: str) -> tuple[np.ndarray, Array]:
    """Stamps (N,), nanoseconds, and poses (N, 4, 4) of an odometry in a file: TUM, or CSV with a column of stamps.

    Raises `LogError` where the file cannot be read, or a row has no stamp.
    """
    source = rig.odometries[sensor].odometry
    path = rig.folder / str(source.file)
    place = rig.source.place(("sensors", sensor, "odometry"))
    if not path.is_file():
        raise LogError(f"{place}: there is no file {path}")
    try:  # vehicles drive further than the workspaces in which a length may be millimetres
        poses = read_poses(path, PoseStatement(length="m"))
    except RwhecError as error:
        raise LogError(f"{place}: {error}") from error
    stamps = []
    for name, where in zip(poses.names, poses.places, strict=True):
        stamp = as_ns(name if "." in name or len(name) > 15 else f"{name}.0")
        if stamp is None:
            raise LogError(f"{place}: {where}: {name!r} is no stamp; TUM's rows begin with a stamp in seconds")
        stamps.append(stamp)
    in_order = np.array(stamps, dtype=np.int64)
    order = np.argsort(in_order, kind="stable")
    last = np.append(np.diff(in_order[order]) != 0, True)  # of several poses with one stamp the last one counts
    return in_order[order][last], poses.T[order][last]


def files_of(rig: Rig) -> Iterator[tuple[str, Path]]:
    """The sensors whose odometry is in a file, and the files."""
    for name, sensor in rig.odometries.items():
        if sensor.odometry.file is not None:
            yield name, rig.folder / sensor.odometry.file


def records_of_files(rig: Rig) -> dict[str, list[PoseRecord]]:
    """The odometries that are in files, each on its `odometry_topic`, so that a log with them needs no file."""
    found = {}
    for sensor, _ in files_of(rig):
        topic, start = odometry_topic(sensor), f"{rig.frame_of(sensor)}{START}"
        poses = zip(*read_file(rig, sensor), strict=True)
        found[topic] = [PoseRecord(int(stamp), int(stamp), topic, start, "", T) for stamp, T in poses]
    return found
