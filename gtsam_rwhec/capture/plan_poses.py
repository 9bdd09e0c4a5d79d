"""``rw.plan``: the poses to measure next, the best first, and how many reach a wanted accuracy, or why none do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.point_uncertainty import ball_radius
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.capture.plan_candidates import Candidates, drawn_candidates, moving_pose, present_pose, seen_at, tour
from gtsam_rwhec.capture.plan_cell import Cell, Kit
from gtsam_rwhec.capture.plan_information import predicted, rows_at
from gtsam_rwhec.capture.plan_options import PlanOptions
from gtsam_rwhec.capture.plan_ranking import Ranking, Task, bound_of, free_frames, ranked
from gtsam_rwhec.capture.plan_sources import cell_of
from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.files.terminal_text import brief, rounded
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import check_kind, finite_or_none
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.result_file import Result
from gtsam_rwhec.rig import Rig

#: More measurements than this are not waited for: what they would have to average out does not average out so far.
MOST_MEASUREMENTS = 1000
#: So many measurements are as good as endless ones.
ENDLESS = 1e7
#: The distance of the task's point where nothing tells it, m.
USUAL_M = 0.8


class Reason(StrEnum):
    """What a plan promises, or why it promises nothing."""

    OPEN = "no accuracy is wanted"
    REACHED = "reached"
    ENOUGH = "reached by more measurements"
    NOT_SEEN = "no sensor sees a target"
    NOT_WITHIN = "outside the box, or turned too far"
    OUT_OF_REACH = "out of the arm's reach"
    FREE = "a direction stays free"
    CONSTANT = "constant errors of A"
    TOO_MANY = "too many measurements"


PLANNED = "the planned poses leave {point} within {planned} mm {chance}"
#: What an `Outlook` says.
WORDS = {
    Reason.OPEN: f"T{PLANNED[1:]}.",
    Reason.REACHED: "{wanted} is reached: {point} is within {now} mm {chance}.",
    Reason.ENOUGH: f"{{needed}} {{wanted}}: {PLANNED}.",
    Reason.NOT_SEEN: "There is no pose to go to: of all that were drawn, a sensor sees a whole target at none. Bring a "
    "target nearer, turn the robot so that one is in the image, or correct the guesses.",
    Reason.NOT_WITHIN: "There is no pose to go to: all at which a target is seen are outside the box, or turned too "
    "far from the present pose. Widen the box or the turn, or move the target.",
    Reason.OUT_OF_REACH: "There is no pose to go to: the arm reaches none at which a target is seen. Move the target, "
    "or begin with other joints.",
    Reason.FREE: "No number of such measurements determines {free}: a direction stays free, because no candidate turns "
    "far enough about a second axis, or sees it. Let the robot turn further.",
    Reason.CONSTANT: "{wanted} cannot be reached: constant errors of the carriers' poses, which no measurement here "
    "shows, alone leave {point} within {least} mm {chance}. Calibrate the arm.",
    Reason.TOO_MANY: f"{{wanted}} would take more than {{most}} measurements: {PLANNED}. Use more exact poses, a "
    "larger board, or a better known camera.",
}


@dataclass(frozen=True)
class Outlook:
    """What more measurements lead to; ``str()`` is one sentence."""

    reason: Reason
    sensor: str  #: The worst one
    distance_m: float  #: Of the point before it
    level: float
    wanted_mm: float | None
    now_mm: float  #: The point is within this distance of its true place at the level; infinite while it is free
    planned_mm: float  #: After all planned poses
    least_mm: float  #: After endlessly many such measurements
    needed: int | None  #: Measurements until the wanted accuracy; None: no number of them, or none is wanted
    free: tuple[str, ...] = ()  #: Frames with a direction that the planned poses leave free

    @property
    def can_be_reached(self) -> bool:
        """Whether poses are proposed, and nothing speaks against the wanted accuracy."""
        return self.reason in (Reason.OPEN, Reason.REACHED, Reason.ENOUGH)

    def __str__(self) -> str:
        more = "measurement reaches" if self.needed == 1 else "measurements reach"
        return WORDS[self.reason].format(
            point=f"a point {self.distance_m:.2f} m before {self.sensor}",
            wanted="" if self.wanted_mm is None else f"{rounded(self.wanted_mm)} mm at {self.distance_m:.2f} m",
            chance=f"with {100.0 * self.level:g} % probability",
            now=rounded(self.now_mm),
            planned=rounded(self.planned_mm),
            least=rounded(self.least_mm),
            free=", ".join(self.free),
            needed=f"{self.needed} more {more}",
            most=MOST_MEASUREMENTS,
        )


@dataclass(frozen=True, eq=False)
class PlannedPose:
    """A pose to measure at."""

    T_sensorcarrier_targetcarrier: Array  #: (4, 4): metres
    #: The same as the robot has it: T_parent_child (4, 4) of the carrier that it moves
    parent: str
    child: str
    T_parent_child: Array
    joints: Array | None  #: (n,): Of the arm: rad, and m of joints that slide
    T_sensor_target: dict[Pair, Array]  #: (4, 4): of each target that a sensor sees there, metres
    bits: float  #: The information that it adds to that of the poses before it
    #: After it the task's point is within this distance of its true place, mm; infinite while it is free
    deviation_mm: float

    @property
    def sees(self) -> tuple[Pair, ...]:
        """Which targets which sensors see."""
        return tuple(self.T_sensor_target)


@dataclass(frozen=True, eq=False)
class Plan:
    """The poses to measure next, the best first; ``str()`` is one sentence."""

    poses: tuple[PlannedPose, ...]
    tour: tuple[int, ...]  #: The places in ``poses`` on a short way from the present pose
    outlook: Outlook
    #: Whether the poses are as rough as what is known of the cell: follow the pictures, and not the numbers
    is_rough: bool
    #: The planned poses add at least this share of the information (log det) that any as many candidates add
    guarantee: float
    #: Poses that were drawn; at which a target is seen; within the box and the turn; that the arm reaches
    drawn: int
    visible: int
    within: int
    reached: int
    kit: Kit = field(repr=False)

    def __str__(self) -> str:
        rough = " The cell is known roughly: bring each board where the pictures have it." if self.is_rough else ""
        return f"{self.outlook}{rough}"


@one_blas_thread()
def plan(
    source: Problem | Calibration | Result | None = None,
    options: PlanOptions | None = None,
    *,
    rig: Rig | None = None,
    cameras: Mapping[str, Camera] | None = None,
    boards: Mapping[str, Array] | None = None,
) -> Plan:
    """The poses that are best measured next.

    Parameters
    ----------
    source : Problem, Calibration or Result, optional
        What was measured so far. A calibration's own covariance and noise count; measurements alone are solved, and
        count with the noise that is stated. Without a source the rig is all that is known.
    options : PlanOptions, optional
    rig : Rig, optional
        A rig file: names of the carriers, boards, and intrinsics that are in files or numbers.
    cameras : dict of str to Camera, optional
        Intrinsics by sensor, where neither source nor rig has them.
    boards : dict of str to (n, 3) array, optional
        Corners by target, metres in its own frame, where neither has them.

    Returns
    -------
    Plan
        With fewer poses than the options ask for, or none, where there are no more that a sensor sees.

    Raises
    ------
    OptionError
        There is neither a measurement nor a camera with a board, or an argument is of another type.
    FrameError
        The sensor that counts, or a guess, is none of the cell's frames.
    MeasurementsNotKeptError
        The problem keeps moments only.
    """
    options = options or PlanOptions()
    check_kind(options, PlanOptions, "options", "a PlanOptions")
    check_kind(source, Problem | Calibration | Result | None, "source", "a Problem, a Calibration, or a Result")
    cell = cell_of(source, options, rig, cameras or {}, boards or {})
    if not cell.pairs:
        raise OptionError(
            "there is nothing to plan with: no measurement, and no camera with a board; give cameras= and boards=, or "
            "a rig file with intrinsics in numbers or files"
        )
    task = _task(cell, options)
    first, covariance = _first(cell, options)
    candidates = drawn_candidates(cell, options, covariance, np.random.default_rng([options.seed, len(cell.measured)]))
    if first is not None:
        candidates = first.before(candidates)
    W = rows_at(cell, candidates.A, candidates.seen)
    ranking = ranked(
        cell, task, W, candidates.number_seen, options.poses, certainty=candidates.certainty,
        first=None if first is None else 0,
    )  # fmt: skip
    poses = _poses(cell, options, candidates, ranking)
    way = (
        tour(np.array([one.T_parent_child for one in poses]), moving_pose(present_pose(cell, options), options))
        if poses
        else []
    )
    return Plan(
        poses,
        tuple(way),
        _outlook(cell, options, task, candidates, ranking, len(W) - (first is not None)),
        cell.is_rough,
        bound_of(W, ranking) if poses else 0.0,
        candidates.drawn, candidates.visible, candidates.within, candidates.reached,
        cell.kit,
    )  # fmt: skip


def _task(cell: Cell, options: PlanOptions) -> Task:
    """The point before each sensor that counts: where it is wanted, or where the sensor sees its targets."""
    sensors = [name for name in cell.Y if any(pair.sensor == name for pair in cell.pairs)]
    strange = [name for name in options.wanted.sensors if name not in sensors]
    if strange:
        raise FrameError(f"{brief(strange[0])} is wanted, and none that sees a target; there are {', '.join(sensors)}")
    sensors = list(options.wanted.sensors) or sensors
    distances = []
    for name in sensors:
        A = cell.measured if len(cell.measured) else present_pose(cell, options)[None]
        places = [predicted(cell, pair, A)[:, :3, 3] for pair in cell.pairs if pair.sensor == name]
        usual = float(np.median(np.linalg.norm(np.concatenate(places), axis=1))) if places else USUAL_M
        distances.append(options.wanted.distance_m or usual)
    return Task.of(cell, sensors, distances, options.wanted.level)


def _first(cell: Cell, options: PlanOptions) -> tuple[Candidates | None, Array]:
    """Where nothing was measured, the present pose comes first; and the covariance that counts for the others.

    At the present pose a target is taken to be seen where the guesses have it.
    """
    if len(cell.measured):
        return None, np.zeros_like(cell.floor) if cell.is_rough else cell.covariance
    A = present_pose(cell, options)[None]
    margins = seen_at(cell, options, A, np.zeros_like(cell.floor))
    seen = {pair: np.where(margin >= 0.0, 1.0, 0.0) for pair, margin in margins.items()}
    if not any(where.any() for where in seen.values()):
        return None, cell.covariance
    W = rows_at(cell, A, seen)[0]
    covariance = np.linalg.inv(cell.known + np.diag(cell.rough) + W.T @ W)
    joints = None if options.arm is None else options.arm.present[None]
    return Candidates(A, seen, joints, 0, 0, 0, 0), np.zeros_like(cell.floor) if cell.is_rough else covariance


def _poses(cell: Cell, options: PlanOptions, candidates: Candidates, ranking: Ranking) -> tuple[PlannedPose, ...]:
    chosen = candidates.selected(list(ranking.order))
    parent, child = cell.kit.carriers if options.moves == "targets" else cell.kit.carriers[::-1]
    B = {pair: predicted(cell, pair, chosen.A) for pair in cell.pairs}
    return tuple(
        PlannedPose(
            T_sensorcarrier_targetcarrier=A,
            parent=parent,
            child=child,
            T_parent_child=moving_pose(A, options),
            joints=None if chosen.joints is None else chosen.joints[i],
            T_sensor_target={pair: B[pair][i] for pair, seen in chosen.seen.items() if seen[i] > 0.0},
            bits=ranking.nats[i] / math.log(2.0),
            deviation_mm=ranking.radii_mm[i],
        )
        for i, A in enumerate(chosen.A)
    )


def _outlook(
    cell: Cell, options: PlanOptions, task: Task, candidates: Candidates, ranking: Ranking, number: int
) -> Outlook:
    """What the planned poses lead to, and endlessly many such."""
    rough, count = np.diag(cell.rough), max(len(ranking.order), 1)
    now, _ = task.radius_mm(cell, np.linalg.inv(cell.known + rough), cell.degrees_of_freedom)
    added = ranking.information - cell.known - rough
    planned, sensor = task.radius_mm(cell, np.linalg.inv(ranking.information), ranking.degrees_of_freedom)

    def after(measurements: float) -> float:
        freedom = cell.degrees_of_freedom
        freedom += (ranking.degrees_of_freedom - freedom) * measurements / count if np.isfinite(freedom) else 0.0
        return task.radius_mm(cell, np.linalg.inv(cell.known + rough + measurements / count * added), freedom)[0]

    wanted = finite_or_none(1e3 * options.wanted.radius_m)
    needed, free = None, free_frames(cell, np.linalg.inv(ranking.information))
    least = after(ENDLESS) if number else now
    floor = max(1e3 * ball_radius(np.maximum(of, 0.0), task.level) for of in task.variances(cell.floor))
    if not number:
        stages = (candidates.visible, Reason.NOT_SEEN), (candidates.within, Reason.NOT_WITHIN)
        reason = next((why for left, why in stages if not left), Reason.OUT_OF_REACH)
    elif free and free_frames(cell, np.linalg.inv(cell.known + rough + ENDLESS / count * added)):
        reason = Reason.FREE
    elif wanted is None:
        reason = Reason.OPEN
    elif now <= wanted:
        reason, needed = Reason.REACHED, 0
    elif floor > wanted:
        reason = Reason.CONSTANT
    else:
        needed = next((i + 1 for i, radius in enumerate(ranking.radii_mm) if radius <= wanted), None)
        if needed is None and after(MOST_MEASUREMENTS) <= wanted:
            low, high = count, MOST_MEASUREMENTS
            while high - low > 1:
                middle = (low + high) // 2
                low, high = (low, middle) if after(middle) <= wanted else (middle, high)
            needed = high
        reason = Reason.TOO_MANY if needed is None else Reason.ENOUGH
    distance = task.distances_m[task.sensors.index(sensor)]
    return Outlook(reason, sensor, distance, task.level, wanted, now, planned, least, needed, free)
