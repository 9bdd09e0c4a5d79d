"""The exit statuses of the command; scripts may rely on these numbers."""

from __future__ import annotations

from enum import IntEnum

import gtsam_rwhec as rw


class ExitStatus(IntEnum):
    """Exit statuses of every subcommand."""

    DONE = CERTIFIED = 0
    """The command succeeded; the poses of a calibration may be used, with care or without. With a rig file: each of its
    sensors and targets has a pose that the measurements determine and agree to."""
    CHANGED = 1
    """``diff``, ``fleet watch``: something changed by more than chance. ``verify``: the old one no longer holds.
    ``fleet run``: a log or a robot failed, or the poses of one are not to be used."""
    BAD_INPUT = 2
    """An option, a file or a measurement cannot be used; the message says which."""
    NOT_UNIQUE = 3
    """The answer is certified, but the measurements do not determine every frame: do not use the poses. Or a target of
    the rig file has too few measurements for any to be checked: do not use its pose."""
    NOT_CERTIFIED = 4
    """The answer is not certified: a better answer may exist."""
    DOWNLOAD_FAILED = 5
    """No network, or not the expected files; complete files stay."""
    CONTRADICTED = 6
    """The measurements contradict the answer: they were misread, a stated size is wrong, most measurements of a frame
    are outliers, or a sensor, or a target of the rig file, has no measurement that agrees."""
    INTERRUPTED = 130
    """Ctrl-C."""


HELP = (
    "Exit status: 0 success, and the poses may be used; 1 diff, verify or fleet watch found a change, or some of a "
    "fleet failed; 2 bad input; 3 the measurements do not determine every frame; 4 not proven optimal; 5 download "
    "failed; 6 the measurements contradict the answer (misread, a wrong size, a sensor or a target without an answer); "
    "130 interrupted."
)


def exit_status(judgement: rw.Judgement, *, of_rig: bool = False) -> ExitStatus:
    """0 if the poses may be used, with care or without; else the status of the most serious ground.

    With a rig file (``of_rig``) it is 0 only if the pose of each of its sensors and targets may be used.
    """
    ground = rw.Ground
    if judgement.verdict is not rw.Verdict.DO_NOT_USE:
        if of_rig and ground.TARGET_CONTRADICTED in judgement.grounds:
            return ExitStatus.CONTRADICTED
        if of_rig and ground.FEW_MEASUREMENTS in judgement.grounds:
            return ExitStatus.NOT_UNIQUE
        return ExitStatus.CERTIFIED
    status = {
        ground.NO_BOUND: ExitStatus.NOT_CERTIFIED,
        ground.NOT_CERTIFIED: ExitStatus.NOT_CERTIFIED,
        ground.NOT_UNIQUE: ExitStatus.NOT_UNIQUE,
        ground.NO_COVARIANCE: ExitStatus.NOT_UNIQUE,
    }
    return status.get(judgement.grounds[0], ExitStatus.CONTRADICTED)
