"""The evidence of a calibration from a log, gathered: what its report shows beside the result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gtsam_rwhec.evidence import Evidence
from gtsam_rwhec.evidence.inputs import Inputs, input_files, versions
from gtsam_rwhec.pipeline.solving_stage import Calibrated
from gtsam_rwhec.rig import rig_text


def evidence_of_log(calibrated: Calibrated, log_path: str | Path, sources: Sequence[Path]) -> Evidence:
    """What a report shows beside a calibration from a log.

    Parameters
    ----------
    calibrated : Calibrated
    log_path
        The solved log, which has the corners.
    sources : sequence of Path
        The files that the measurements come from.
    """
    return Evidence(
        inputs=Inputs(files=input_files(sources), versions=versions(), rig_file=rig_text(calibrated.rig)),
    )
