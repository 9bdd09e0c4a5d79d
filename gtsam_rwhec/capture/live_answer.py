"""The answer after a take: the stages of ``calibrate_log`` on the takes so far, in a process of their own.

The session asks here, and only here: what the takes determine, where to go next (`plan`), and whether it is enough
(`StoppingRule`).
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Judgement
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.capture.accuracy import Accuracy
from gtsam_rwhec.capture.plan_options import PlanOptions
from gtsam_rwhec.capture.plan_poses import Plan, PlannedPose, plan
from gtsam_rwhec.capture.stopping import StopDecision, StoppingRule
from gtsam_rwhec.detect.many_images import DetectedImage
from gtsam_rwhec.errors import OptionError, RwhecError, RwhecWarning
from gtsam_rwhec.logs import ImageRecord
from gtsam_rwhec.logs.mcap_reader import open_log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report.determined_section import CURES
from gtsam_rwhec.results.image_errors import cells_with_corners
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.cleaning_stage import cleaned
from gtsam_rwhec.runs.detection_stage import detected
from gtsam_rwhec.runs.kept_detections import KeptOfLog
from gtsam_rwhec.runs.run_log import RunLog
from gtsam_rwhec.runs.solving_stage import Calibrated, solve_log
from gtsam_rwhec.runs.whole_runs import calibrate_log

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


@dataclass(frozen=True)
class PointRow:
    """How far off a point is that a sensor sees; infinite where a free direction moves it."""

    sensor: str
    distance_m: float
    radius_mm: float


@dataclass(frozen=True)
class PairRow:
    """How often a sensor saw a target, and whether these measurements determine both; None without an answer."""

    target: str
    sensor: str
    count: int
    is_determined: bool | None


@dataclass(frozen=True)
class Answer:
    """What the takes determine."""

    takes: int
    seconds: float  #: that it took
    verdict: str = ""  #: the value of a `Verdict`; empty where there is no answer
    reason: str = ""  #: of the verdict
    why_none: str = ""  #: why there is no answer yet; empty where there is one
    points: tuple[PointRow, ...] = ()
    pairs: tuple[PairRow, ...] = ()
    free: tuple[str, ...] = ()  #: free directions, each with what settles it
    #: Corners in each cell of a sensor's images, rows from the top
    cells: Mapping[str, Sequence[Sequence[int]]] = field(default_factory=dict)
    proposal: Proposal | None = None
    decision: Decision | None = None


class _Known(KeptOfLog):
    """Detections of the takes that were searched before, in this process."""

    done, is_whole = 0, False  # each take is another log

    def __init__(self) -> None:
        self._of: dict[tuple[str, int], DetectedImage] = {}

    def known(self, number: int, batch: Sequence[ImageRecord]) -> list[DetectedImage] | None:
        """The detections of a batch; None if one of its images is new."""
        found = [self._of.get((image.topic, image.stamp_ns)) for image in batch]
        return None if None in found else [each for each in found if each is not None]

    def keep(self, number: int, found: list[DetectedImage]) -> None:
        """Keep the detections of a batch."""
        self._of.update({(image.topic, image.stamp_ns): image for image in found})

    def all(self) -> Iterator[DetectedImage]:
        """What was found in all images so far."""
        yield from self._of.values()

    def finish(self) -> None:
        """Nothing: the next take has more."""


#: By the folder of the takes.
_KNOWN: dict[Path, _Known] = {}
_RULES: dict[tuple[Path, Accuracy | None], StoppingRule | None] = {}


def answer_of(takes: Sequence[Path], rig: Rig, wanted: Accuracy | None) -> Answer:
    """Calibrate from takes, as ``calibrate_log`` would from the log that they make. It raises nothing of ours."""
    begun_s = time.monotonic()
    cells: dict[str, list[list[int]]] = {}
    pairs: tuple[PairRow, ...] = ()
    known = _KNOWN.setdefault(takes[0].parent, _Known())
    rule = _RULES.setdefault((takes[0].parent, wanted), None if wanted is None else StoppingRule(wanted))
    cameras: Mapping[str, Camera] = {}
    try:
        # the verdict and the report say the warnings
        with warnings.catch_warnings(action="ignore", category=RwhecWarning), open_log(takes) as log:
            found = detected(log, rig, workers=1, keep=lambda cameras: known)
            cells, pairs, cameras = _cells(found), _pairs(found), found.stages.cameras
            solved = solve_log(cleaned(found, rig), None)
            free = solved.refined.free_directions or solved.solution.identifiability.free_directions
            proposal, outlook = next_pose(solved.calibration, rig, cameras, wanted)
            return Answer(
                len(takes),
                time.monotonic() - begun_s,
                solved.judgement.verdict.value,
                solved.judgement.reason,
                points=_points(solved, wanted),
                pairs=_pairs(found, solved),
                free=tuple(f"{one}. {CURES[one.reason]}" for one in free),
                cells=cells,
                proposal=proposal,
                decision=stop_decision(rule, solved.calibration, len(takes), outlook),
            )
    except RwhecError as error:
        proposal, outlook = next_pose(None, rig, cameras, wanted)
        return Answer(
            len(takes), time.monotonic() - begun_s, why_none=str(error), pairs=pairs, cells=cells, proposal=proposal,
            decision=stop_decision(rule, None, len(takes), outlook),
        )  # fmt: skip


def calibrated(recorded: Path, rig: Rig, out: Path) -> Judgement:
    """Calibrate from the recorded log into a folder, as ``gtsam-rwhec calibrate`` does; in this process."""
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):  # the report has them
        return calibrate_log(recorded, rig, out).judgement


def _cells(found: RunLog) -> dict[str, list[list[int]]]:
    cells = {}
    for sensor, camera in found.stages.cameras.items():
        corners = [
            record.corners_px
            for record in found.detections.get(sensor, ())
            if record.corners_px is not None and not record.reason
        ]
        pixels = np.concatenate(corners) if corners else np.zeros((0, 2))
        cells[sensor] = cells_with_corners(pixels, (camera.width, camera.height)).tolist()
    return cells


def _pairs(found: RunLog, solved: Calibrated | None = None) -> tuple[PairRow, ...]:
    alone = {} if solved is None else solved.solution.identifiability.pairs
    rows = []
    for sensor, records in found.detections.items():
        for target in found.stages.rig.targets:
            pair = Pair(target, sensor)
            count = sum(not record.reason and record.id == target for record in records)
            if solved is not None and pair in solved.pairs:
                count = int(solved.pairs[pair].used.sum())
            determined = alone[pair].is_unique if pair in alone else None
            rows.append(PairRow(target, sensor, count, determined))
    return tuple(rows)


def _points(solved: Calibrated, wanted: Accuracy | None) -> tuple[PointRow, ...]:
    calibration = solved.calibration
    if wanted is None:
        points = list(calibration.points.values())
    else:
        points = [calibration.uncertainty_at(wanted.place_m, name, level=wanted.level) for name in calibration.points]
    return tuple(PointRow(one.frame, float(np.linalg.norm(one.point_m)), one.radius_mm) for one in points)


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
