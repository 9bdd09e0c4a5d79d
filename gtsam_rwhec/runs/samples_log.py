"""Samples of hand-eye tools as a log for a rig file, or, without one, as a problem whose setup is found by solving."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

from gtsam_rwhec.errors import LogError, NotUniqueWarning
from gtsam_rwhec.logs.hand_eye_samples import HandEyeSamples, is_samples_file, read_hand_eye_samples
from gtsam_rwhec.logs.mcap_writer import LogWriter
from gtsam_rwhec.logs.pose_rows import PoseStatement
from gtsam_rwhec.logs.records import DetectionRecord
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.solver import solve

#: Samples have no stamps: these are this far apart, nanoseconds, further than poses are interpolated.
APART_NS = 10**9
#: One setup explains the samples if its cost is this many times below the other's.
CLEARLY = 4.0
#: Names of the frames, which samples do not have.
BASE, HAND, CAMERA, TARGET = "base", "hand", "camera", "target"


@dataclass(frozen=True, eq=False)
class SamplesProblem:
    """The problem of a file of samples.

    Attributes
    ----------
    problem : Problem
        A X = Y B of one camera and one target.
    said : str
        How the file was read, and why.
    """

    problem: Problem
    said: str


def is_file_of_samples(path: object, rig: Rig | None) -> bool:
    """Whether a path is a file of samples for a rig file whose one sensor has detections."""
    return rig is not None and rig.carriers.poses.frames is not None and is_samples_file(path)


def samples_problem(path: str | Path) -> SamplesProblem:
    """The problem of a file of samples, without a rig file.

    Whether the camera is on the hand or fixed is what the file says, else what fits: both are solved.

    Raises
    ------
    LogError
        As `read_hand_eye_samples`; or neither setup fits clearly better than the other.
    """
    samples = read_hand_eye_samples(path)
    if samples.is_on_hand is not None:
        on_hand, why = samples.is_on_hand, "as the file says"
    elif samples.is_of_carriers:
        on_hand, why = (
            True,
            ("which the file does not say: with a fixed camera the answer is the same, with base and hand exchanged"),
        )
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotUniqueWarning)  # whoever calibrates this problem says it again
            costs = {each: solve(_problem(samples, each)).certificate.cost for each in (True, False)}
        on_hand = costs[True] < costs[False]
        if max(costs.values()) < CLEARLY * min(costs.values()):
            raise LogError(
                f"{path}: a camera on the hand and a fixed one fit about equally well (costs {costs[True]:.3g} and "
                f"{costs[False]:.3g}). State which in a rig file (--rig): carriers: {{sensors: {HAND}, targets: "
                f"{BASE}, poses: {{frames: [{BASE}, {HAND}]}}}} with the camera on the hand"
            )
        why = f"which fits {max(costs.values()) / max(min(costs.values()), 1e-300):.3g} times better than the other"
    return SamplesProblem(_problem(samples, on_hand), f"{samples.reading(on_hand)}, {why}.")


def _problem(samples: HandEyeSamples, on_hand: bool) -> Problem:
    sensors, targets = (HAND, BASE) if on_hand else (BASE, HAND)
    problem = Problem(sensor_carrier=sensors, target_carrier=targets)
    problem.add(TARGET, CAMERA, samples.A(on_hand), samples.B, source=str(samples.path))
    return problem


def samples_of_rig(path: str | Path, rig: Rig) -> tuple[HandEyeSamples, bool]:
    """The samples of a file, and whether the rig file has the camera on the hand.

    Raises
    ------
    LogError
        As `read_hand_eye_samples`; the rig file has more sensors or targets; or the file says another setup than it.
    """
    source, (parent, child) = rig.carriers.poses, rig.carriers.poses.parent_and_child
    if len(rig.sensors) != 1 or len(rig.targets) != 1:
        raise LogError(
            f"{rig.source.place(('sensors',), ('targets',))}: {len(rig.sensors)} sensors and {len(rig.targets)} "
            f"targets; the samples in {path} are of one camera and one target"
        )
    ((name, sensor),) = rig.sensors.items()
    if sensor.detections is None:
        raise LogError(
            f"{rig.source.place(('sensors', name))}: the samples in {path} have no images. Write detections: /samples "
            "in place of images"
        )
    samples = read_hand_eye_samples(path, PoseStatement(source.quaternion, source.euler, source.angles, source.length))
    on_hand = rig.carriers.sensors == child
    if samples.is_on_hand not in (None, on_hand) and samples.is_of_carriers:
        setup = "on the hand" if samples.is_on_hand else "fixed"
        raise LogError(
            f"{rig.source.place(('carriers',))}: {child}, which moves in {parent}, "
            f"{'carries' if on_hand else 'does not carry'} the sensors, and {path} is of a camera that is {setup}. "
            "Exchange sensors and targets of the carriers"
        )
    return samples, on_hand


def write_samples_log(path: str | Path, rig: Rig, out_path: str | Path) -> str:
    """Write samples as a log of the carriers' poses and the detections of the rig file's one sensor and target.

    Parameters
    ----------
    path
        The file of samples.
    rig : Rig
        Its carriers' poses are ``frames``: the file's robot poses are T_parent_child. Its sensor has ``detections``,
        the name of the topic to write.
    out_path
        The MCAP file to write.

    Returns
    -------
    str
        How the file was read, in words.

    Raises
    ------
    LogError
        As `samples_of_rig`.
    """
    samples, on_hand = samples_of_rig(path, rig)
    parent, child = rig.carriers.poses.parent_and_child
    ((name, sensor),) = rig.sensors.items()
    assert sensor.detections is not None
    T = samples.T_base_hand(on_hand)
    (target,) = rig.target_list
    with LogWriter(out_path) as out:
        for i, (robot, B) in enumerate(zip(T, samples.B, strict=True), start=1):
            stamp = APART_NS * i
            out.transforms("/tf", stamp, [(parent, child, robot)])
            frame = rig.frame_of(name)
            seen = DetectionRecord(stamp, stamp, sensor.detections, frame, target.family, target.name, T_camera_tag=B)
            out.detections(sensor.detections, stamp, frame, [seen])
    return samples.reading(on_hand)
