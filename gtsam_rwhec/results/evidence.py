"""The evidence of a calibration: the record, and its file beside the result."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final, Literal

from pydantic import Field, ValidationError

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions
from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.files.whole_files import read_whole, write_atomically
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.results.cloud_evidence import CloudsEvidence
from gtsam_rwhec.results.contribution import ContributionEvidence, contribution_of
from gtsam_rwhec.results.derived import Derived, derived_of
from gtsam_rwhec.results.detection_evidence import SeenEvidence, seen_in_problem
from gtsam_rwhec.results.file_record import Count, FileRecord
from gtsam_rwhec.results.json_tree import MOST_BYTES as MOST_BYTES_OF_RESULT
from gtsam_rwhec.results.json_tree import in_words
from gtsam_rwhec.results.linear_model import LinearModel, measured_rows
from gtsam_rwhec.results.proof_spectrum import Proof, proof_of
from gtsam_rwhec.results.residual_evidence import ResidualsEvidence, residuals_of
from gtsam_rwhec.results.scene_evidence import SceneEvidence, scene_of
from gtsam_rwhec.results.weak_poses import WeakDirection, weak_directions

FORMAT: Final = "gtsam-rwhec evidence"
#: It grows whenever a reader of the version before would misread or refuse the file.
FORMAT_VERSION: Final = 1
#: Bytes of the largest file that is read.
MOST_BYTES = 100_000_000


class Evidence(FileRecord):
    """What a report shows beside the result. A part is None where its data are missing."""

    format: Literal["gtsam-rwhec evidence"] = FORMAT
    format_version: Literal[1] = FORMAT_VERSION
    result_sha256: str = ""  #: Checksum of the result's file; empty where it was not known
    derived: Derived | None = None  #: What follows from poses and covariances
    proof: Proof | None = None  #: Gap and spectrum of the certificate
    weak: tuple[WeakDirection, ...] = ()  #: Least known directions, the worst first
    scene: SceneEvidence | None = None  #: What is needed to draw the rig in space
    clouds: CloudsEvidence | None = None  #: Clouds of some views in one frame
    seen: SeenEvidence | None = None  #: Detections, removed measurements, corners, images
    residuals: ResidualsEvidence | None = None  #: What is left, and what it says of the noise
    contribution: ContributionEvidence | None = None  #: How much each image told
    inputs: Inputs | None = None  #: Files, versions, options, rig file


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
    """The bytes that `write_evidence` writes."""
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


#: The packages whose versions decide the last digits of an answer.
PACKAGES = ("gtsam-rwhec", "gtsam", "numpy", "scipy", "clarabel", "opencv-python-headless", "mcap")
#: Bytes that are read at once for a checksum.
PIECE = 1 << 20


class InputFile(FileRecord):
    """A file that was read."""

    name: str  #: Its name, without its folder
    bytes: Count  #: Its size
    sha256: str = Field(description="checksum of its content", pattern="[0-9a-f]{64}")


class Inputs(FileRecord):
    """All that is needed to make a calibration again."""

    files: tuple[InputFile, ...]  #: The files with the measurements
    command: str = ""  #: The command, or the call, that made it
    versions: dict[str, str]  #: Of the packages that decide the answer, and of Python
    options: dict[str, str] = Field(default_factory=dict)  #: Options of the calibration that are not the default
    seeds: dict[str, int] = Field(default_factory=dict)  #: Seeds of random numbers, by what draws them
    rig_file: str | None = None  #: The text of the rig file
    #: The poses as texts of other programs, under the rig file's names, by the name of the file
    copies: dict[str, str] = Field(default_factory=dict)

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


@one_blas_thread()
def evidence_of(problem: Problem, calibration: Calibration, inputs: Inputs | None = None) -> Evidence:
    """What a report shows beside a calibration.

    Parameters
    ----------
    problem : Problem
        What was calibrated, with its measurements.
    calibration : Calibration
        What ``calibrate`` returned for it.
    inputs : Inputs, optional
        The files that the problem was read from; without them only versions are known.

    Raises
    ------
    MeasurementsNotKeptError
        The problem was made with ``keep_measurements=False``.
    """
    inputs = Inputs(files=(), versions=versions()) if inputs is None else inputs
    of_rows = calibration.problem
    if any(finding.ground is Ground.ROWS_REPAIRED for finding in calibration.findings) or (
        of_rows.number_of_measurements < problem.number_of_measurements
    ):
        problem = of_rows  # whose rows are where they belong, and there once
    rows = measured_rows(problem, calibration)
    model = LinearModel.of(rows, calibration)
    carriers = problem.sensor_carrier, problem.target_carrier
    inliers = calibration.outliers.inliers
    proven = selected(problem, inliers) if inliers else problem
    return Evidence(
        derived=derived_of(calibration),
        proof=None if calibration.solution is None else proof_of(calibration.solution, proven),
        weak=weak_directions(calibration, rows),
        scene=scene_of(calibration, rows, carriers, problem.cameras, problem.boards),
        seen=seen_in_problem(problem, calibration.refined, rows, calibration.options.carrier_path),
        residuals=None if model is None else residuals_of(model, calibration),
        contribution=None if model is None else contribution_of(model),
        inputs=inputs.with_options(calibration.options),
    )
