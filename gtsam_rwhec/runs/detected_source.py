"""Detection in whatever a rig file describes: a log, or folders of images with poses beside them."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.results.log_history import DetectionReport
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.folder_log import check_is_no_other_folder, is_folder_of_images, write_folder_log
from gtsam_rwhec.runs.log_contract import RECORDED_LOG
from gtsam_rwhec.runs.output_paths import check_writable


def sheet_beside(out_path: str | Path) -> Path:
    """The contact sheet beside a log of detections: ``detected.seen.png`` for ``detected.mcap``."""
    return Path(out_path).with_suffix(".seen.png")


def detect_source(
    source: str | Path,
    rig: Rig,
    out_path: str | Path,
    *,
    images: Images = "leave_out",
    workers: int | None = None,
    draw: str | Path | None = None,
    progress: Progress | None = None,
) -> DetectionReport:
    """As `detect_log`, for a log or for a folder of images, with a contact sheet beside the written log.

    Parameters
    ----------
    source
        As for ``open_log``; or a folder of images, for a rig file with poses in files (``frames``), whose paths then
        start from this folder.
    rig : Rig
    out_path
        The MCAP file to write. The sheet (`sheet_beside`) is written where images are, also if no target was detected.
    images, workers, draw, progress
        As for `detect_log`.

    Raises
    ------
    RwhecError
        As `detect_log` and `write_folder_log` do.
    """
    sheet = sheet_beside(out_path)
    check_writable(out_path)
    check_writable(sheet)
    sheet.unlink(missing_ok=True)  # one of an earlier run would be taken for this run's
    check_is_no_other_folder(source, rig)
    if not is_folder_of_images(source, rig):
        return detect_log(
            source, rig, out_path, images=images, workers=workers, sheet=sheet, draw=draw, progress=progress
        )
    folder = Path(source)
    rig = rig.model_copy(update={"folder": folder})
    with TemporaryDirectory(prefix=".images-", dir=Path(out_path).resolve().parent) as temporary:
        recorded = Path(temporary) / f"{folder.resolve().name}{RECORDED_LOG}"
        write_folder_log(folder, rig, recorded, progress=progress)
        return detect_log(
            recorded, rig, out_path, images=images, workers=workers, sheet=sheet, draw=draw, progress=progress
        )
