"""The evidence of a calibration: the record, and its file beside the result."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final, Literal

from pydantic import Field, ValidationError

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.evidence.contribution import ContributionEvidence
from gtsam_rwhec.evidence.derived import Derived
from gtsam_rwhec.evidence.inputs import Inputs
from gtsam_rwhec.evidence.proof import Proof
from gtsam_rwhec.evidence.record import EvidenceRecord
from gtsam_rwhec.evidence.residuals import ResidualsEvidence
from gtsam_rwhec.evidence.scene import SceneEvidence
from gtsam_rwhec.evidence.seen import SeenEvidence
from gtsam_rwhec.evidence.weak import WeakDirection
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.files.whole_files import read_whole
from gtsam_rwhec.results.json_text import MOST_BYTES as MOST_BYTES_OF_RESULT
from gtsam_rwhec.results.json_tree import in_words

FORMAT: Final = "gtsam-rwhec evidence"
#: It grows whenever a reader of the version before would misread or refuse the file.
FORMAT_VERSION: Final = 1
#: Bytes of the largest file that is read.
MOST_BYTES = 100_000_000


class Evidence(EvidenceRecord):
    """What a report shows beside the result. A part is None where its data are missing."""

    format: Literal["gtsam-rwhec evidence"] = FORMAT
    format_version: Literal[1] = FORMAT_VERSION
    result_sha256: str = Field(default="", description="checksum of the result's file; empty where it was not known")
    derived: Derived | None = Field(default=None, description="what follows from poses and covariances")
    proof: Proof | None = Field(default=None, description="gap and spectrum of the certificate")
    weak: tuple[WeakDirection, ...] = Field(default=(), description="least known directions, the worst first")
    scene: SceneEvidence | None = Field(default=None, description="what is needed to draw the rig in space")
    seen: SeenEvidence | None = Field(default=None, description="detections, removed measurements, corners, images")
    residuals: ResidualsEvidence | None = Field(default=None, description="what is left, and what it says of the noise")
    contribution: ContributionEvidence | None = Field(default=None, description="how much each image told")
    inputs: Inputs | None = Field(default=None, description="files, versions, options, rig file")


def evidence_path(result_path: str | Path) -> Path:
    """Where the evidence of a result file is: evidence.json beside result.json, NAME.evidence.json beside NAME.json."""
    path = Path(result_path)
    return path.with_name("evidence.json" if path.name == "result.json" else f"{path.stem}.evidence.json")


def write_evidence(evidence: Evidence, path: str | Path, result_path: str | Path | None = None) -> None:
    """Write the evidence as JSON.

    Parameters
    ----------
    evidence : Evidence
    path
        Its file.
    result_path : optional
        The result's file. Its checksum is kept, so that the evidence is never shown beside another result.

    Raises
    ------
    FileFormatError
        The file cannot be written, or that of the result cannot be read.
    """
    if result_path is not None:
        content = read_whole(Path(result_path), MOST_BYTES_OF_RESULT, "A result was")
        evidence = evidence.model_copy(update={"result_sha256": checksum(content)})
    write_atomically(path, evidence_json(evidence))


def checksum(content: bytes) -> str:
    """SHA-256 of a result's content, as the evidence keeps it."""
    return hashlib.sha256(content).hexdigest()


def evidence_json(evidence: Evidence) -> bytes:
    """What `write_evidence` writes."""
    return evidence.model_dump_json(indent=1).encode("utf-8") + b"\n"


def read_evidence(path: str | Path) -> Evidence:
    """Read a file that `write_evidence` wrote.

    Raises
    ------
    FileFormatError
        The file cannot be read, or is not the evidence of this version; the message has the field.
    """
    content = read_whole(path, MOST_BYTES, "The evidence was")
    try:
        return Evidence.model_validate_json(content)
    except ValidationError as error:
        raise FileFormatError(f"{path} is not the evidence of a calibration: {in_words(error)}") from error
