"""What a calibration was made of: files with checksums, versions, options, and the rig file's text."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pydantic import Field

from gtsam_rwhec.calibration.options import CalibrateOptions
from gtsam_rwhec.evidence.record import EvidenceRecord
from gtsam_rwhec.files.terminal_text import brief

#: The packages whose versions decide the last digits of an answer.
PACKAGES = ("gtsam-rwhec", "gtsam", "numpy", "scipy", "clarabel", "opencv-python-headless", "mcap")
#: Bytes that are read at once for a checksum.
PIECE = 1 << 20


class InputFile(EvidenceRecord):
    """A file that was read."""

    name: str = Field(description="its name, without its folder")
    bytes: int = Field(description="its size", ge=0)
    sha256: str = Field(description="checksum of its content", pattern="[0-9a-f]{64}")


class Inputs(EvidenceRecord):
    """All that is needed to make a calibration again."""

    files: tuple[InputFile, ...] = Field(description="the files with the measurements")
    command: str = Field(default="", description="the command, or the call, that made it")
    versions: dict[str, str] = Field(description="of the packages that decide the answer, and of Python")
    options: dict[str, str] = Field(default={}, description="options of the calibration that are not the default")
    seeds: dict[str, int] = Field(default={}, description="seeds of random numbers, by what draws them")
    rig_file: str | None = Field(default=None, description="the text of the rig file")
    copies: dict[str, str] = Field(
        default={}, description="the poses as texts of other programs, under the rig file's names, by the file's name"
    )

    def with_options(self, options: CalibrateOptions) -> Inputs:
        """The record with the options of a calibration, and its seeds."""
        update = {"options": chosen_options(options), "seeds": {"random starts of the search": options.solve.seed}}
        return self.model_copy(update=update)


def chosen_options(options: CalibrateOptions) -> dict[str, str]:
    """Options that are not the default, by name, as Python writes them; of a path of poses only its kind."""
    chosen = {}
    for field in fields(options):
        value, default = getattr(options, field.name), getattr(CalibrateOptions(), field.name)
        if field.name == "carrier_path":
            if value is not None:
                chosen[field.name] = f"the poses of the carrier over time ({type(value).__name__})"
        elif value != default:
            chosen[field.name] = brief(value) if isinstance(value, str) else repr(value)
    return chosen


def versions() -> dict[str, str]:
    """Versions of `PACKAGES` that are installed, and of Python."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # other builds of OpenCV have other names
            continue
    return found


def input_files(paths: Iterable[str | Path]) -> tuple[InputFile, ...]:
    """The files, each with its size and checksum, as they are now."""
    return tuple(_input_file(Path(path)) for path in paths)


def _input_file(path: Path) -> InputFile:
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as stream:
        while piece := stream.read(PIECE):
            digest.update(piece)
            size += len(piece)
    return InputFile(name=path.name, bytes=size, sha256=digest.hexdigest())
