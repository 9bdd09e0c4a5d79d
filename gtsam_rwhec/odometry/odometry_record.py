"""The result of a calibration of odometries: poses, proof, windows, influences, other answers, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement
from gtsam_rwhec.clouds.lidar_pair import LidarsTogether
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.geometry.odometry_track import OdometryNoise
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.log_history import Removed
from gtsam_rwhec.solver.certificate import Status
from gtsam_rwhec.solver.free_directions import AXIS_COSINE, FreeDirection, FreeReason, Twist

#: The data contradict a given number that is more than this many standard deviations away: by chance one of 2,000.
CONTRADICTED = 3.5
#: The most contradicted numbers that a message names.
NAMED = 4
#: A sensor takes part in a free direction if it moves by more than this share of the largest shift or turn.
TAKES_PART = 0.05
#: What to do: if a direction is free, if a whole track is wrong, if a given number is contradicted.
ADVICE = {
    Ground.NOT_UNIQUE: "state the missing heights in the rig file (given: {heights_m: {SENSOR: 0.5, ...}}, with that "
    "of the reference), or the ground, directions or distances; or drive other turns and a ramp, and calibrate again",
    Ground.HEIGHT_WEAK: "state the named heights in the rig file (given: {heights_m: {SENSOR: 0.5, ...}}, with that of "
    "the reference), or drive ramps and kerbs, so that the vehicle pitches and rolls",
    Ground.KNOWN_TO_NOTHING: "use nothing of the named poses; drive longer, with turns about two axes, or state what "
    "is known (given: heights_m, directions, distances) in the rig file",
    Ground.CONTRADICTED: "check the named tracks (poses T_start_sensor, quaternions x y z w, lengths in metres or "
    "scale: estimate, one vehicle and one drive) and what is given, and calibrate again",
    Ground.POSE_DOUBTED: "measure again what is given, in metres and in the axes of the reference, and correct the rig "
    "file",
}
PRAISE = "the motions of all sensors agree, their joint cost is certified, and they determine every pose"
PRAISE_WITH_CLOUDS = (
    "the motions of all sensors agree, their joint cost is certified, and with what the clouds of LiDARs tell of each "
    "other they determine every pose"
)
PRAISE_WITH_GIVEN = (
    "the motions of all sensors agree, their joint cost is certified, and with what was given they determine every "
    "pose. The motions do not check all that was given: an error in it is an error of the poses"
)


@dataclass(frozen=True)
class JointCertificate:
    """The proof for the joint quadratic cost of all sensors (design fact 24).

    The cost is half the squared residuals of the windows' rotation vectors and translations in all sensors at once,
    with the vehicle's own motion eliminated. The fused motion gives each window's rotation in the lever arms' term,
    and the translation that scales are compared with. So the proof is for this cost only; the exact likelihood is then
    refined from its optimum.
    """

    status: Status
    cost: float  #: The cost at the answer
    lower_bound: float  #: No answer (of the region) costs less
    #: A lower bound on the certificate matrix's smallest eigenvalue, after its diagonal was scaled to one
    min_eigenvalue: float
    tolerance: float  #: The gap up to which the answer counts as optimal
    #: The bound holds for all answers with sensors at most this far from the reference along each axis
    region_m: float
    #: Whether a mirror image with a negative scale costs less; this happens by chance if the vehicle turns about one
    #: axis (design fact 5). Then cost and bound contain a term that holds each unknown scale near its value
    scales_held: bool = False

    @property
    def gap(self) -> float:
        """Cost minus lower bound, at least 0."""
        return max(0.0, self.cost - self.lower_bound)

    @property
    def is_optimal(self) -> bool:
        """Whether the cost is proven optimal; other answers may cost the same."""
        return self.status in (Status.CERTIFIED, Status.CERTIFIED_NOT_UNIQUE)

    def __str__(self) -> str:
        within = f" within {self.region_m:g} m" if np.isfinite(self.region_m) else ""
        held = ", with scales held near the answer's (a mirror image fits as well)" if self.scales_held else ""
        return f"{self.status}: joint cost {self.cost:.6g}, no answer{within} below {self.lower_bound:.6g}{held}"


@dataclass(frozen=True)
class Windows:
    """The windows of time over which motions were compared."""

    seconds: float  #: Length of a window
    count: int  #: How many there are
    used: dict[str, int]  #: by sensor: in how many of them each sensor is used
    #: start_ns, end_ns: (N,): their ends, on the reference's clock
    start_ns: np.ndarray
    end_ns: np.ndarray


@dataclass(frozen=True)
class Influence:
    """How the answer depends on one given number."""

    what: str  #: The number: "height of lidar" and the like
    #: value, sigma: as it was given; in its unit
    value: float
    sigma: float
    unit: str
    #: by sensor: derivative of each pose's tangent [omega, v] by the number
    per_unit: dict[str, Twist] = field(hash=False)
    #: by sensor: how far the pose moves if the number is off by one sigma: rad and m
    per_sigma: dict[str, Twist] = field(hash=False)
    #: How far the answer is from the number, in standard deviations of the difference; above ``CONTRADICTED`` the
    #: data contradict the number. Zero where the motions do not measure it
    off_by: float = 0.0

    @property
    def is_contradicted(self) -> bool:
        """Whether the motions contradict the number."""
        return self.off_by > CONTRADICTED


@dataclass(frozen=True)
class OtherAnswer:
    """Another answer that fits as well."""

    why: str  #: What leaves it open: "the distance of a and b has two signs"
    T_reference_sensor: dict[str, Array] = field(hash=False)  #: by sensor
    cost_above: float = 0.0  #: Its cost (half a chi-square) above the answer's


@dataclass(frozen=True)
class OdometryCalibration:
    """Poses of sensors that know only their own motion, with their quality. ``str()`` begins with the verdict."""

    reference: str  #: The sensor in whose frame the poses are
    sensors: tuple[str, ...]  #: All sensors, the reference first
    #: by sensor: the identity for the reference. Along a free direction a pose is arbitrary
    T_reference_sensor: dict[str, Array] = field(hash=False)
    #: by sensor of unknown scale: measured over true length
    scales: dict[str, float] = field(hash=False)
    time_offsets_s: dict[str, float] = field(hash=False)  #: by sensor: a sensor's stamp t is the reference's t + offset
    #: by sensor: their standard deviations; empty where the clocks were not compared
    time_offset_sigmas_s: dict[str, float] = field(hash=False)
    order: tuple[str, ...]  #: The sensors in the order of ``covariance``: all but the reference
    #: (d, d): joint covariance: [omega, v] of each sensor in ``order`` (right perturbation, rad and m), then the
    #: logarithms of ``scales`` in their order. Where a free direction moves an entry, its
    #: row is infinite on the diagonal and zero elsewhere
    covariance: Array = field(hash=False)
    certificate: JointCertificate
    #: Directions in which the answer can move without a worse fit to the measurements and given numbers
    free_directions: tuple[FreeDirection, ...]
    windows: Windows = field(hash=False)
    noise: dict[str, OdometryNoise] = field(hash=False)  #: by sensor: as it was stated or found
    noise_was_found: frozenset[str]  #: The sensors whose noise was estimated
    #: by sensor: poses and windows that were not used, and why
    removed: dict[str, tuple[Removed, ...]] = field(hash=False)
    #: by sensor: root mean square of the windows' residuals (rotation, translation) over the expected: 1 is good
    residuals: dict[str, tuple[float, float]] = field(hash=False)
    influences: tuple[Influence, ...] = ()  #: How the answer depends on what was given
    others: tuple[OtherAnswer, ...] = ()  #: Other answers that fit alike
    #: CONTRADICTED: a whole track looks wrong, or contradicts a given distance; COVARIANCE_DOUBTED: doubtful results
    findings: tuple[Finding, ...] = ()
    #: What came of the clouds of every two LiDARs: used in the answer, or why not
    together: tuple[LidarsTogether, ...] = ()
    remarks: tuple[str, ...] = ()  #: What was assumed, in sentences
    #: (d, d): ``covariance`` with as little of the motions' part as blocks of windows leave possible
    narrowed: Array = field(default_factory=lambda: np.zeros((0, 0)), hash=False)

    @property
    def status(self) -> Status:
        """The certificate's status."""
        return self.certificate.status

    @property
    def is_unique(self) -> bool:
        """Whether measurements and what was given determine every pose."""
        return not self.free_directions and not self.others

    def covariance_of(self, sensor: str) -> Array:
        """The covariance (6, 6) of a sensor's pose, [omega, v], rad and m; zero for the reference."""
        if sensor == self.reference:
            return np.zeros((6, 6))
        first = 6 * self.order.index(sensor)
        return self.covariance[first : first + 6, first : first + 6]

    def T(self, first: str, second: str) -> Array:
        """The pose (4, 4) of sensor ``second`` in the frame of sensor ``first``. Such poses close loops exactly."""
        inverse = np.linalg.inv(self.T_reference_sensor[first])
        return inverse @ self.T_reference_sensor[second]

    @cached_property
    def judgement(self) -> Judgement:
        """The verdict with its grounds: never "use" where something is free, or where another answer fits as well."""
        findings = []
        if not self.certificate.is_optimal:
            words = f"the joint cost is not proven optimal ({self.certificate})"
            findings.append(Finding(Ground.NOT_CERTIFIED, words))
        findings += [Finding(Ground.NOT_UNIQUE, words) for words in free_in_words(self)]
        findings += [Finding(Ground.NOT_UNIQUE, f"another answer fits as well: {other.why}") for other in self.others]
        findings += [*_contradicted(self), *self.findings]
        is_unchecked = any(one.off_by == 0.0 for one in self.influences)
        praise = PRAISE if all(one.why_not for one in self.together) else PRAISE_WITH_CLOUDS
        return Judgement.of(findings, PRAISE_WITH_GIVEN if is_unchecked else praise, ADVICE)

    def __str__(self) -> str:
        return "\n".join([str(self.judgement), *(f"- {remark}" for remark in self.remarks)])


