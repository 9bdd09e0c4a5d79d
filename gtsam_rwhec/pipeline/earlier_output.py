"""Whether the files that a run would replace are its own earlier output: it refuses to replace any other file."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.errors import LogError, RwhecError
from gtsam_rwhec.export.files import FILES
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.pipeline.log_contract import CLEAN_LOG, DETECTED_LOG, RESULT_FILE
from gtsam_rwhec.pipeline.log_metadata import read_metadata
from gtsam_rwhec.results.result_file import read_result


def check_replaceable(folder: Path, log_name: str) -> None:
    """Refuse to replace files of another log, or of unknown origin.

    Only the names of the files that `calibrate_log` writes count. Other files may be in the folder.

    Parameters
    ----------
    folder : Path
        May be missing, or empty.
    log_name : str
        File name of the log whose earlier output may be replaced.

    Raises
    ------
    LogError
        A file is not an output of this log. Nothing was changed.
    """
    known = [folder / name for name in (RESULT_FILE, CLEAN_LOG, DETECTED_LOG) if (folder / name).exists()]
    others = [folder / name for name in FILES if (folder / name).exists()]
    foreign = [path for path in known if _sources(path) != (log_name,)] or ([] if known else others)
    if foreign:
        names = ", ".join(path.name for path in foreign)
        raise LogError(
            f"{folder} has files that are not from an earlier run on {log_name}: {names}. Give another folder."
        )


def _sources(path: Path) -> tuple[str, ...]:
    """The names of the logs that a result or a stage's log was made from; empty for any other file."""
    try:
        if path.name == RESULT_FILE:
            log = read_result(path).log
            return () if log is None else log.detection.sources
        with open_log(path) as opened:
            return read_metadata(opened).detection.sources
    except RwhecError:
        return ()
