"""Manifests of fleets (docs/fleets.md), and the rig files that they name, in a form that every worker can read.

Each entry is a URL of fsspec or a path. Relative ones start from the manifest's folder. Names with * ? [ are patterns.
"""

from __future__ import annotations

import hashlib
import posixpath
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from gtsam_rwhec.errors import FileFormatError, ManifestError, RigError, StoreError, UnfinishedRigWarning
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.files.yaml_lines import KeyPath, YamlFile, dotted, parse_yaml, read_text, shown, suggestion
from gtsam_rwhec.fleet.stores import listed, local_path, read_bytes
from gtsam_rwhec.fleet.stores import shown as shown_url
from gtsam_rwhec.rig import Rig, parse_rig
from gtsam_rwhec.rig.sections import ESTIMATE

#: Names of robots and sites become folders of the output; "/" and "@" join names of frames and of units.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*(::|://)")
_PATTERN = re.compile(r"[*?\[]")
#: A manifest has at most this many bytes.
MOST_BYTES = 1_000_000
#: A message names at most this many faults.
MOST_FAULTS = 20


@dataclass(frozen=True)
class LogSource:
    """One entry of a robot's logs."""

    url: str  #: A log, or a pattern of logs
    rig: str  #: URL of its rig file
    place: str  #: Its place in the manifest, for messages

    @property
    def is_pattern(self) -> bool:
        """Whether the URL stands for all logs that match it."""
        return is_pattern(self.url)


@dataclass(frozen=True)
class Robot:
    """One robot: its name, its logs, and its site if other robots see the same targets."""

    name: str
    logs: tuple[LogSource, ...]
    site: str | None = None


@dataclass(frozen=True)
class Manifest:
    """A fleet."""

    where: str  #: The manifest's URL, or the pattern of the command line
    robots: tuple[Robot, ...]  #: In the manifest's order; names are unique
    shared_rig: str | None = None  #: The rig file of all robots, where the manifest has one

    @property
    def sites(self) -> dict[str, tuple[Robot, ...]]:
        """The robots of each site."""
        found: dict[str, tuple[Robot, ...]] = {}
        for robot in self.robots:
            if robot.site is not None:
                found[robot.site] = (*found.get(robot.site, ()), robot)
        return found


def is_pattern(url: str) -> bool:
    """Whether a URL is a pattern for files. In a URL of http, "?" begins the query."""
    place = url.partition("?")[0] if url.lower().startswith(("http://", "https://")) else url
    return _PATTERN.search(place) is not None


def read_manifest(url: str) -> Manifest:
    """Read a manifest.

    Raises
    ------
    ManifestError
        The file cannot be read, is not YAML, or has faults: the message names every fault with its line.
    """
    try:
        path = local_path(url)
        text = _text(url, MOST_BYTES) if path is None else read_text(path)
    except (FileFormatError, StoreError) as error:
        raise ManifestError(str(error)) from error
    return parse_manifest(text, url)


def _text(url: str, most_bytes: int) -> str:
    try:
        return read_bytes(url, most_bytes=most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{shown_url(url)} is not a text file in UTF-8 (byte {error.start}); YAML was expected."
        ) from error


def manifest_of_pattern(pattern: str, rig: str) -> Manifest:
    """The fleet of all logs that match a pattern; a robot has the name of its logs' folder.

    Raises
    ------
    ManifestError
        No log matches, or a folder's name cannot be a robot's name.
    """
    logs: dict[str, list[LogSource]] = {}
    for url in listed(pattern):
        name = url.rpartition("/")[0].rpartition("/")[2]
        if not _NAME.fullmatch(name):
            raise ManifestError(
                f"{shown_url(url)}: its folder's name {name!r} is no name of a robot (letters, digits, _ - and .); "
                "rename the folder, or write a manifest"
            )
        logs.setdefault(name, []).append(LogSource(url, rig, shown_url(pattern)))
    if not logs:
        raise ManifestError(
            f"no log matches {shown_url(pattern)}; put quotes around it, so that the shell leaves it alone"
        )
    return Manifest(pattern, tuple(Robot(name, tuple(found)) for name, found in sorted(logs.items())), rig)