def _contradicted(found: OdometryCalibration) -> list[Finding]:
    """The given numbers that the motions contradict, the worst first; one wrong number can pull others."""
    wrong = sorted((one for one in found.influences if one.is_contradicted), key=lambda one: -one.off_by)
    if not wrong:
        return []
    named = some([f"{one.what} = {one.value:g} {one.unit} ({one.off_by:.1f})" for one in wrong], NAMED)
    words = f"what is given contradicts the motions (by so many standard deviations): {named}"
    return [Finding(Ground.POSE_DOUBTED, words)]


def free_in_words(found: OdometryCalibration) -> tuple[str, ...]:
    """Sentences on what is not determined, of which sensors, and why: one for all heights, others by direction."""
    said: list[str] = []
    heights: dict[str, list[str]] = {}
    for direction in found.free_directions:
        said += _of_frames(direction, found, heights)
        said += [f"the scale of {name} is not determined: {direction.reason.words}" for name in direction.own_scales]
    of_heights = [_of_heights(axis, list(dict.fromkeys(names)), found.reference) for axis, names in heights.items()]
    return tuple(dict.fromkeys((*of_heights, *said)))


def _of_frames(direction: FreeDirection, found: OdometryCalibration, heights: dict[str, list[str]]) -> list[str]:
    """The sentences for a direction. Heights that a planar drive leaves free are added to `heights`, by their axis."""
    turns, shifts = (
        {
            name: found.T_reference_sensor[name][:3, :3] @ np.array(twist)[part]
            for name, twist in direction.frames.items()
        }
        for part in (slice(0, 3), slice(3, 6))
    )
    said = []
    largest_turn, largest_shift = (max(map(np.linalg.norm, each.values()), default=0.0) for each in (turns, shifts))
    for name in direction.frames:
        if largest_turn > TAKES_PART and np.linalg.norm(turns[name]) > TAKES_PART * largest_turn:
            said.append(
                f"the turn of {name} about {_axis(turns[name])} of {found.reference} is not determined: "
                f"{direction.reason.words}"
            )
        elif largest_turn <= TAKES_PART and np.linalg.norm(shifts[name]) > TAKES_PART * largest_shift:
            axis = _axis(shifts[name])
            # A vehicle in a plane turns about one axis only. Along this axis a sensor's position (its height) is free.
            if direction.reason is FreeReason.ONE_AXIS:
                heights.setdefault(axis, []).append(name)
            else:
                place = f"the place of {name} along {axis} of {found.reference}"
                said.append(f"{place} is not determined: {direction.reason.words}")
    return said


def _of_heights(axis: str, names: list[str], reference: str) -> str:
    many = len(names) > 1
    listed = f"{', '.join(names[:-1])} and {names[-1]}" if many else names[0]
    heights = f"the height{'s' * many} of {listed} over {reference} (along {axis} of {reference})"
    return f"{heights} {'are' if many else 'is'} not determined: the vehicle moved in a plane"


def _axis(v: Array) -> str:
    """``the z axis``, or a direction in numbers."""
    unit = v / np.linalg.norm(v)
    i = int(np.argmax(np.abs(unit)))
    if abs(unit[i]) > AXIS_COSINE:
        return f"the {'xyz'[i]} axis"
    unit = unit * np.sign(unit[i])
    return f"({', '.join(f'{x:.2f}' for x in unit)})"
