"""The rows of a unit's calibration: one for a robot, one for each robot of a site."""

from __future__ import annotations

import math

from gtsam_rwhec.fleet.log_facts import removed_of
from gtsam_rwhec.fleet.merging import Merged, sensor_name
from gtsam_rwhec.fleet.rows import RobotRow, RowFrame
from gtsam_rwhec.fleet.unit_calibration import UnitCalibration


def result_file(unit: str) -> str:
    """The place of a unit's result file below the output."""
    return f"robots/{unit}/result.json"


def rows_of(unit: str, site: str | None, of: Merged, found: UnitCalibration) -> list[RobotRow]:
    """The rows of a unit; costs and failed logs are not in them, since they are not of the calibration.

    Parameters
    ----------
    unit : str
        Its name, which names its folder.
    site : str or None
        The site whose robots were solved together.
    of : Merged
        Its logs.
    found : UnitCalibration
    """
    robots = list(dict.fromkeys(log.robot for log in of.logs))
    checksum = of.moments.sha256()
    return [_row(unit, site, robot, of, found, checksum) for robot in robots]


def _row(unit: str, site: str | None, robot: str, of: Merged, found: UnitCalibration, moments_sha256: str) -> RobotRow:
    calibration = found.calibration
    logs = [log for log in of.logs if log.robot == robot]
    pairs = [pair for pair in of.moments.pairs if site is None or pair.sensor.startswith(sensor_name(robot, ""))]
    sensors = [name for name in calibration.Y if any(name == pair.sensor for pair in pairs)]
    targets = [name for name in calibration.X if any(name == pair.target for pair in pairs)]
    own = len(sensor_name(robot, "")) if site is not None else 0
    frames = [RowFrame(name[own:], "sensor", calibration.Y[name].matrix()) for name in sensors]
    frames += [RowFrame(name, "target", calibration.X[name].matrix()) for name in targets]
    refined, solution = calibration.refined, calibration.solution
    certificate = None if solution is None else solution.certificate
    number = {pair: int(count) for pair, count in zip(of.moments.pairs, of.moments.count, strict=True)}
    used = {count.pair: count.used for count in found.fields.outliers}
    facts = [log.facts for log in logs]
    return RobotRow(
        unit=unit,
        robot=robot,
        site=site,
        begin_ns=min(one.begin_ns for one in facts),
        end_ns=max(one.end_ns for one in facts),
        verdict=calibration.verdict,
        reason=calibration.verdict_reason,
        grounds=calibration.judgement.grounds,
        status=None if certificate is None else certificate.status,
        basis=None if certificate is None else certificate.basis,
        frames=tuple(frames),
        covariance=None if refined is None or not frames else refined.covariance(*sensors, *targets),
        constant_errors=() if calibration.noise.model is None else calibration.noise.model.constant_deviations,
        degrees_of_freedom=math.inf if refined is None else refined.degrees_of_freedom,
        scale=calibration.scale,
        condition=found.condition,
        moments_sha256=moments_sha256,
        logs=len(logs),
        measurements=sum(used.get(pair, number[pair]) for pair in pairs),
        result=result_file(unit),
        removed=removed_of(facts),
        findings=tuple(
            dict.fromkeys(
                [*(finding.words for finding in calibration.findings), *(w for one in facts for w in one.warnings)]
            )
        ),
        receipts=tuple(sorted(log.key for log in logs)),
    )
