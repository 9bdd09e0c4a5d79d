"""What to do after a take: where to go next (`plan`), and whether it is enough (`StoppingRule`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.capture.accuracy import Accuracy
from gtsam_rwhec.capture.plan_options import PlanOptions
from gtsam_rwhec.capture.plan_poses import Plan, PlannedPose, plan
from gtsam_rwhec.capture.stopping import StopDecision, StoppingRule
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.rig import Rig

#: So many poses are planned, of which the first is proposed: one alone determines nothing where nothing is known.
AHEAD = 6


@dataclass(frozen=True)
class Proposal:
    """The pose to take next."""

    frame: str  #: the frame in which the pose is
    T: tuple[tuple[float, ...], ...]  #: (4, 4): the pose of the carrier that moves, metres
    words: str  #: what it adds, and how to get there
    #: Where targets should appear, by sensor: closed outlines (n, 2) in pixels
    outlines: Mapping[str, Sequence[Sequence[tuple[float, float]]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Decision:
    """Whether to stop."""

    is_enough: bool
    takes_needed: int | None  #: how many takes are still needed; None if that is not known, or none will do
    words: str


def next_pose(
    known: Calibration | None, rig: Rig, cameras: Mapping[str, Camera], wanted: Accuracy | None
) -> tuple[Proposal | None, str]:
    """The pose that adds most, and what more takes lead to; ``known`` is what the takes so far say, if they say any."""
    poses = rig.carriers.poses
    child = poses.child if poses.topic is not None else (poses.tf or poses.frames or ("", ""))[1]
    # Poses are of what moves, in what stands: a hand's in its base.
    options = PlanOptions(poses=AHEAD, moves="targets" if child == rig.carriers.targets else "sensors")
    if wanted is not None:
        options = replace(options, wanted=wanted)
    try:
        found = plan(known, options, rig=rig, cameras=cameras)
    except OptionError:  # no camera whose intrinsics are known, and nothing was measured: there is nothing to plan with
        return None, ""
    if not found.poses:
        return None, str(found)
    pose = found.poses[0]
    seen = " and ".join(f"{pair.target} by {pair.sensor}" for pair in pose.sees)
    where = "Bring the board where the outline is" if found.is_rough else f"Move {pose.child} there, or to the outlines"
    outlines: dict[str, list[list[tuple[float, float]]]] = {}
    for pair in pose.sees:
        if pair.sensor in found.kit.cameras and pair.target in found.kit.boards:
            outlines.setdefault(pair.sensor, []).append(_outline(found, pose, *pair))
    T = tuple(tuple(row) for row in pose.T_parent_child.tolist())
    return Proposal(pose.parent, T, f"{where}: {seen} is seen.", outlines), str(found)


def _outline(found: Plan, pose: PlannedPose, target: str, sensor: str) -> list[tuple[float, float]]:
    """The hull of a board's corners as the camera should see them, pixels."""
    B = next(B for pair, B in pose.T_sensor_target.items() if pair == (target, sensor))
    pixels = found.kit.cameras[sensor].project(found.kit.boards[target] @ B[:3, :3].T + B[:3, 3])
    hull = cv2.convexHull(pixels[np.isfinite(pixels).all(axis=1)].astype(np.float32)).reshape(-1, 2)
    return [(float(x), float(y)) for x, y in hull]


def stop_decision(
    rule: StoppingRule | None, calibration: Calibration | None, takes: int, outlook: str
) -> Decision | None:
    """Whether the wanted accuracy is reached, with what the planner says of more takes."""
    if rule is None or calibration is None:
        return Decision(False, None, outlook) if outlook else None
    said: StopDecision = rule.after(calibration, takes=takes)
    short = str(replace(said, reason=""))  # the verdict says what speaks against the answer
    return Decision(said.stop, said.more_takes, short if said.stop or not outlook else f"{short} {outlook}")
