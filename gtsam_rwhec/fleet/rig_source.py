"""A rig file with the files that it names, so that any worker can read it: from a URL, as bytes, into a folder."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from gtsam_rwhec.errors import FileFormatError, RigError, StoreError, UnfinishedRigWarning
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.files.yaml_lines import parse_yaml
from gtsam_rwhec.fleet.manifest import joined
from gtsam_rwhec.fleet.stores import read_bytes
from gtsam_rwhec.fleet.without_secrets import shown
from gtsam_rwhec.rig import Rig, parse_rig
from gtsam_rwhec.rig.sections import ESTIMATE

#: A rig file, or a file that it names, has at most this many bytes.
MOST_BYTES = 4_000_000


@dataclass(frozen=True)
class RigSource:
    """A rig file as bytes."""

    url: str  #: Where it is
    text: str
    #: The files with intrinsics and targets that it names: the path as it has it, and the content. Those of absolute
    #: paths are read where they are, by every worker
    files: tuple[tuple[str, bytes], ...] = ()

    @property
    def sha256(self) -> str:
        """A checksum of all of it, in hexadecimal digits."""
        digest = hashlib.sha256(self.text.encode())
        for name, content in self.files:
            digest.update(f"\0{name}\0{len(content)}\0".encode() + content)
        return digest.hexdigest()

    def rig(self, folder: Path) -> Rig:
        """The rig; the files that it names are written below a folder of this process, if it names any.

        Raises `RigError` as ``read_rig`` does.
        """
        if not self.files:
            return _parsed(self.text, shown(self.url))
        up = max(PurePosixPath(name).parts.count("..") for name, _ in self.files)
        base = folder.joinpath(*["rig"] * (up + 1))
        for name, content in self.files:
            if not PurePosixPath(name).is_absolute():
                place = base / name
                place.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(place, content)
        return _in_words(self.text, shown(self.url), base)


@lru_cache(maxsize=8)
def _parsed(text: str, where: str) -> Rig:
    """A rig file that names no others: a worker parses it once."""
    return _in_words(text, where, Path())


def _in_words(text: str, where: str, folder: Path) -> Rig:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnfinishedRigWarning)
        return parse_rig(text, where, folder)


def read_rig_source(url: str) -> RigSource:
    """Read and check a rig file and the files that it names, which start from its folder; errors as ``read_rig``."""
    try:
        text = read_bytes(url, most_bytes=MOST_BYTES).decode("utf-8-sig")
        data = parse_yaml(text, shown(url)).data
        named = sorted(_named(data)) if isinstance(data, dict) else []
        files = tuple((name, read_bytes(joined(url, name), most_bytes=MOST_BYTES)) for name in named)
    except UnicodeDecodeError as error:
        raise RigError(f"{shown(url)} is not a text file in UTF-8 (byte {error.start}); YAML was expected.") from error
    except (FileFormatError, StoreError) as error:
        raise RigError(str(error)) from error
    source = RigSource(url, text, files)
    with TemporaryDirectory(prefix="gtsam-rwhec-") as folder:
        source.rig(Path(folder))
    return source


def _named(data: dict[str, Any]) -> set[str]:
    """The files that the sections of sensors and targets name."""
    found = set()
    sensors, targets = data.get("sensors"), data.get("targets")
    for sensor in sensors.values() if isinstance(sensors, dict) else ():
        stated = sensor.get("intrinsics") if isinstance(sensor, dict) else None
        if isinstance(stated, dict):
            found |= {stated[key] for key in ("file", "kalibr") if isinstance(stated.get(key), str)}
        elif isinstance(stated, str) and stated != ESTIMATE:
            found.add(stated)
    for target in targets.values() if isinstance(targets, dict) else ():
        if isinstance(target, dict) and isinstance(target.get("kalibr"), str):
            found.add(target["kalibr"])
    return found
