"""The output folder of a calibration: what it may write there, and what an earlier run left.

The folder has a list of the files that were written into it, with a checksum of each. One rule serves ``calibrate``,
``demo`` and Python:

- A file that is not on the list, or was changed since, is never replaced.
- A finished calibration is replaced only on request. An unfinished run is continued. So is a run that ended with an
  error; if its inputs were changed, it begins anew.
- A folder with other files is refused, since it may be meant for something else. If it also has a calibration, and the
  request is to replace it, the other files do not change.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal, TypeAlias

from pydantic import BaseModel, ConfigDict

from gtsam_rwhec.errors import LogError, RwhecError
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.files.whole_files import why_not_writable, write_atomically
from gtsam_rwhec.logs import Log
from gtsam_rwhec.rig.exported_files import FILES, FOLDERS, SUFFIX
from gtsam_rwhec.runs.kept_detections import KeptDetections, differences, kept_inputs
from gtsam_rwhec.runs.run_log import CALIBRATION_LOG, EVIDENCE_FILE, RECORDED_LOG, REPORT_FILE, RESULT_FILE, SEEN_SHEET

#: All files that a calibration leaves in its folder, relative to it. A file that is written there has its name here.
WRITTEN = (CALIBRATION_LOG, REPORT_FILE, RESULT_FILE, EVIDENCE_FILE, *FILES, SEEN_SHEET)


def is_written(name: str) -> bool:
    """Whether a calibration writes a file of this name, relative to its folder."""
    folder, _, file = name.rpartition("/")
    return name in WRITTEN or (folder in FOLDERS and file.endswith(SUFFIX) and not file.startswith("."))


def check_writable(path: str | Path) -> None:
    """Raise `LogError` if a file cannot be written: its folder is missing or not writable, or a folder has its name."""
    why = why_not_writable(path)
    if why:
        raise LogError(f"{path} cannot be written: {why}.")


def check_is_not_read(log: Log, path: str | Path) -> None:
    """Raise `LogError` if a file is one of those from which the log is read."""
    if any(os.path.realpath(path) == os.path.realpath(file.path) for file in log.files):
        raise LogError(f"{path} is the raw log, and a raw log is never changed; give another file or folder.")


def made_folder(path: str | Path) -> Path:
    """Return the folder, made if it does not exist. Raise `LogError` if files cannot be written into it."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"{path} cannot be made a folder: {error.strerror}.") from error
    check_writable(path / CALIBRATION_LOG)
    return path


def made_output_folder(path: str | Path) -> Path:
    """As `made_folder`, for all files of a calibration; it raises now if one could not be replaced at the end."""
    path = made_folder(path)
    for name in WRITTEN:
        if "/" not in name:
            check_writable(path / name)
    for inside in (path / name for name in FOLDERS):
        if inside.is_dir():
            check_writable(inside / CALIBRATION_LOG)
        elif os.path.lexists(inside):
            raise LogError(f"{inside} cannot be made a folder: it is a file.")
    return path


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: The list of the written files, in the output folder.
LIST_FILE = ".written.json"
#: The detections so far, in the output folder. It is removed at the end.
DETECTIONS = "detections.jsonl"
#: The temporary name of a file that was half written when the run was killed; the group is the final name.
_PART = re.compile(r"\.(.+)\.\d+\.(?:part|trial)")
#: Files that desktop programs leave in folders that they show.
_OF_DESKTOPS = (".DS_Store", "Thumbs.db", "desktop.ini")
#: A message names at most this many files.
MOST_NAMED = 5

#: "failed" is a run that ended with an error. After a change of its inputs a new run may start without ``replace``.
State: TypeAlias = Literal["unfinished", "failed", "finished"]


