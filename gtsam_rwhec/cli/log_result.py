"""What the user sees of a calibrated log."""

from __future__ import annotations

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus, exit_status


def show(calibrated: rw.pipeline.Calibrated) -> ExitStatus:
    """Print the report; the exit status that the calibration leads to."""
    refined = calibrated.refined
    rw.report.print_refined(refined, log=calibrated.log)
    return exit_status(rw.judge(refined.solution, refined, calibrated.log))