def parse_manifest(text: str, where: str) -> Manifest:
    """Read the text of a manifest that is at a URL; relative paths start from the URL's folder.

    Raises
    ------
    ManifestError
        As `read_manifest`.
    """
    try:
        file = parse_yaml(text, shown_url(where))
    except FileFormatError as error:
        raise ManifestError(str(error)) from error
    return _Checks(file, where).manifest()


def joined(base: str, url: str) -> str:
    """A URL that a file at `base` has: relative ones start from that file's folder."""
    if _SCHEME.match(url) or url.startswith("/"):
        return url
    folder = base.rpartition("/")[0]
    if not folder and not base.startswith("/"):
        return url
    scheme = _SCHEME.match(folder + "/")
    start = scheme.end() if scheme else 0
    return folder[:start] + posixpath.normpath(f"{folder[start:]}/{url}")


class _Checks:
    """Reads a manifest and collects its faults."""

    def __init__(self, file: YamlFile, url: str) -> None:
        self.file, self.url = file, url
        self.faults: list[tuple[int, str]] = []

    def manifest(self) -> Manifest:
        data = self.file.data
        if not isinstance(data, dict):
            raise ManifestError(self.file.fault((), f"{shown(data)} in place of the sections robots and sites"))
        self._known(data, (), ("rig", "robots", "sites"))
        shared = self._url(data["rig"], ("rig",)) if "rig" in data else None
        robots = self._mapping(data, "robots", "of robots by name, each with its logs", is_needed=True)
        sites = self._sites(data, robots)
        found = [self._robot(name, value, shared, sites.get(name)) for name, value in robots.items()]
        if self.faults:
            words = [said for _, said in sorted(self.faults)]
            words[MOST_FAULTS:] = [f"and {len(words) - MOST_FAULTS} more faults"] * (len(words) > MOST_FAULTS)
            raise ManifestError("\n".join(words))
        return Manifest(self.url, tuple(robot for robot in found if robot is not None), shared)

    def _fault(self, path: KeyPath, words: str) -> None:
        self.faults.append((self.file.line(path), self.file.fault(path, words)))

    def _known(self, data: Mapping[str, Any], path: KeyPath, keys: tuple[str, ...]) -> None:
        for key in data:
            if key not in keys:
                self._fault((*path, key), suggestion(key, keys))

    def _mapping(self, data: Mapping[str, Any], key: str, what: str, *, is_needed: bool = False) -> dict[str, Any]:
        value = data.get(key)
        if isinstance(value, dict) and (value or not is_needed):
            for name in value:
                if not _NAME.fullmatch(name):
                    words = "not a name: letters, digits, _ - and . make names, which are those of folders too"
                    self._fault((key, name), words)
            return value
        if key in data or is_needed:
            said = f"{shown(value)}; give" if key in data else "is missing: give"
            self._fault((key,), f"{said} a section {what}")
        return {}

    def _url(self, value: Any, path: KeyPath) -> str | None:
        if isinstance(value, str) and value.strip():
            return joined(self.url, value)
        self._fault(path, f"{shown(value)}; give a path or a URL")
        return None

    def _sites(self, data: Mapping[str, Any], robots: Mapping[str, Any]) -> dict[str, str]:
        """The site of each robot that is at one."""
        found: dict[str, str] = {}
        for site, names in self._mapping(data, "sites", "of lists of robots by site").items():
            if site in robots:
                self._fault(("sites", site), "a robot has this name; give the site another one")
            if not isinstance(names, tuple) or not names:
                self._fault(("sites", site), f"{shown(names)}; give a list of robots")
                continue
            for i, name in enumerate(names):
                path: KeyPath = ("sites", site, i)
                if not isinstance(name, str) or name not in robots:
                    self._fault(path, f"{shown(name)} is no robot of this manifest; state it under robots")
                elif name in found:
                    self._fault(path, f"{name} is at {found[name]} already; a robot is at one site")
                else:
                    found[name] = site
        return found

    def _robot(self, name: str, value: Any, shared: str | None, site: str | None) -> Robot | None:
        path: KeyPath = ("robots", name)
        entries, place, rig = value, path, shared
        if isinstance(value, dict):
            self._known(value, path, ("rig", "logs"))
            if "logs" not in value:
                self._fault(path, "its logs are missing: give logs: with a URL, a pattern or a list of them")
                return None
            entries, place = value["logs"], (*path, "logs")
            rig = self._url(value["rig"], (*path, "rig")) if "rig" in value else shared
        if entries == ():
            self._fault(place, "an empty list; give at least one log")
        each = enumerate(entries) if isinstance(entries, tuple) else [(None, entries)]
        sources = [self._log(entry, place if i is None else (*place, i), rig) for i, entry in each]
        found = tuple(source for source in sources if source is not None)
        if any(source.rig == "" for source in found):
            self._fault(path, "it has no rig file: give rig: here, or at the top for all robots")
        return Robot(name, found, site)

    def _log(self, entry: Any, path: KeyPath, rig: str | None) -> LogSource | None:
        if isinstance(entry, dict):
            self._known(entry, path, ("log", "rig"))
            if "log" not in entry:
                self._fault(path, "its log is missing: give {log: URL, rig: URL}")
                return None
            if "rig" in entry:
                rig = self._url(entry["rig"], (*path, "rig"))
            path, entry = (*path, "log"), entry["log"]
        url = self._url(entry, path)
        place = f"{self.file.where}, line {self.file.line(path)}: {dotted(path)}"
        return None if url is None else LogSource(url, rig or "", place)


