"""The calibration of a unit: from merged moments by default, from the measurements of its logs on request."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions
from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.stages import calibrate
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.fleet.consistency import check_logs
from gtsam_rwhec.fleet.detection_covariance import with_covariances_of_detections
from gtsam_rwhec.fleet.log_agreement import disagreeing_logs
from gtsam_rwhec.fleet.log_facts import findings_of_logs, merged_fields
from gtsam_rwhec.fleet.measured_problem import MeasuredProblem
from gtsam_rwhec.fleet.merging import Merged
from gtsam_rwhec.problem.selection import problem_of_moments
from gtsam_rwhec.results.log_history import LogFields, TimeOffsetFields
from gtsam_rwhec.results.result_file import result_json
from gtsam_rwhec.results.result_judgement import judge, short_of_measurements
from gtsam_rwhec.rig import Rig


@dataclass(frozen=True, eq=False)
class UnitCalibration:
    """A unit's calibration, its logs' history, and the content of its result file."""

    calibration: Calibration
    fields: LogFields
    result: bytes

    @property
    def condition(self) -> float | None:
        """Condition number of the information about what is determined, in radians and typical lengths.

        None where nothing was refined.
        """
        refined = self.calibration.refined
        if refined is None or not len(refined.joint.unit):
            return None
        joint = refined.joint
        rows = joint.rows(tuple(one for one in joint.slots if one.kind in (UnknownKind.FRAME, UnknownKind.SCALE)))
        unit = joint.unit[rows]
        values = np.linalg.eigvalsh(joint.finite[np.ix_(rows, rows)] / unit[:, None] / unit)[joint.free.shape[1] :]
        return float(values[-1] / values[0]) if len(values) and values[0] > 0.0 else None


def joined_rig(rigs: Sequence[Rig]) -> Rig:
    """One rig with the sensors and targets of all of a robot's rig files, which agree (`check_rigs`)."""
    first = rigs[0]
    sensors = {name: sensor for rig in reversed(rigs) for name, sensor in rig.sensors.items()}
    targets = {name: target for rig in reversed(rigs) for name, target in rig.targets.items()}
    return first.model_copy(update={"sensors": sensors, "targets": targets})


def calibrated(
    of: Merged, rigs: Mapping[str, Rig], measured: MeasuredProblem, *, refine: bool, at_site: bool
) -> UnitCalibration:
    """Calibrate a unit.

    Parameters
    ----------
    of : Merged
        Its logs and their moments.
    rigs : dict of str to Rig
        By robot.
    measured : MeasuredProblem
        Its measurements.
    refine : bool
        Whether to calibrate from the measurements. Else from the moments; the measurements' covariances are then those
        of the answer (`detection_covariance`).
    at_site : bool
        Whether several robots are solved together.

    Raises
    ------
    RigError
        The logs contradict each other.
    RwhecError
        As ``calibrate`` does.
    """
    check_logs(of.logs)
    rig = next(iter(rigs.values()))
    facts = [log.facts for log in of.logs]
    sensor_carrier = None if at_site else rig.carriers.sensors
    options = CalibrateOptions(
        noise="estimate" if rig.noise == "estimate" else "given",
        robust="auto" if rig.cleaning.robust == "gnc" else "none",
        sizes="known" if rig.sizes == "known" else "check",
        time_offsets=False,
    )
    if not refine:
        problem = problem_of_moments(
            of.moments.moments(),
            of.moments.gauge,
            "per_target" if rig.sizes == "estimate" else "known",
            is_relative=of.moments.is_relative,
            sensor_carrier=sensor_carrier,
            target_carrier=rig.carriers.targets,
        )
    else:
        problem = measured.problem
        problem.sensor_carrier, problem.target_carrier = sensor_carrier, rig.carriers.targets
        options = replace(
            options,
            carrier_noise=measured.carrier_noise,
            time_offsets=measured.estimated or False,
            carrier_path=measured.path if measured.estimated else None,
        )
    found = calibrate(problem, options)
    if not refine:
        found = with_covariances_of_detections(found, measured.problem, measured.covariances)
    counts = {pair: (used, there) for pair, (used, there) in found.outliers.counts.items()}
    if not counts:
        counts = {pair: (int(n), int(n)) for pair, n in zip(of.moments.pairs, of.moments.count, strict=True)}
    fields = merged_fields(facts, counts)
    if at_site:
        fields = fields.model_copy(update={"sensor_carrier": "each robot's own"})
    fields = _with_offsets(fields, found)
    poses: dict[str, int] = {}
    for log in facts:
        for name, number in log.poses.items():
            poses[name] = poses.get(name, 0) + number
    findings = (*found.findings, *findings_of_logs(facts), *short_of_measurements(fields, poses))
    if not refine:
        findings += disagreeing_logs(found, measured)
    if not refine or not measured.estimated:
        findings += tuple(_of_clocks(fields))
    notes = (*found.notes, *dict.fromkeys(words for log in facts for words in log.warnings))
    judgement = found.judgement
    if found.solution is not None:
        judgement = judge(found.solution, found.refined, fields, findings)
    found = replace(found, findings=findings, judgement=judgement, notes=notes)
    return UnitCalibration(found, fields, result_json(found, fields, "the result of a unit"))


def _with_offsets(fields: LogFields, found: Calibration) -> LogFields:
    """The history with the whole offsets of clocks: that of cleaning, and what the refinement added."""
    refined = found.refined
    if not isinstance(refined, Refined) or not refined.time_offsets_s:
        return fields
    offsets = []
    for one in fields.time_offsets:
        change_s = refined.time_offsets_s.get(one.sensor)
        if change_s is None:
            offsets.append(one)
            continue
        variance = float(refined.covariance(f"time_offset:{one.sensor}")[0, 0])
        sigma_s = float(np.sqrt(variance)) if np.isfinite(variance) else None
        offsets.append(TimeOffsetFields(sensor=one.sensor, offset_s=one.offset_s + change_s, sigma_s=sigma_s))
    return fields.model_copy(update={"time_offsets": tuple(offsets)})


def _of_clocks(fields: LogFields) -> list[Finding]:
    """That clocks were estimated by rotations alone, which standard deviations of poses do not hold."""
    sigmas = fields.cleaning.coarse_sigma_s
    if not sigmas:
        return []
    told = ", ".join(f"{name} to +-{1e3 * sigma_s:.1f} ms" for name, sigma_s in sigmas.items())
    words = (
        f"time offsets are those that rotations alone tell, log by log ({told}), and the poses' standard deviations do "
        "not hold their errors; --refine estimates them with the poses of a robot that is solved alone"
    )
    return [Finding(Ground.COVARIANCE_DOUBTED, words)]
