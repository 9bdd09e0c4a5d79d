"""What each method answers to a sequence of KinHEC, and how far it is from the truth: its baselines', and ours."""

from __future__ import annotations

import json
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from kinhec_sequences import CAMERA, TARGET, Keyframes, NeutralSequence, of_kinhec, sequences

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecError, RwhecWarning, StampError
from gtsam_rwhec.geometry import estimate_time_offset
from gtsam_rwhec.solver.certificate import Status

Offsets = Literal["true", "estimated"]
#: Of the hand-eye pose: degrees, millimetres.
Error = tuple[float, float]
#: Where a method has no answer.
NO_ANSWER: Error = (float("inf"), float("inf"))
LEVEL, FAR_LEVEL = 0.95, 0.9999


@dataclass(frozen=True)
class OurAnswer:
    """What `rw.calibrate` said of a sequence, and whether it was true."""

    #: "unique", "not unique", "not proven", or "no answer" where the call raised or the protocol has no keyframes
    status: Literal["unique", "not unique", "not proven", "no answer"]
    error: Error  #: Of KinHEC's X, degrees and millimetres
    verdict: str
    reason: str
    #: held, held_far: Whether the 95 and the 99.99 % ellipsoid of KinHEC's X hold the truth; None without an ellipsoid
    held: bool | None = None
    held_far: bool | None = None
    other_held: bool | None = None  #: The 95 % ellipsoid of the other frame
    seconds: float = float("nan")
    offset_error_ms: float = float("nan")


@dataclass(frozen=True)
class Answer:
    """Everybody's answer to one sequence."""

    name: str
    seed: int
    track: str
    stations: bool
    synchronous: bool
    keyframes: int
    baselines: dict[str, Error]
    baseline_offset_error_ms: float
    ours: OurAnswer


@dataclass(frozen=True)
class OfBaselines:
    """The baselines' errors of one sequence by name, and their offset's, ms."""

    errors: dict[str, Error]
    offset_error_ms: float


def baselines_of(root: Path, seed: int, numbers: list[int], offsets: Offsets) -> dict[int, OfBaselines]:
    """The eleven baselines by KinHEC's own protocol. Estimated offsets are for asynchronous sequences."""
    benchmark = of_kinhec("benchmark")
    found = {}
    for sequence in sequences(root, seed, numbers):
        with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
            rows = benchmark.evaluate_sequence(
                sequence.package_object,
                list(benchmark.SOLVERS),
                sync="oracle" if offsets == "true" else "estimated",
                rng=np.random.default_rng(sequence.number),
            )
        errors = {
            row["solver"]: (row["X_rot_err_deg"], row["X_trans_err_mm"]) if row["ok"] else NO_ANSWER for row in rows
        }
        found[sequence.number] = OfBaselines(errors, float(rows[0]["time_offset_err_ms"]))
    return found


def stored_baselines(path: Path) -> dict[int, OfBaselines]:
    """What earlier runs wrote."""
    if not path.is_file():
        return {}
    rows = json.loads(path.read_text(encoding="utf-8"))
    return {
        int(number): OfBaselines({name: (e[0], e[1]) for name, e in errors.items()}, offset)
        for number, (errors, offset) in rows.items()
    }


def store_baselines(path: Path, found: dict[int, OfBaselines]) -> None:
    """Write them for the next run; they depend on nothing of ours."""
    rows = {number: (of.errors, of.offset_error_ms) for number, of in sorted(found.items())}
    path.write_text(json.dumps(rows), encoding="utf-8")


def answers_of(
    root: Path, seed: int, numbers: list[int], offsets: Offsets, baselines: dict[int, OfBaselines]
) -> list[Answer]:
    """Our answers to some sequences, beside the baselines'."""
    found = []
    for sequence in sequences(root, seed, numbers):
        of_baselines = baselines[sequence.number]
        # KinHEC's sign: a camera's stamp is the robot's time + offset.
        offset = sequence.time_offset_s if offsets == "true" else own_offset_s(sequence)
        keyframes = sequence.keyframes(offset)
        found.append(
            Answer(
                name=sequence.name,
                seed=seed,
                track=sequence.track,
                stations=sequence.stations,
                synchronous=sequence.synchronous,
                keyframes=0 if keyframes is None else len(keyframes.B),
                baselines=of_baselines.errors,
                baseline_offset_error_ms=of_baselines.offset_error_ms,
                ours=our_answer(sequence, keyframes, offset),
            )
        )
    return found


def own_offset_s(sequence: NeutralSequence) -> float:
    """The offset by this library's clocks, in KinHEC's sign; 0 where the turning does not determine it."""
    try:
        return -estimate_time_offset(
            sequence.path(), [sequence.detections()], search_s=0.5, where=sequence.name
        ).offset_s
    except StampError:
        return 0.0


def our_answer(sequence: NeutralSequence, keyframes: Keyframes | None, offset_s: float) -> OurAnswer:
    """`rw.calibrate` with no option, judged by the truth."""
    if keyframes is None:
        return OurAnswer("no answer", NO_ANSWER, "none", "fewer than three frames")
    problem = sequence.problem(keyframes)
    begin = time.perf_counter()
    try:
        with warnings.catch_warnings(action="ignore", category=RwhecWarning):
            calibration = rw.calibrate(problem)
    except RwhecError as error:
        return OurAnswer("no answer", NO_ANSWER, "raised", f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - begin
    true = {TARGET: sequence.X, CAMERA: sequence.Y}
    poses = {frame: T.matrix() for frame, T in (calibration.X | calibration.Y).items()}
    if set(poses) != set(true):
        # A refusal, not a failure: without poses nothing is called unique.
        return OurAnswer(
            "not unique", NO_ANSWER, calibration.verdict.value, calibration.verdict_reason, seconds=seconds
        )
    other = TARGET if sequence.frame == CAMERA else CAMERA
    errors = of_kinhec("metrics").calibration_errors(poses[sequence.frame], true[sequence.frame])
    refined = calibration.refined
    return OurAnswer(
        status=status_of(calibration),
        error=(errors["X_rot_err_deg"], errors["X_trans_err_mm"]),
        verdict=calibration.verdict.value,
        reason=calibration.verdict_reason,
        held=None if refined is None else calibration.contains(sequence.frame, true[sequence.frame], LEVEL),
        held_far=None if refined is None else calibration.contains(sequence.frame, true[sequence.frame], FAR_LEVEL),
        other_held=None if refined is None else calibration.contains(other, true[other], LEVEL),
        seconds=seconds,
        offset_error_ms=1e3 * abs(offset_s - sequence.time_offset_s),  # of the streams, as KinHEC's own is
    )


def status_of(calibration: rw.Calibration) -> Literal["unique", "not unique", "not proven"]:
    """Whether the answer is determined and proven, whatever else the verdict says of it."""
    refined = calibration.refined
    if not calibration.solution.identifiability.is_unique or (refined is not None and refined.free_directions):
        return "not unique"
    return "unique" if calibration.solution.certificate.status is Status.CERTIFIED else "not proven"
