"""Where the measurements of the demo are, and with which noise they were made."""

from __future__ import annotations

import math
from importlib.resources import files
from pathlib import Path

from gtsam_rwhec.errors import FileFormatError

SIGMA_M = 0.005
"""Standard deviation of the demo's measured translations, along each axis."""

KAPPA = 1.0 / (2.0 * math.radians(0.5) ** 2)
"""Concentration that belongs to 0.5 degrees about each axis: kappa = 1 / (2 sigma_R^2)."""


def demo_folder() -> Path:
    """The folder of CSV files: inside the package when installed from a wheel, ``data/demo`` in a checkout.

    Raises
    ------
    FileFormatError
        Neither is there.
    """
    package = Path(str(files("gtsam_rwhec")))
    candidates = (package / "demo_data", package.parent / "data" / "demo")
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise FileFormatError(
        f"The demo's data is at neither {candidates[0]} nor {candidates[1]}: install the package again."
    )
