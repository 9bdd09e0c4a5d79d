"""The exit statuses of the command; scripts may rely on these numbers."""

from __future__ import annotations

from enum import IntEnum

import gtsam_rwhec as rw


class ExitStatus(IntEnum):
    """Exit statuses of every subcommand."""

    DONE = CERTIFIED = 0
    """The command succeeded; a calibration is certified, and the measurements determine it."""
    BAD_INPUT = 2
    """An option, a file or a measurement cannot be used; the message says which."""
    NOT_UNIQUE = 3
    """The answer is certified, but the measurements do not determine every frame: do not use the poses."""
    NOT_CERTIFIED = 4
    """The answer is not certified: a better answer may exist."""
    DOWNLOAD_FAILED = 5
    """No network, or not the expected files; complete files stay."""
    CONTRADICTED = 6
    """Most measurements of a sensor or target are outliers, or the motion contradicts a stated size that was used."""
    INTERRUPTED = 130
    """Ctrl-C."""


HELP = (
    "Exit status: 0 success, and certified; 2 bad input; 3 certified, but the measurements do not determine every "
    "frame; 4 not certified; 5 download failed; 6 most measurements of a frame are outliers, or a stated size is "
    "wrong; 130 interrupted."
)


def exit_status(judgement: rw.Judgement) -> ExitStatus:
    """The exit status for the most serious ground of a judgement; 0 only without any ground."""
    ground = rw.Ground
    status = {
        ground.NO_BOUND: ExitStatus.NOT_CERTIFIED,
        ground.NOT_CERTIFIED: ExitStatus.NOT_CERTIFIED,
        ground.NOT_UNIQUE: ExitStatus.NOT_UNIQUE,
        ground.CONTRADICTED: ExitStatus.CONTRADICTED,
        ground.SIZE_DOUBTED: ExitStatus.CONTRADICTED,
    }
    return status[judgement.grounds[0]] if judgement.grounds else ExitStatus.CERTIFIED
