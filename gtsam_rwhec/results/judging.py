"""The judgement of a calibration by the facts that its result file holds."""

from __future__ import annotations

from collections.abc import Sequence

from gtsam_rwhec.calibration.disagreement import LeftOut, contradicted_frames
from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement, findings_of, proof_of
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.results.log_history import FrameOutliers, LogFields
from gtsam_rwhec.results.unanswered import shortage
from gtsam_rwhec.solving.solution import Solution


def contradicted_names(refined: RefinedPoses | None, log: LogFields | None = None) -> frozenset[str]:
    """The sensors and targets whose own measurements contradict the answer, half of them or nearly: not to be used."""
    return frozenset(one.frame for one in contradicted(refined, log))


def contradicted(refined: RefinedPoses | None, log: LogFields | None = None) -> tuple[LeftOut | FrameOutliers, ...]:
    """The same with the counts of their measurements."""
    if log is not None:
        return tuple(log.contradicted)
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
    if not isinstance(solution, Solution):
        raise OptionError(f"the solution is a {type(solution).__name__}; give what gtsam_rwhec.solve returned")
    found = [*findings_of(solution, refined), *findings]
    if log is not None:
        sensors = {count.sensor for count in log.outliers}
        found += [
            Finding(Ground.CONTRADICTED if one.frame in sensors else Ground.TARGET_CONTRADICTED, str(one))
            for one in log.contradicted
        ]
        used = {count.sensor for count in log.outliers if count.used}
        found += [Finding(Ground.NO_ANSWER, shortage(log, name)) for name in log.detection.images if name not in used]
        doubted = [size.target for size in log.sizes if size.is_doubted and not size.is_free]
        if doubted:
            words = f"the stated size of {', '.join(doubted)} does not fit the motion"
            found.append(Finding(Ground.SIZE_DOUBTED, words))
        found += [
            Finding(Ground.SIZE_UNCERTAIN, f"the stated size of {size.target} fits the motion badly")
            for size in log.sizes
            if size.is_uncertain and not size.is_free
        ]
    return Judgement.of(found, proof_of(refined))
