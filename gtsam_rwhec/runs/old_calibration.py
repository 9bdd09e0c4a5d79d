"""An old calibration of a log as its output folder holds it: result, rig file and intrinsics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.results.result_file import Result, parse_result, read_result, result_path
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.sections import Intrinsics
from gtsam_rwhec.runs.run_log import CALIBRATION_LOG, RESULT_FILE, read_cameras, read_embedded_rig


@dataclass(frozen=True, eq=False)
class OldCalibration:
    """An old calibration of a log, as its output folder holds it."""

    result: Result
    rig: Rig | None  #: The rig file in its solved log
    cameras: dict[str, Camera]  #: Intrinsics as it has them: estimated where they were

    @staticmethod
    def read(path: str | Path) -> OldCalibration:
        """Read it from an output folder, its ``calibration.mcap``, or a result file (the solved log may be beside it).

        Raises
        ------
        FileFormatError, LogError
            The files cannot be read, or hold no calibration.
        """
        path = Path(path)
        if path.suffix.lower() == ".mcap":
            with open_log(path) as log:
                content = log.attachment(RESULT_FILE)
            if content is None:
                raise LogError(f"{path} has no {RESULT_FILE} attached: gtsam-rwhec solve or calibrate did not write it")
            result, solved = parse_result(content, f"{path}, attachment {RESULT_FILE}"), path
        else:
            file = result_path(path)
            result, solved = read_result(file), file.with_name(CALIBRATION_LOG)
        rig, cameras = None, {}
        if solved.is_file():
            with open_log(solved) as log:
                rig, cameras = read_embedded_rig(log), read_cameras(log)
        estimated = {} if result.refined is None else result.refined.intrinsics
        return OldCalibration(result, rig, cameras | {name: one.camera for name, one in estimated.items()})


def with_cameras(rig: Rig, cameras: Mapping[str, Camera]) -> Rig:
    """The rig file with the intrinsics of an old calibration as numbers, for the sensors that have images."""
    sensors = {}
    for name, sensor in rig.sensors.items():
        camera = cameras.get(name)
        if camera is not None and sensor.images is not None:
            (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
            numbers = Intrinsics(
                model=camera.model, size=(camera.width, camera.height), K=(fx, fy, cx, cy),
                D=tuple(camera.D.tolist()) or None, stated="calibration",
            )  # fmt: skip
            sensor = sensor.model_copy(update={"intrinsics": numbers})
        sensors[name] = sensor
    return rig.model_copy(update={"sensors": sensors})