#: The most bytes of a rig file, and of a file that it names.
MOST_RIG_BYTES = 4_000_000


@dataclass(frozen=True)
class RigSource:
    """A rig file as bytes."""

    url: str  #: Where it is
    text: str
    #: Files of intrinsics and targets that the rig file names: path as written there, and content. Each worker reads
    #: files of absolute paths itself
    files: tuple[tuple[str, bytes], ...] = ()

    @property
    def sha256(self) -> str:
        """A checksum of the rig file and its files, in hexadecimal digits."""
        digest = hashlib.sha256(self.text.encode())
        for name, content in self.files:
            digest.update(f"\0{name}\0{len(content)}\0".encode() + content)
        return digest.hexdigest()

    def rig(self, folder: Path) -> Rig:
        """The rig. Files that it names are first written into a folder of this process.

        Raises `RigError` as ``read_rig`` does.
        """
        if not self.files:
            return _parsed(self.text, shown_url(self.url))
        up = max(PurePosixPath(name).parts.count("..") for name, _ in self.files)
        base = folder.joinpath(*["rig"] * (up + 1))
        for name, content in self.files:
            if not PurePosixPath(name).is_absolute():
                place = base / name
                place.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(place, content)
        return _parsed(self.text, shown_url(self.url), base)


@lru_cache(maxsize=8)
def _parsed(text: str, where: str, folder: Path = Path()) -> Rig:
    """The rig; a worker parses a file that names no other files only once."""
    with warnings.catch_warnings(action="ignore", category=UnfinishedRigWarning):
        return parse_rig(text, where, folder)


def read_rig_source(url: str) -> RigSource:
    """Read and check a rig file and the files that it names, which start from its folder; errors as ``read_rig``."""
    try:
        text = _text(url, MOST_RIG_BYTES)
        data = parse_yaml(text, shown_url(url)).data
        named = sorted(_named(data)) if isinstance(data, dict) else []
        files = tuple((name, read_bytes(joined(url, name), most_bytes=MOST_RIG_BYTES)) for name in named)
    except (FileFormatError, StoreError) as error:
        raise RigError(str(error)) from error
    source = RigSource(url, text, files)
    with TemporaryDirectory(prefix="gtsam-rwhec-") as folder:
        source.rig(Path(folder))
    return source


def _named(data: dict[str, Any]) -> set[str]:
    """The files that the sections of sensors and targets name."""

    def of(section: Any) -> list[Any]:
        return list(section.values()) if isinstance(section, dict) else []

    intrinsics = [sensor.get("intrinsics") for sensor in of(data.get("sensors")) if isinstance(sensor, dict)]
    found = [stated for stated in intrinsics if stated != ESTIMATE]
    for stated in (*intrinsics, *of(data.get("targets"))):
        if isinstance(stated, dict):
            found += [stated.get("file"), stated.get("kalibr")]
    return {name for name in found if isinstance(name, str)}
