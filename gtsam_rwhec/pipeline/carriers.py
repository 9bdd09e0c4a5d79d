"""The carriers' motion in a log: A = T_sensorcarrier_targetcarrier over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cleaning import Trajectory
from gtsam_rwhec.errors import StampError, TransformError
from gtsam_rwhec.logs import Log, PoseRecord, TfBuffer
from gtsam_rwhec.poses import Array
from gtsam_rwhec.refinement.options import CarrierNoise
from gtsam_rwhec.rig import Rig

#: Stamps that go back by more than this, in the order in which messages were logged: a clock was set meanwhile.
BACKWARDS_S = 1.0
TF_TOPICS = ("tf", "tf_static")


@dataclass(frozen=True)
class Carriers:
    """A over time (stamps, T_sensorcarrier_targetcarrier), and its noise as the rig file has it."""

    trajectory: Trajectory
    noise: CarrierNoise | None


def read_carriers(log: Log, rig: Rig) -> Carriers:
    """Read them as the rig file says where they are.

    Raises
    ------
    LogError
        A topic that is not there, or has no such poses.
    TransformError
        Frames that no chain of transforms joins, or that never move against each other.
    StampError
        Stamps that are all zero, or of a clock that was set back meanwhile.
    """
    source = rig.carriers.poses
    parent, child = source.frames
    if source.topic is None:
        where = f"tf {parent} to {child}"
        stamps, T = _from_tf(log, parent, child)
    else:
        where = f"topic {source.topic}"
        stamps, T = _from_topic(log, source.topic)
    child_carries_sensors = child == rig.carriers.sensors
    noise = rig.carriers.noise
    if child_carries_sensors:  # T_targetcarrier_sensorcarrier is what was logged
        T = se3.inverse(T)
    return Carriers(
        Trajectory.of(stamps, T, where),
        None
        if noise is None
        else CarrierNoise(
            float(np.radians(noise.rotation_deg)),
            1e-3 * noise.translation_mm,
            # What is reported of a child frame is off in the child's own axes.
            about="sensorcarrier" if child_carries_sensors else "targetcarrier",
        ),
    )


def _from_tf(log: Log, parent: str, child: str) -> tuple[np.ndarray, Array]:
    topics = [t.name for t in log.topics() if t.name.rpartition("/")[2] in TF_TOPICS or t.schema in _TRANSFORM_SCHEMAS]
    readable = [t.name for t in log.topics() if t.name in topics and not t.unreadable]
    buffer = TfBuffer(log.records(readable)) if readable else TfBuffer()
    stamps = buffer.stamps(parent, child)
    if not len(stamps):
        raise TransformError(
            f"{parent} and {child} are joined by static transforms only ({' -> '.join(buffer.chain(parent, child))}): "
            "a carrier that does not move calibrates nothing"
        )
    _check_not_zero(stamps, f"tf {parent} to {child}")
    T, gap_s = buffer.at(parent, child, stamps)
    known = np.isfinite(gap_s)  # before the first and after the last of a link nothing is known
    if not known.any():
        raise TransformError(
            f"the links from {parent} to {child} have no time in common: {' -> '.join(buffer.chain(parent, child))}"
        )
    return stamps[known], T[known]


_TRANSFORM_SCHEMAS = ("foxglove.FrameTransforms", "foxglove.FrameTransform")


def _from_topic(log: Log, topic: str) -> tuple[np.ndarray, Array]:
    in_order = [r.stamp_ns for r in log.records([topic]) if isinstance(r, PoseRecord)]
    check_order(np.array(in_order, dtype=np.int64), f"topic {topic}")
    series = log.poses(topic)
    # Of poses with one stamp the last counts, as in tf.
    last = np.append(np.diff(series.stamps_ns) != 0, True)
    return series.stamps_ns[last], series.T[last]


def check_order(stamps_ns: np.ndarray, where: str) -> None:
    """Refuse stamps (N,), in the order in which they were logged, that tell no time.

    Raises
    ------
    StampError
        All zero; or going back by more than `BACKWARDS_S`.
    """
    _check_not_zero(stamps_ns, where)
    back = np.diff(stamps_ns) * 1e-9
    if len(back) and back.min() < -BACKWARDS_S:
        i = int(np.argmin(back))
        raise StampError(
            f"{where}: stamps go back by {-back[i]:.3f} s at message {i + 2} ({stamps_ns[i]} then {stamps_ns[i + 1]} "
            "ns): a clock was set, or two sources publish there; cut the log at that place"
        )


def _check_not_zero(stamps_ns: np.ndarray, where: str) -> None:
    if len(stamps_ns) and not stamps_ns.any():
        raise StampError(f"{where}: all {len(stamps_ns)} stamps are 0; does the driver fill header.stamp?")
