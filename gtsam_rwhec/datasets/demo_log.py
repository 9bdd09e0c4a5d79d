"""Where the demo's log is."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from gtsam_rwhec.errors import FileFormatError

LOG, RIG = "robot_cell.mcap", "rig.yaml"


def demo_folder() -> Path:
    """The folder of the shipped log: inside the package when installed from a wheel, ``data/cell`` in a checkout.

    Raises
    ------
    FileFormatError
        Neither is there.
    """
    package = Path(str(files("gtsam_rwhec")))
    candidates = (package / "demo_data", package.parent / "data" / "cell")
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise FileFormatError(
        f"The demo's data is at neither {candidates[0]} nor {candidates[1]}: install the package again."
    )
