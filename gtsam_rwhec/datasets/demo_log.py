"""The demo's log, and the true calibration that it was made with."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import gtsam
import numpy as np

from gtsam_rwhec.errors import FileFormatError

#: The demo's folder has these files: the log, its rig file, and the truth.
LOG, RIG, TRUTH = "robot_cell.mcap", "rig.yaml", "truth.json"


def demo_folder() -> Path:
    """The folder of the shipped log: inside the package when installed from a wheel, ``data/cell`` in a checkout.

    Raises
    ------
    FileFormatError
        When neither folder is there.
    """
    package = Path(str(files("gtsam_rwhec")))
    candidates = (package / "demo_data", package.parent / "data" / "cell")
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise FileFormatError(
        f"The demo's data is at neither {candidates[0]} nor {candidates[1]}: install the package again."
    )


@dataclass(frozen=True)
class DemoTruth:
    """The facts that the log was made with.

    Attributes
    ----------
    X : dict of str to gtsam.Pose3
        T_base_target by target, metres.
    Y : dict of str to gtsam.Pose3
        T_hand_camera by camera, metres.
    time_offsets_s : dict of str to float
        By camera, seconds: the camera's stamp t is the robot's t + offset.
    scale : dict of str to float
        Stated length over true length, by target.
    twice_seen : str
        The target whose tag a poster shows a second time.
    twice_seen_by : str
        The camera that sees the poster.
    twice_seen_in : int
        Number of that camera's images with the poster.
    """

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    time_offsets_s: dict[str, float]
    scale: dict[str, float]
    twice_seen: str
    twice_seen_by: str
    twice_seen_in: int


def demo_truth() -> DemoTruth:
    """The truth of the demo's log. Raises a FileFormatError if the demo's data is not there."""
    raw = json.loads((demo_folder() / TRUTH).read_text(encoding="utf-8"))
    return DemoTruth(
        X={name: gtsam.Pose3(np.array(T)) for name, T in raw["T_base_target"].items()},
        Y={name: gtsam.Pose3(np.array(T)) for name, T in raw["T_hand_camera"].items()},
        time_offsets_s=raw["time_offset_s"],
        scale=raw["scale"],
        twice_seen=raw["poster"]["target"],
        twice_seen_by=raw["poster"]["camera"],
        twice_seen_in=len(raw["poster"]["stamps_ns"]),
    )
