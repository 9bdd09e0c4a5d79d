"""The verdict: may the poses of a calibration be used? Reports, files, exports and the exit status use this rule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.solver.certificate import Status
from gtsam_rwhec.solver.free_directions import FEW, all_slide
from gtsam_rwhec.solver.solution import Solution


class Verdict(StrEnum):
    """What to do with the poses. ``str()`` is a sentence; the value is the word that files have."""

    #: The answer is certified, and the measurements determine it and do not contradict it.
    USE = "use"
    #: The poses may be right, but a person should first look at the grounds.
    CARE = "care"
    #: Some poses are wrong, or the measurements do not determine them.
    DO_NOT_USE = "do_not_use"

    @property
    def words(self) -> str:
        """The instruction to the user, as the beginning of a sentence."""
        return {
            Verdict.USE: "Use these poses",
            Verdict.CARE: "Use these poses with care",
            Verdict.DO_NOT_USE: "Do not use these poses",
        }[self]

    def __str__(self) -> str:
        more = {
            Verdict.USE: "",
            Verdict.CARE: ": read the reason and do what it says before you rely on them",
            Verdict.DO_NOT_USE: ": do what the reason says, and calibrate again",
        }[self]
        return f"{self.words}{more}."

    def __format__(self, spec: str) -> str:
        return format(str(self), spec)


class Ground(StrEnum):
    """Reasons not to use the poses, the most serious first."""

    #: The measurements fit far better when they are read in another way.
    MISREAD = "misread"
    #: The corners of a sensor's boards contradict its stated intrinsics, by so much that poses are wrong.
    INTRINSICS_DOUBTED = "intrinsics_doubted"
    #: The tags of a board are not where the rig file has them, by so much that poses are wrong.
    SHAPE_DOUBTED = "shape_doubted"
    #: The residuals are larger than any noise of measurement.
    IMPLAUSIBLE = "implausible"
    #: The scale at the optimum is not positive, so there is no answer.
    NO_SCALE = "no_scale"
    #: No lower bound of the cost was found.
    NO_BOUND = "no_bound"
    #: The lower bound is below the cost: a better answer may exist.
    NOT_CERTIFIED = "not_certified"
    #: The measurements leave a direction free.
    NOT_UNIQUE = "not_unique"
    #: Standard deviations are as large as no pose's: many degrees, or more metres than targets were away.
    KNOWN_TO_NOTHING = "known_to_nothing"
    #: A pose that was stated, by a prior or fixed, is not the one that the measurements give.
    POSE_DOUBTED = "pose_doubted"
    #: A frame was at two poses: a target was moved, or a sensor's mount gave way.
    MOVED = "moved"
    #: Measurements of two sensors are mixed, and nobody knows which of them was meant.
    MIXED = "mixed"
    #: Most measurements of a sensor were left out as outliers.
    CONTRADICTED = "contradicted"
    #: A sensor or a target has no measurement in the answer, and so no pose; or a sensor of a rig file has too few.
    NO_ANSWER = "no_answer"
    #: The clock of a sensor is late, and was taken as right.
    LATE_CLOCK = "late_clock"
    #: The stated size of a target was used, but it does not fit the motion.
    SIZE_DOUBTED = "size_doubted"
    #: No stated size fits the motion: they were estimated, and the carriers' unit of length may be what is wrong.
    NO_SIZE_FITS = "no_size_fits"
    #: The measurements are too few to tell how well the poses are known.
    NO_COVARIANCE = "no_covariance"
    #: Most measurements of a target were left out as outliers; the sensors' poses rest on other targets.
    TARGET_CONTRADICTED = "target_contradicted"
    #: Poses A lie between those of two rows: they were logged in motion, and no clock is estimated.
    LATE_POSES = "late_poses"
    #: The corners of a sensor's boards fit its stated intrinsics badly.
    INTRINSICS_UNCERTAIN = "intrinsics_uncertain"
    #: The tags or corners of a board fit the rig file badly, or some that it has are never seen.
    SHAPE_UNCERTAIN = "shape_uncertain"
    #: The stated size of a target fits the motion badly.
    SIZE_UNCERTAIN = "size_uncertain"
    #: The motion hardly tells the stated size of a target, on which the poses rest.
    SIZE_UNTOLD = "size_untold"
    #: Clouds of a sensor are longer across its axis than along it: its focal length is wrong.
    CLOUDS_STRETCHED = "clouds_stretched"
    #: A stated pose fits the measurements badly.
    POSE_UNCERTAIN = "pose_uncertain"
    #: Single images are upside down.
    IMAGE_TURNED = "image_turned"
    #: Many images are blurred, and no target is read in them.
    IMAGES_BLURRED = "images_blurred"
    #: The height of a sensor on a vehicle is hardly told, since it turns about its vertical alone.
    HEIGHT_WEAK = "height_weak"
    #: The carriers hardly turned, or hardly about a second axis.
    LITTLE_ROTATION = "little_rotation"
    #: A frame rests on so few measurements that a wrong one would not show.
    FEW_MEASUREMENTS = "few_measurements"
    #: Rows of A and B did not belong together; they were shifted, as an option says.
    ROWS_REPAIRED = "rows_repaired"
    #: The stated size of a target does not fit the motion, as other targets' do; it was estimated instead.
    SIZE_ESTIMATED = "size_estimated"
    #: The stated intrinsics of a sensor do not fit its corners; they were estimated in their place.
    INTRINSICS_ESTIMATED = "intrinsics_estimated"
    #: The corners of the images do not fit together, so the poses are of targets in single images.
    CORNERS_DOUBTED = "corners_doubted"
    #: Errors of neighbouring measurements are alike, beyond what the model of the noise holds.
    CORRELATED = "correlated"
    #: Errors depend on the configuration: an arm's kinematics, intrinsics, a board that is not flat.
    SYSTEMATIC = "systematic"
    #: A check that could have found trouble could not run, so nothing is known of that trouble.
    NOT_CHECKED = "not_checked"
    #: Every measurement counts, as an option says, and some of them look wrong.
    OUTLIERS_KEPT = "outliers_kept"
    #: So many measurements were left out that A and B may not belong together.
    MANY_OUTLIERS = "many_outliers"
    #: The residuals are larger than the noise that was stated allows.
    NOISE_UNDERSTATED = "noise_understated"
    #: The residuals are far smaller than the noise that was stated.
    NOISE_OVERSTATED = "noise_overstated"
    #: Another reason for which the standard deviations may be too small.
    COVARIANCE_DOUBTED = "covariance_doubted"

    @property
    def verdict(self) -> Verdict:
        """The verdict to which this ground leads: the grounds from `TARGET_CONTRADICTED` on ask for care only."""
        return Verdict.DO_NOT_USE if _rank(self) < _rank(Ground.TARGET_CONTRADICTED) else Verdict.CARE

    @property
    def advice(self) -> str:
        """What to do about it, as an imperative without its full stop."""
        return _ADVICE[self]


def _rank(ground: Ground) -> int:
    return list(Ground).index(ground)


_MISREAD = frozenset({Ground.MISREAD, Ground.IMPLAUSIBLE})
#: A wrong size, a wrong pose, what moved and a late clock make errors that vary with the configuration, and in time;
#: what a size that the motion hardly tells would move beside them is no question.
_MADE_BY_A_MISTAKE = frozenset({Ground.CORNERS_DOUBTED, Ground.CORRELATED, Ground.SYSTEMATIC, Ground.SIZE_UNTOLD})
_NOT_DETERMINED = frozenset({Ground.NOT_UNIQUE, Ground.NO_COVARIANCE, Ground.NOT_CHECKED})
#: What cannot be checked of an answer that is none, or is not to be used, is no question.
_UNASKED = frozenset({Ground.NO_COVARIANCE, Ground.NOT_CHECKED})
_OF_SIZES = frozenset({
    Ground.SIZE_DOUBTED, Ground.NO_SIZE_FITS, Ground.SIZE_ESTIMATED, Ground.SIZE_UNCERTAIN, Ground.SIZE_UNTOLD,
})  # fmt: skip
#: What each ground makes too, which is then no fact of its own beside it.
_MADE_BY = {
    **dict.fromkeys(
        _MISREAD, _MADE_BY_A_MISTAKE | _NOT_DETERMINED | {Ground.NO_BOUND, Ground.NOT_CERTIFIED, Ground.LITTLE_ROTATION}
    ),
    **dict.fromkeys(
        (Ground.POSE_DOUBTED, Ground.CONTRADICTED, Ground.LATE_CLOCK, Ground.SIZE_DOUBTED), _MADE_BY_A_MISTAKE
    ),
    # If a frame moved, all its later measurements are outliers; and so are those of another sensor.
    **dict.fromkeys(
        (Ground.MOVED, Ground.MIXED),
        _MADE_BY_A_MISTAKE | {Ground.CONTRADICTED, Ground.TARGET_CONTRADICTED, Ground.MANY_OUTLIERS},
    ),
    # Wrong focal lengths make sizes look wrong, motions look alike, and errors that vary with where a board is seen.
    Ground.INTRINSICS_DOUBTED: _MADE_BY_A_MISTAKE | _NOT_DETERMINED | _OF_SIZES,
    # How well poses are known that are not determined is no question.
    Ground.NOT_UNIQUE: _UNASKED,
    Ground.KNOWN_TO_NOTHING: _UNASKED,
    Ground.NOISE_UNDERSTATED: frozenset({Ground.SIZE_UNTOLD}),
    **dict.fromkeys((Ground.NO_SCALE, Ground.NO_COVARIANCE), frozenset({Ground.NOT_CHECKED})),
}
_CALIBRATE_INTRINSICS = (
    "calibrate the intrinsics of the named sensor with its distortion (cv2.calibrateCamera, Kalibr, ROS's "
    "camera_calibration) at this resolution, and state them in place of the stated ones, or let the images tell them "
    "(in the rig file: intrinsics: estimate)"
)
_MEASURE_BOARD = "measure the named board (sizes, gaps, and the place and turn of each tag), and correct the rig file"
_ADVICE = {
    Ground.MISREAD: "correct how the measurements are read or given, and calibrate again",
    Ground.INTRINSICS_DOUBTED: _CALIBRATE_INTRINSICS,
    Ground.SHAPE_DOUBTED: _MEASURE_BOARD,
    Ground.IMPLAUSIBLE: (
        "check that A = T_sensorcarrier_targetcarrier and B = T_sensor_target, the order of the quaternions, the "
        "units, and that A and B are of the same instants"
    ),
    Ground.NO_SCALE: (
        "check that B = T_sensor_target and that A is not inverted, turn about a second axis, or state the sizes"
    ),
    Ground.NO_BOUND: "check the units and the frames of A and B, then calibrate again",
    Ground.NOT_CERTIFIED: "measure with more and larger rotations, then calibrate again",
    Ground.NOT_UNIQUE: "turn the carriers about at least two different axes and measure again, or fix what you know",
    Ground.KNOWN_TO_NOTHING: (
        "use nothing of the named frames but what is named as known; turn the carriers by 30 degrees and more about "
        "two axes, and check what the measurements disagree in (the carriers' poses and their drift, sizes, intrinsics)"
    ),
    Ground.POSE_DOUBTED: (
        "correct the stated pose of the named frame, or do not state it (leave out its prior, or do not fix it); if "
        "you are sure of it, check that the frame has not moved and has its right name"
    ),
    Ground.MOVED: (
        "fix what moved (tighten the mount of a sensor, screw a target down) and measure again, or calibrate with the "
        "measurements before it moved, or with those after it, alone"
    ),
    Ground.MIXED: (
        "give each of the two sensors its own folder of images, or its own topic, and its own entry in the rig file; "
        "then calibrate again"
    ),
    Ground.CONTRADICTED: (
        "check whether the named frame has moved, has another frame's name or was stated at a wrong pose, and whether "
        "its intrinsics are right and its clock is not late"
    ),
    Ground.NO_ANSWER: (
        "measure with the named sensor, or the named target, or leave it out of the problem or the rig file; the poses "
        "of the others are given"
    ),
    Ground.LATE_CLOCK: (
        'let its time offset be estimated: CalibrateOptions(time_offsets="auto"), in a rig file time_offset: estimate'
    ),
    Ground.SIZE_DOUBTED: (
        "measure the named targets again and state the right sizes, or let the motion tell them: rw.Problem(scale="
        '"per_target") or --scale per_target (in a rig file: sizes: estimate)'
    ),
    Ground.NO_SIZE_FITS: (
        "measure the named targets again and state the right sizes, and check that the carriers' positions are in "
        "metres; if the targets are as found, let the motion tell the sizes (in the rig file: sizes: estimate)"
    ),
    Ground.NO_COVARIANCE: "take more measurements",
    Ground.TARGET_CONTRADICTED: (
        "do not use the pose of the named target; check whether it has moved, and measure it again"
    ),
    Ground.LATE_POSES: (
        "log the carriers' pose and take the image when all is at rest; or give both with stamps, so that the clock's "
        "offset is estimated (stamps_ns; in a rig file time_offset: estimate)"
    ),
    Ground.INTRINSICS_UNCERTAIN: _CALIBRATE_INTRINSICS,
    Ground.SHAPE_UNCERTAIN: _MEASURE_BOARD,
    Ground.SIZE_UNCERTAIN: (
        "measure the named target with a caliper (of clouds: a known length with the sensor), or let its size be "
        'estimated: rw.Problem(scale="per_target"), of clouds "shared", or --scale per_target (in a rig file: sizes: '
        "estimate)"
    ),
    Ground.SIZE_UNTOLD: (
        "measure the named target with a caliper (of clouds: a known length with the sensor), state it, and say that "
        'it is known: sizes="known" (in a rig file: sizes: known), or measure from other distances too'
    ),
    Ground.CLOUDS_STRETCHED: (
        "calibrate the intrinsics of the named 3D camera at this resolution (its focal length in pixels), and make the "
        "clouds again with them"
    ),
    Ground.POSE_UNCERTAIN: (
        "measure the stated pose again, or state it as uncertain as it is: Problem.add_prior in place of Problem.fix"
    ),
    Ground.IMAGE_TURNED: (
        "turn the named images back, or take them out, and look for what turned them: others may have been turned too"
    ),
    Ground.IMAGES_BLURRED: (
        "stand still for each image, or expose for a shorter time with more light, or focus the lens, and measure again"
    ),
    Ground.HEIGHT_WEAK: (
        "measure the height of the named sensor by hand and put it in the place of this one, or state it (with "
        "Problem.add_prior, or in a rig file of odometries under given: heights_m), or drive over ramps, so that the "
        "vehicle pitches and rolls"
    ),
    Ground.LITTLE_ROTATION: "turn the carriers by 30 degrees and more, about two different axes, and measure again",
    Ground.FEW_MEASUREMENTS: "measure each named frame at three poses or more, or do not use its pose",
    Ground.ROWS_REPAIRED: (
        "correct the script that pairs A and B, and look whether the named rows are where an image has no detection, "
        "before you rely on the poses"
    ),
    Ground.SIZE_ESTIMATED: "measure the named target again, and correct its size",
    Ground.INTRINSICS_ESTIMATED: (
        "check which calibration the stated intrinsics of the named sensor are from (its resolution, its lens), and "
        "state the estimated ones (in camchain.yaml and result.json; in Python `refined.intrinsics`) if they hold in "
        "another run"
    ),
    Ground.CORNERS_DOUBTED: (
        "look at the images for corners that are misread, check the board (its sizes, whether it is flat, the order of "
        "its corners) and the stated intrinsics, and calibrate again"
    ),
    Ground.CORRELATED: "use the poses, but do not rely on their standard deviations",
    Ground.SYSTEMATIC: "measure at more and wider spread poses, calibrate the arm itself, and check intrinsics",
    Ground.NOT_CHECKED: (
        "measure so that the named check can run (more measurements, kept with the problem, and poses of the carriers "
        "without gaps), or check the poses in another way before you rely on them"
    ),
    Ground.MANY_OUTLIERS: (
        "look at what was left out, and check that each B belongs to its A (order, stamps, names of files)"
    ),
    Ground.OUTLIERS_KEPT: (
        'let them be found and left out: CalibrateOptions(robust="auto") or --robust auto (in a rig file: robust: gnc)'
    ),
    Ground.NOISE_UNDERSTATED: (
        'let the noise be estimated: CalibrateOptions(noise="auto") or --noise auto (in a rig file: noise: estimate), '
        "or state it as large as it is"
    ),
    Ground.NOISE_OVERSTATED: (
        "state the noise of A as large as it is, or leave it out: it is then estimated from the residuals"
    ),
    Ground.COVARIANCE_DOUBTED: "use the poses, but do not rely on their standard deviations",
}


@dataclass(frozen=True)
class Finding:
    """A ground that was found, with its words: the fact, with figures and names, without a full stop."""

    ground: Ground
    words: str


@dataclass(frozen=True)
class Judgement:
    """A verdict with its grounds."""

    verdict: Verdict  #: What to do with the poses
    grounds: tuple[Ground, ...]  #: Reasons not to use the poses, the most serious first; empty for ``Verdict.USE``.
    #: The grounds in words, and what to do about the first; where all of them ask for care only, about each
    reason: str

    def __str__(self) -> str:
        return f"{self.verdict.words}: {self.reason}."

    @property
    def is_of_the_reading(self) -> bool:
        """Whether A and B were misread, or their residuals are of no sensor: then nothing else counts."""
        return bool(_MISREAD.intersection(self.grounds))

    @staticmethod
    def of(findings: list[Finding], praise: str, advice_on: Mapping[Ground, str] | None = None) -> Judgement:
        """The judgement that some findings lead to; without any, ``praise`` is why the poses are to be used.

        ``advice_on`` has what to do about grounds of which their own advice does not speak.

        What a mistake makes is no ground beside it: what a misreading leaves undetermined says nothing of the motion,
        and errors that a wrong size, wrong intrinsics or a late clock make say nothing of the arm.
        """
        made = frozenset[Ground]().union(*(_MADE_BY.get(finding.ground, ()) for finding in findings))
        findings = [finding for finding in findings if finding.ground not in made]
        if not findings:
            return Judgement(Verdict.USE, (), praise)
        by_ground: dict[Ground, list[str]] = {}
        for finding in sorted(findings, key=lambda finding: _rank(finding.ground)):
            words = by_ground.setdefault(finding.ground, [])
            if finding.words not in words:
                words.append(finding.words)
        grounds = tuple(by_ground)
        worst = grounds[0].verdict
        facts = "; ".join(words for group in by_ground.values() for words in group)
        # The ground that makes poses useless comes first; the others may disappear with it.
        what_to_do = [(advice_on or {}).get(ground, ground.advice) for ground in grounds]
        advice = what_to_do[:1] if worst is Verdict.DO_NOT_USE else list(dict.fromkeys(what_to_do))
        numbered = advice if len(advice) == 1 else [f"({i}) {each}" for i, each in enumerate(advice, start=1)]
        return Judgement(worst, grounds, f"{facts}. What to do: {'; '.join(numbered)}")


def proof_of(refined: RefinedPoses | None) -> str:
    """Why poses without any finding against them are to be used."""
    nothing_against = (
        "no other poses fit them better" if refined is None else "nothing that was looked for speaks against them"
    )
    directions = () if refined is None else refined.free_directions
    sliding = dict.fromkeys(name for one in directions for name in one.frames)
    but = f" but what slides of {', '.join(sliding)}" if sliding else ""
    return f"the measurements determine every pose{but}, and {nothing_against}"


def findings_of(solution: Solution | None, refined: RefinedPoses | None = None) -> list[Finding]:
    """What the certificate and the free directions say against the poses.

    Parameters
    ----------
    solution : Solution, optional
        The certified solution.
    refined : RefinedPoses, optional
        The refined calibration.
    """
    if solution is None:
        return []
    status, found = solution.certificate.status, []
    if status is Status.FAILED:
        found = [Finding(Ground.NO_BOUND, "no lower bound of the cost was found, so a much better answer may exist")]
    elif status is Status.GAP:
        gap = rounded(100.0 * solution.certificate.relative_gap)
        words = f"a better answer may exist; its cost would be lower by at most {gap} %"
        found = [Finding(Ground.NOT_CERTIFIED, words)]
    directions = [*solution.identifiability.free_directions, *(() if refined is None else refined.free_directions)]
    is_unique = solution.identifiability.is_unique and status is not Status.CERTIFIED_NOT_UNIQUE
    # A target that slides leaves its own pose free, and no other frame's.
    if directions and all_slide(directions):
        is_unique, directions = True, []
    if not is_unique or directions:
        most = max((residual.number_of_measurements for residual in solution.residuals.values()), default=0)
        words = "the measurements do not determine all poses; other poses fit them equally well"
        if most <= FEW:
            words = (
                f"the measurements are too few ({most} of a pair at most, which is not more than one motion about one "
                "axis); other poses fit them equally well"
            )
        found.append(Finding(Ground.NOT_UNIQUE, words))
    return found


#: The name of the choice that says why there is no refined calibration.
REFINEMENT = "covariances"
#: The name of the choice about the frames and units of A and B.
READING = "reading of A and B"
#: The name of the choice about outliers.
OUTLIERS = "outliers"


@dataclass(frozen=True)
class Choice:
    """One choice that ``calibrate`` made, or could not make; ``str()`` is one sentence."""

    what: str  #: What was to be chosen: "outliers", "noise of B", "time offsets", ...
    chosen: str  #: What was chosen, in words
    evidence: str  #: Why: what the data show, what an option said, or why no choice could be made

    def __str__(self) -> str:
        return f"{self.what[:1].upper()}{self.what[1:]}: {self.chosen}, because {self.evidence}."
