"""What a calibration says."""

from __future__ import annotations

import gtsam_rwhec as rw


def choice(calibration: rw.Calibration, what: str) -> rw.Choice:
    return next(choice for choice in calibration.choices if choice.what == what)