class _Written(BaseModel):
    """The list of the written files."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    log: str
    state: State = "finished"
    sha256: dict[str, str]


class OutputFolder:
    """The output folder of a calibration while it is at work. `output_folder` makes it."""

    def __init__(self, path: Path, log: str, before: _Written | None, *, replace: bool) -> None:
        self.path = path
        #: The name of the log, or of the folder, that is calibrated.
        self.log = log
        #: Whether an unfinished run of other inputs is replaced.
        self.begins_anew = replace or (before is not None and before.state != "unfinished")
        self._before = before
        self._has_begun = False
        self._kept: KeptDetections | None = None

    def begin(self) -> None:
        """Write into the folder's list that a run is at work, before its first file is written."""
        if not self._has_begun:
            earlier = self._before
            if earlier is not None and earlier.state != "finished" and earlier.log.endswith(RECORDED_LOG):
                (self.path / Path(earlier.log).name).unlink(missing_ok=True)
            sums = {} if self._before is None else self._before.sha256
            _write_list(self.path, _Written(log=self.log, state="unfinished", sha256=sums))
            self._has_begun = True

    def kept_detections(self, inputs: dict[str, str], total: int) -> KeptDetections:
        """The detections that an interrupted run kept, if its inputs were the same; else none.

        Raises `LogError` if the folder has an unfinished run of other inputs, and nobody asked to replace it.
        """
        file = self.path / DETECTIONS
        earlier = kept_inputs(file)
        other = "" if earlier is None else differences(earlier, inputs)
        if other and not self.begins_anew:
            self._has_begun = False  # the list stays as it was
            raise LogError(
                f"{self.path} has an unfinished run of other inputs, and nothing was changed: {other}. Put that back, "
                "and the run goes on; or begin anew (--force; in Python replace=True), or give another folder"
            )
        self.begin()
        self._kept = KeptDetections(file, inputs, total)
        if earlier is None or other:
            file.unlink(missing_ok=True)
        else:
            self._kept.go_on()
        return self._kept

    def end(self, error: BaseException | None) -> None:
        """Bring the list up to date, and remove what only an unfinished run needs."""
        if self._kept is not None:
            self._kept.close()
        if isinstance(error, KeyboardInterrupt):
            error.add_note(self._how_to_go_on())
        # An error itself is said, not what follows it.
        with suppress(*(() if error is None else (OSError, RwhecError))):
            self._bring_list_up_to_date(error)
        if error is None:
            (self.path / DETECTIONS).unlink(missing_ok=True)

    def _bring_list_up_to_date(self, error: BaseException | None) -> None:
        if self._has_begun:
            state: State = "finished" if error is None else "failed" if isinstance(error, RwhecError) else "unfinished"
            written = [name for name in _names_in(self.path) if is_written(name) and (self.path / name).is_file()]
            if error is not None and not written and self._before is None and not (self.path / DETECTIONS).exists():
                (self.path / LIST_FILE).unlink(missing_ok=True)
            else:
                sums = {name: _sha256(self.path / name) for name in written}
                _write_list(self.path, _Written(log=self.log, state=state, sha256=sums))

    def _how_to_go_on(self) -> str:
        if self._kept is None or not self._kept.done:
            return f"The same command starts again; {self.path} has no detections yet."
        done = f"{self._kept.done:,} of {self._kept.total:,} images are done"
        return f"The same command goes on from here: {done}, and kept in {self.path}."


@contextmanager
def output_folder(path: str | Path, log: str, *, replace: bool, sources: Sequence[Path] = ()) -> Iterator[OutputFolder]:
    """A context for a calibration into a folder that is free for it; at the end the folder's list is updated.

    The folder is made if it does not exist, and removed if an error ends the block before anything was written. `log`
    is the name of what is calibrated, `sources` are its files: one that is in the folder is not foreign. With `replace`
    a finished calibration, or an unfinished run of other inputs, is replaced.

    Raises `LogError` if the folder is not free, another run is at work in it, or files cannot be written into it;
    nothing was changed.
    """
    path = Path(path)
    before = _check_is_free(path, log, replace=replace, sources=sources)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    made_output_folder(path)
    output = OutputFolder(path, log, before, replace=replace)
    error: BaseException | None = None
    try:
        with _alone_in(path):
            try:
                for name in _names_in(path):
                    if _is_part(name, log):
                        (path / name).unlink(missing_ok=True)
                yield output
            except BaseException as caught:
                error = caught
                raise
            finally:
                output.end(error)
    finally:
        with suppress(OSError):  # what has files in it stays
            for folder in made:
                folder.rmdir()


def earlier_run(path: str | Path) -> tuple[str, State] | None:
    """The log of the run that wrote a folder's files, and how that run ended; None if there was none."""
    written = _read_list(Path(path))
    return None if written is None else (written.log, written.state)


def log_name(sources: Sequence[str]) -> str:
    """The name of a log of several files: those of all, as a list of written files has it."""
    return ", ".join(sources)


def list_written(folder: Path, sources: Sequence[str], files: Iterable[Path]) -> None:
    """Put files that a stage wrote on the folder's list; `sources` are the files of the raw log."""
    before = _read_list(folder) or _Written(log=log_name(sources), sha256={})
    sums = {file.relative_to(folder).as_posix(): _sha256(file) for file in files if file.is_file()}
    if sums:
        _write_list(folder, before.model_copy(update={"sha256": before.sha256 | sums}))


