"""Download the RWHEC paper's real dataset. It has no licence, so this package does not ship it.

The files come one by one from the authors' public repository. Each is checked against its size and SHA-256 sum in
``utias_files.txt``, which is shipped. A file gets its name only when it is complete and verified, so another call
resumes an interrupted download. A file with other content is never overwritten.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from gtsam_rwhec.errors import FetchError, FileFormatError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.files.whole_files import write_atomically

if TYPE_CHECKING:
    import requests

#: Folder ``data/real-world/combined`` of utiasSTARS/certifiable-rwhe-calibration on GitHub.
UTIAS_URL = "https://raw.githubusercontent.com/utiasSTARS/certifiable-rwhe-calibration/main/data/real-world/combined/"
#: Connecting, and the time between two packets, may take at most this long, s. The largest file has under 50 kB.
TIMEOUT_S = (10.0, 60.0)
#: A message about a download that stopped ends with these words.
KEPT = "Complete files stay."


@dataclass(frozen=True)
class RemoteFile:
    """One line of a registry: a file's name, size and checksum."""

    name: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class Fetched:
    """The files of one call of `fetch_utias`: downloaded by it, or there before and verified by it."""

    folder: Path
    downloaded: tuple[str, ...]
    already_there: tuple[str, ...]


def utias_files() -> tuple[RemoteFile, ...]:
    """The dataset's files: 16 tags seen by 8 cameras, 73 pairs, two files each."""
    registry = files("gtsam_rwhec").joinpath("utias_files.txt").read_text(encoding="utf-8")
    lines = [line.split() for line in registry.splitlines() if line and not line.startswith("#")]
    return tuple(RemoteFile(name, int(size), sha256) for sha256, size, name in lines)


def fetch_utias(
    destination: str | Path, base_url: str = UTIAS_URL, progress: Callable[[int, int, str], None] | None = None
) -> Fetched:
    """Download the dataset into a folder, or complete an earlier download.

    Parameters
    ----------
    destination : str or Path
        Folder to write to; it is made if needed.
    base_url : str
        Where the files are, for example a mirror inside an institute's network.
    progress : callable, optional
        Called before each file with (files done, files in all, name), and once more at the end.

    Raises
    ------
    FetchError
        For no network, a status other than 200, a wrong checksum, or another file of the same name in the folder. All
        verified files stay, and the next call goes on from there.
    """
    folder = Path(destination)
    remote_files = utias_files()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FetchError(f"{folder} cannot be made a folder: {error.strerror}. Choose another destination.") from error
    there = _verified(folder, remote_files)
    missing = [file for file in remote_files if file.name not in there]
    with _session() as session:
        for number, file in enumerate(missing):
            if progress is not None:
                progress(len(there) + number, len(remote_files), file.name)
            content = _download(session, base_url.rstrip("/") + "/" + file.name, file)
            try:
                write_atomically(folder / file.name, content)
            except FileFormatError as error:
                raise FetchError(f"{error} {KEPT}") from error
    if progress is not None:
        progress(len(remote_files), len(remote_files), "")
    return Fetched(folder, tuple(file.name for file in missing), there)


def _verified(folder: Path, remote_files: tuple[RemoteFile, ...]) -> tuple[str, ...]:
    """Names of the files that are there already. A file with other content raises a FetchError."""
    there = []
    for file in remote_files:
        path = folder / file.name
        if not path.exists():
            continue
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "none: it is not a file"
        if sha256 != file.sha256:
            raise FetchError(
                f"{path} is there but is not the dataset's file (SHA-256 {sha256}, expected {file.sha256}). "
                "Nothing was overwritten: move it away, or choose another destination."
            )
        there.append(file.name)
    return tuple(there)


def _session() -> requests.Session:
    """One connection for all files. Passing faults are tried again twice, after 0.5 s and 1 s."""
    with extra_named():
        import requests
        from requests.adapters import HTTPAdapter
        from urllib3.util.retry import Retry

    session = requests.Session()
    retry = Retry(total=2, backoff_factor=0.5, status_forcelist=(429, 500, 502, 503, 504), raise_on_status=False)
    for scheme in ("https://", "http://"):
        session.mount(scheme, HTTPAdapter(max_retries=retry))
    return session


def _download(session: requests.Session, url: str, file: RemoteFile) -> bytes:
    import requests

    try:
        response = session.get(url, timeout=TIMEOUT_S)
        status, reason, content = response.status_code, response.reason, response.content
    except requests.RequestException as error:
        raise FetchError(
            f"{url} cannot be downloaded: {error}. Is there a network, or a proxy to set (HTTPS_PROXY)? Call again "
            f"later. {KEPT}"
        ) from error
    if status == requests.codes.not_found:
        raise FetchError(
            f"{url}: not found (404). Has the repository moved its files? Give the new folder as base_url."
        )
    if status != requests.codes.ok:
        raise FetchError(f"{url}: the server answered {status} {reason}. Call again later. {KEPT}")
    sha256 = hashlib.sha256(content).hexdigest()
    if (len(content), sha256) != (file.size_bytes, file.sha256):
        raise FetchError(
            f"{url}: {len(content)} bytes with SHA-256 {sha256}, expected {file.size_bytes} bytes with {file.sha256}. "
            "Nothing was written. Did a proxy send a page of its own, or did the authors change the file?"
        )
    return content


#: The demo's folder has these files: the log, its rig file, and the truth.
LOG, RIG, TRUTH = "robot_cell.mcap", "rig.yaml", "truth.json"


def demo_folder() -> Path:
    """The folder of the shipped log: inside the package when installed from a wheel, ``data/cell`` in a checkout.

    Raises `FileFormatError` if neither is there.
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
    """The facts that the log was made with."""

    X: dict[str, gtsam.Pose3]  #: T_base_target by target, metres
    Y: dict[str, gtsam.Pose3]  #: T_hand_camera by camera, metres
    time_offsets_s: dict[str, float]  #: By camera, seconds: the camera's stamp t is the robot's t + offset
    scale: dict[str, float]  #: Stated length over true length, by target
    twice_seen: str  #: The target whose tag a poster shows a second time
    twice_seen_by: str  #: The camera that sees the poster
    twice_seen_in: int  #: Number of that camera's images with the poster


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
