"""The judgement of a calibration by the facts that its result file holds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from gtsam_rwhec.calibration.outliers import FEWEST_OF_A_FRAME, MANY, LeftOut, contradicted_frames
from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement, findings_of, proof_of
from gtsam_rwhec.files.terminal_text import counted
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.geometry.real_numbers import check_kind
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.solver.solution import Solution


def contradicted_names(refined: RefinedPoses | None, log: LogFields | None = None) -> frozenset[str]:
    """The sensors and targets whose own measurements contradict the answer, half of them or nearly: not to be used."""
    return frozenset(one.frame for one in contradicted(refined, log))


def contradicted(refined: RefinedPoses | None, log: LogFields | None = None) -> tuple[LeftOut, ...]:
    """The same with the counts of their measurements."""
    if log is not None:
        return log.contradicted
    return contradicted_frames({} if refined is None else refined.inlier_counts)


def judge(
    solution: Solution,
    refined: RefinedPoses | None = None,
    log: LogFields | None = None,
    findings: Sequence[Finding] = (),
) -> Judgement:
    """Judge a calibration by its facts.

    Parameters
    ----------
    solution : Solution
        The certified solution.
    refined : RefinedPoses, optional
        The refined calibration.
    log : LogFields, optional
        What became of the measurements, if they come from a log.
    findings : sequence of Finding, optional
        What ``calibrate`` found besides: misreadings, sizes, sensors without an answer.
    """
    check_kind(solution, Solution, "the solution", "what gtsam_rwhec.solve returned")
    found = [*findings_of(solution, refined), *findings]
    if log is not None:
        sensors = {count.sensor for count in log.outliers}
        found += [
            Finding(Ground.CONTRADICTED if one.frame in sensors else Ground.TARGET_CONTRADICTED, str(one))
            for one in log.contradicted
        ]
        used_of, all_of = np.array([*log.agreement.values(), (0, 0)]).sum(axis=0).tolist()
        is_said = any(one.ground is Ground.MANY_OUTLIERS for one in findings)  # of a stream, from fewer on
        if not is_said and not log.contradicted and all_of - used_of > MANY * all_of:
            words = f"{all_of - used_of} of {all_of} measurements contradict the answer and were left out"
            found.append(Finding(Ground.MANY_OUTLIERS, words))
        used = {count.sensor for count in log.outliers if count.used}
        found += [Finding(Ground.NO_ANSWER, shortage(log, name)) for name in log.detection.images if name not in used]
        stated = [size for size in log.sizes if not size.is_free]
        doubted = ", ".join(size.target for size in stated if size.is_doubted)
        if doubted:
            found.append(Finding(Ground.SIZE_DOUBTED, f"the stated size of {doubted} does not fit the motion"))
        found += [
            Finding(Ground.SIZE_UNCERTAIN, f"the stated size of {size.target} fits the motion badly")
            for size in stated
            if size.is_uncertain
        ]
    return Judgement.of(found, proof_of(refined))


#: What a frame's pose needs: two motions about different axes are three poses.
NEEDED = "at least 3 poses with two turning axes are needed"
#: Words name at most this many reasons for which measurements were removed.
MOST_REASONS = 3


def short_of_measurements(log: LogFields, poses: Mapping[str, int]) -> list[Finding]:
    """What speaks against the sensors and targets of the rig file that have no answer, or rest on too few measurements.

    A sensor that was used at fewer than ``FEWEST_OF_A_FRAME`` poses has an answer that nothing can check. If a target
    was seen at one or two, only its own pose is in doubt: the sensors' poses do not depend on it. ``poses`` has at how
    many poses of the carriers the answer uses each, and may lack those without any.
    """
    sensors = log.detection.images
    targets = dict.fromkeys((*log.detection.unseen, *(track.target for track in log.detection.tracks)))
    few = {name: poses.get(name, 0) for name in (*sensors, *targets) if poses.get(name, 0) < FEWEST_OF_A_FRAME}
    return [
        Finding(Ground.FEW_MEASUREMENTS if count and name in targets else Ground.NO_ANSWER, shortage(log, name, count))
        for name, count in few.items()
    ]


def shortage(log: LogFields, name: str, poses: int = 0) -> str:
    """``camera3: 2 measurements at 2 poses (of 9 detections in 40 images; ...), at least 3 poses ... are needed``."""
    count = sum(count.used for count in log.outliers if name in count.pair)
    at = f" at {counted(poses, 'pose')}" if count and poses else ""
    return f"{name}: {counted(count, 'measurement')}{at} ({_history(log, name)}), {NEEDED}"


def _history(log: LogFields, name: str) -> str:
    """How often a frame was seen, and why measurements of it were removed."""
    detected = [track for track in log.detection.tracks if name in track.pair]
    seen, images = sum(track.seen for track in detected), log.detection.images.get(name)
    if not seen:
        return "no sensor saw it" if images is None else f"its {images} images show no target"
    removed = Counter[str]()
    stages = {track.pair: track for track in (*detected, *(t for t in log.cleaning.tracks if name in t.pair))}
    for track in stages.values():  # the cleaning counts the rejections of the detection again
        removed.update(track.removed)
    removed["outlier"] += sum(count.left_out for count in log.outliers if name in count.pair)
    reasons = [f"{why.split(' (')[0]}: {number}" for why, number in removed.most_common(MOST_REASONS) if number]
    where = "" if images is None else f" in {images} images"
    return "; ".join([f"of {counted(seen, 'detection')}{where}", *reasons])
