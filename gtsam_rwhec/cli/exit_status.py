"""What the command's exit status means; scripts may rely on these numbers."""

from __future__ import annotations

from enum import IntEnum

import gtsam_rwhec as rw


class ExitStatus(IntEnum):
    """Exit statuses of every subcommand."""

    DONE = CERTIFIED = 0
    """Done; a calibration is certified and determined by the measurements."""
    BAD_INPUT = 2
    """An argument, a file or a measurement cannot be used; the message says which."""
    NOT_UNIQUE = 3
    """No answer is better, but the measurements leave some frames free: do not use those."""
    NOT_CERTIFIED = 4
    """An answer without a proof that there is no better one."""
    DOWNLOAD_FAILED = 5
    """No network, or not the expected files; what was downloaded stays."""
    CONTRADICTED = 6
    """Most measurements of a sensor or target were left out as outliers: do not use the answer."""
    INTERRUPTED = 130
    """Ctrl-C."""


HELP = (
    "Exit status: 0 certified (or done); 2 bad input; 3 certified, but the measurements do not determine every frame; "
    "4 not certified; 5 download failed; 6 most measurements of a frame contradict the answer; 130 interrupted."
)


def exit_status(judgement: rw.Judgement) -> ExitStatus:
    """The exit status that the gravest ground of a judgement leads to."""
    ground = rw.Ground
    status = {
        ground.NO_BOUND: ExitStatus.NOT_CERTIFIED,
        ground.NOT_CERTIFIED: ExitStatus.NOT_CERTIFIED,
        ground.NOT_UNIQUE: ExitStatus.NOT_UNIQUE,
        ground.CONTRADICTED: ExitStatus.CONTRADICTED,
        ground.SIZE_DOUBTED: ExitStatus.CERTIFIED,
    }
    return status[judgement.grounds[0]] if judgement.grounds else ExitStatus.CERTIFIED