def remove_unchanged(folder: Path, inside: Collection[str], keep: Iterable[Path] = ()) -> None:
    """Remove the unchanged files that a calibration wrote into some subfolders, except `keep`.

    Otherwise files of renamed cameras, and old pictures, would be taken for those of this run. Files that no
    calibration wrote are never removed.
    """
    written = _read_list(folder)
    kept = {file.relative_to(folder).as_posix() for file in keep}
    for name, sha256 in () if written is None else written.sha256.items():
        if name.rpartition("/")[0] in inside and name not in kept and _is_as_written(folder / name, sha256):
            (folder / name).unlink()
    for name in inside:
        with suppress(OSError):  # what has files in it stays
            (folder / name).rmdir()


def _check_is_free(folder: Path, log: str, *, replace: bool, sources: Sequence[Path]) -> _Written | None:
    """Refuse a folder that is not free for a calibration; return the list of what was written into it before."""
    before = _read_list(folder)
    there = _names_in(folder)
    if before is not None and before.state == "finished" and not replace:
        raise LogError(
            f"{folder} has a finished calibration of {_named_log(before.log)}, and nothing was changed. Replace it "
            "(--force; in Python replace=True), or give another folder"
        )
    is_going_on = before is not None and before.state != "finished"
    others_of_ours = {LIST_FILE, DETECTIONS, *FOLDERS}
    if before is not None and is_going_on and before.log.endswith(RECORDED_LOG):
        others_of_ours.add(before.log)
    ours = {name for name in there if is_written(name) or name in others_of_ours}
    own = {name for name in there if name in ours or _is_part(name, log) or _is_one_of(folder / name, sources)}
    others = [name for name in there if name not in own]
    if others and (before is None or not replace):
        raise LogError(
            f"{folder} has files that are not of a calibration, and nothing was changed: "
            f"{some(others, MOST_NAMED)}. Give another folder"
        )
    if before is not None and before.state == "unfinished" and before.log != log and not replace:
        earlier = _named_log(before.log)
        raise LogError(
            f"{folder} has an unfinished run on {earlier}, which is not {_named_log(log)}, and nothing was changed. "
            f"Give {earlier}, and the run goes on; or begin anew (--force; in Python replace=True), or give another "
            "folder"
        )
    if not is_going_on:
        listed = () if before is None else (LIST_FILE, DETECTIONS)
        sums = {} if before is None else before.sha256
        changed = [
            name
            for name in there
            if name in ours and name not in listed and not _is_one_of(folder / name, sources)
            and not _is_as_written(folder / name, sums.get(name))
        ]  # fmt: skip
        if changed:
            raise LogError(
                f"{folder} has files that no earlier calibration wrote there, or that were changed since, and nothing "
                f"was changed: {some(changed, MOST_NAMED)}. Give another folder, or remove them"
            )
    return before


def _names_in(folder: Path) -> list[str]:
    """The names of all files in a folder, and in those of its subfolders that a calibration writes."""
    names = []
    try:
        for entry in sorted(folder.iterdir()) if folder.is_dir() else ():
            if entry.name in FOLDERS and entry.is_dir() and not entry.is_symlink():
                names += [f"{entry.name}/{inside.name}" for inside in sorted(entry.iterdir())]
            elif entry.name not in _OF_DESKTOPS:
                names.append(entry.name)
    except OSError as error:
        raise LogError(f"{folder} cannot be read: {error.strerror}. Give another folder") from error
    return names


def _is_part(name: str, log: str) -> bool:
    """Whether a file is one that a killed run left half written."""
    folder, _, file = name.rpartition("/")
    part = _PART.fullmatch(file)
    whole = "" if part is None else f"{folder}/{part[1]}".lstrip("/")
    return is_written(whole) or whole in (LIST_FILE, DETECTIONS, log)


def _is_one_of(path: Path, sources: Sequence[Path]) -> bool:
    """Whether a file is one of those that the log is read from."""
    return any(os.path.realpath(path) == os.path.realpath(source) for source in sources)


def _is_as_written(path: Path, sha256: str | None) -> bool:
    try:
        return path.is_file() and not path.is_symlink() and sha256 == _sha256(path)
    except OSError:  # what cannot be read cannot be known as ours
        return False


def _named_log(log: str) -> str:
    """A log's name for messages; that of the folder if the log was made of a folder."""
    return log.removesuffix(RECORDED_LOG)


def _read_list(folder: Path) -> _Written | None:
    try:
        return _Written.model_validate_json((folder / LIST_FILE).read_bytes())
    except (OSError, ValueError):
        return None


def _write_list(folder: Path, written: _Written) -> None:
    write_atomically(folder / LIST_FILE, written.model_dump_json(indent=2).encode())


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Lock a folder against other runs; the system releases the lock when the process ends, however it ends."""
    if fcntl is None:
        yield
        return
    held = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise LogError(f"{folder}: another run is at work in this folder. Wait for it, or give another") from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(held)
