"""The motion of the carriers in a log: A = T_sensorcarrier_targetcarrier over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import LogError, StampError, TransformError
from gtsam_rwhec.fitting.fit_options import About, CarrierNoise
from gtsam_rwhec.fitting.joint_covariance import MOVED
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import WINDOW_S, SmoothPath, Trajectory
from gtsam_rwhec.logs import Log, PoseRecord, TfBuffer, Topic
from gtsam_rwhec.rig import Rig

#: Seconds. If stamps go back by more than this in the order of the log, a clock was set during the recording.
BACKWARDS_S = 1.0
#: Two files have the same pose at a stamp if their matrices differ by at most this.
SAME_POSE = 1e-6
#: Nanoseconds. Stamps must be below this (the year 2116), so that differences and time offsets fit into 64 bits.
LATEST_NS = 1 << 62
#: A velocity needs at least this many poses in all, and this many within half a second.
FEWEST_POSES, FEWEST_NEAR = 8, 4


@dataclass(frozen=True, eq=False)
class CarrierMotion:
    """The carriers' motion: A = T_sensorcarrier_targetcarrier over time, and its noise if the rig file states it.

    `about` is the carrier whose pose the source gives. A is noisy about this carrier's origin, in its axes.
    """

    trajectory: Trajectory
    noise: CarrierNoise | None
    about: About = "targetcarrier"

    def A_where_known(self, stamps_ns: np.ndarray, max_gap_s: float) -> Array:
        """A (N, 4, 4) at stamps (N,). It is nan outside the trajectory and in gaps above `max_gap_s`."""
        A, gap_s = self.trajectory.at(stamps_ns)
        return np.where((gap_s > max_gap_s)[:, None, None], np.nan, A)

    def velocities(self, stamps_ns: np.ndarray) -> Array | None:
        """Velocities (N, 6) at stamps (N,), [omega rad/s, v m/s] in the target carrier's axes, from the poses nearby.

        All are zero if none of them exceeds the scatter of the poses: the carriers stood still. None if a stamp has
        fewer than four poses within half a second: between stations the path is unknown.
        """
        path, window_ns = self.trajectory, round(WINDOW_S * 1e9)
        near = np.searchsorted(path.stamps_ns, stamps_ns + window_ns, side="right")
        near -= np.searchsorted(path.stamps_ns, stamps_ns - window_ns)
        if len(path.T) < FEWEST_POSES or (near < FEWEST_NEAR).any():
            return None
        _, velocity, variance = self._smooth.at(stamps_ns)
        squares, noise = (each.sum(axis=0).reshape(2, 3).sum(axis=1) for each in (velocity**2, variance))
        return np.zeros_like(velocity) if (squares <= MOVED * noise).all() else velocity

    @cached_property
    def _smooth(self) -> SmoothPath:
        return SmoothPath.of(self.trajectory)


def read_carrier_motion(log: Log, rig: Rig, found: Mapping[str, Sequence[PoseRecord]] | None = None) -> CarrierMotion:
    """Read the carriers' motion from the tf frames or the topic that the rig file names.

    Frames of poses in files (``frames``) are in tf of the log that was made of the files. ``found`` are poses that the
    log does not have yet, by topic.

    Raises `LogError` if the topic is missing or has no poses of these frames, or if the log has no transforms;
    `TransformError` if no chain of transforms joins the frames, or if they never move relative to each other;
    `StampError` if all stamps are the same, or if a clock was set back during the recording. Raises `LogError`, which
    names both files, if two files have different poses at one stamp.
    """
    source, noise = rig.carriers.poses, rig.carriers.noise
    parent, child = source.parent_and_child
    here = None
    if source.topic is None:
        try:
            parent, child, stamps, T = poses_of_tf(log, parent, child, rig.carriers.sensors)
        except TransformError as error:
            raise TransformError(f"{error} ({rig.source.place(('carriers', 'poses'))})") from error
        where = f"tf {parent} to {child}"
    else:
        where = f"topic {source.topic}"
        here = (found or {}).get(source.topic)
        stamps, T = poses_of_topic(log, source.topic) if here is None else series_of(here)
    if here is None and len(log.files) > 1:
        _check_one_pose_a_stamp(log, source.topic)
    # The pose of a child frame is noisy about and along the child's own axes.
    about: About = "targetcarrier"
    if child == rig.carriers.sensors:  # the log has T_targetcarrier_sensorcarrier
        about, T = "sensorcarrier", se3.inverse(T)
    carrier_noise = None
    if noise is not None:
        carrier_noise = CarrierNoise(float(np.radians(noise.rotation_deg)), 1e-3 * noise.translation_mm, about=about)
    return CarrierMotion(Trajectory.of(stamps, T, where), carrier_noise, about)


def poses_of_tf(log: Log, parent: str, child: str, of_sensors: str) -> tuple[str, str, np.ndarray, Array]:
    """Read poses from tf. Return the parent and the child frame, stamps and T_parent_child.

    The parent is the frame that is higher in the tf tree, whichever the rig file names first. If the frames are on two
    branches of the tree, the child is the carrier of the sensors.
    """
    where = f"{log.files[0].path}, tf {parent} to {child}"
    topics = [topic for topic in log.topics() if topic.is_tf]
    readable = [t.name for t in topics if not t.unreadable]
    try:
        buffer = TfBuffer(log.records(readable)) if readable else TfBuffer()
        if not buffer.frames():
            raise LogError(f"{where}: {_no_transforms(log, topics)}")
        buffer.chain(parent, child)
        if not buffer.is_above(parent, child) and (buffer.is_above(child, parent) or child != of_sensors):
            parent, child = child, parent
        chain = " -> ".join(buffer.chain(parent, child))
        for link, in_order in buffer.stamps_as_logged(parent, child).items():
            check_order(in_order, f"{where}, transforms of {link}")
        stamps = buffer.stamps(parent, child)
        T, gap_s = buffer.at(parent, child, stamps)
    except TransformError as error:
        raise TransformError(f"{where}: {error}") from error
    if len(stamps) < 2:
        why = "one pose" if len(stamps) else "static transforms"
        raise TransformError(f"{where}: {why} only ({chain}): a carrier that does not move calibrates nothing")
    known = np.isfinite(gap_s)  # nothing is known before the first and after the last transform of a link
    if not known.any():
        raise TransformError(f"{where}: the links of the chain have no time in common: {chain}")
    return parent, child, stamps[known], T[known]


def _no_transforms(log: Log, topics: list[Topic]) -> str:
    """Why the log has no transforms, and the topics that it has."""
    said = [f"{t.name} ({t.unreadable or f'{t.count} messages, none of which can be read'})" for t in topics]
    if said:
        return f"no transforms can be read; topics of transforms: {', '.join(said)}"
    return (
        f"the log has no transforms; its topics: {log.topics_in_words()}. Record /tf and /tf_static too, or name a "
        "topic of poses in the rig file: poses: {topic: ..., parent: ..., child: ...}"
    )


def poses_of_topic(log: Log, topic: str) -> tuple[np.ndarray, Array]:
    """Stamps and poses of a topic. Raises `StampError` as `check_order`."""
    in_order = [r.stamp_ns for r in log.records([topic]) if isinstance(r, PoseRecord)]
    check_order(np.array(in_order, dtype=np.int64), f"topic {topic}")
    series = log.poses(topic)
    # If several poses have the same stamp, the last one counts, as in tf.
    last = np.append(np.diff(series.stamps_ns) != 0, True)
    return series.stamps_ns[last], series.T[last]


def series_of(records: Sequence[PoseRecord]) -> tuple[np.ndarray, Array]:
    """Stamps (N,) and poses (N, 4, 4)."""
    stamps = np.array([each.stamp_ns for each in records], dtype=np.int64)
    return stamps, np.array([each.T for each in records])


def _check_one_pose_a_stamp(log: Log, topic: str | None) -> None:
    """Raise `LogError` if files have different poses of a frame at one stamp, often of folders converted separately."""
    before: list[tuple[Path, dict[str, tuple[np.ndarray, Array]]]] = []
    for file in log.files:
        alone = Log([file])
        names = [t.name for t in alone.topics() if not t.unreadable and (t.is_tf if topic is None else t.name == topic)]
        if not names:
            continue
        links: dict[str, tuple[np.ndarray, Array]] = {}
        if topic is None:
            links.update(TfBuffer(alone.records(names)).moving_links())
        else:
            links[topic] = poses_of_topic(alone, topic)
        for other, theirs in before:
            for name in links.keys() & theirs.keys():
                (stamps, T), (their_stamps, their_T) = links[name], theirs[name]
                _, here, there = np.intersect1d(stamps, their_stamps, return_indices=True)
                apart = np.abs(T[here] - their_T[there]).max(axis=(1, 2), initial=0.0) > SAME_POSE
                if apart.any():
                    i = int(np.argmax(apart))
                    raise LogError(
                        f"{other} and {file.path} have two poses of {name} at one stamp, {stamps[here[i]]} ns: "
                        f"{their_T[there[i]][:3, 3].tolist()} and {T[here[i]][:3, 3].tolist()} m. Were they made of "
                        "folders without stamps? Name these as sensors of one rig file, and give the folder above"
                    )
        before.append((file.path, links))


def check_order(stamps_ns: np.ndarray, where: str) -> None:
    """Check the stamps (N,) of the messages of a topic, in the order in which they were logged.

    Raises `StampError` if stamps are all the same (most often zero), before 1970, after 2116, or go back by more than
    `BACKWARDS_S`.
    """
    if not len(stamps_ns):
        return
    wrong = np.flatnonzero((stamps_ns < 0) | (stamps_ns >= LATEST_NS))
    if len(wrong):
        raise StampError(
            f"{where}: stamp {stamps_ns[wrong[0]]} ns (message {wrong[0] + 1}) is before 1970 or after 2116; does the "
            "driver write nanoseconds, or seconds and nanoseconds, as its schema says?"
        )
    if not stamps_ns.any():
        raise StampError(f"{where}: every stamp is 0 ({len(stamps_ns)} messages); does the driver fill header.stamp?")
    if len(stamps_ns) > 1 and (stamps_ns == stamps_ns[0]).all():
        raise StampError(
            f"{where}: all {len(stamps_ns)} messages have the same stamp, {stamps_ns[0]} ns: a clock stood still"
        )
    latest = np.maximum.accumulate(stamps_ns)  # a clock may also go back in many small steps
    late = np.flatnonzero((latest - stamps_ns) * 1e-9 > BACKWARDS_S)
    if len(late):
        i = int(late[0])
        raise StampError(
            f"{where}: stamps go back by {(latest[i] - stamps_ns[i]) * 1e-9:.3f} s at message {i + 1} ({latest[i]} "
            f"then {stamps_ns[i]} ns): a clock was set, or two sources publish there; cut the log at that place"
        )
