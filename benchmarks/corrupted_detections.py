"""30 % of the shipped log's detections made wrong: how much worse the calibration becomes.

    python benchmarks/corrupted_detections.py [--seeds 10] [--share 0.3]

Wrong detections are those of another tag (swapped ids), mirrored poses (the plane's other one), and anything. Errors
are against the truth: root mean square over all frames, positions and rotations, each over that of the clean log.
"""

from __future__ import annotations

import json
import sys
import tempfile
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
from bars import Row, benchmark_parser, print_rows

from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.rig import read_rig
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.run_log import detections_topic, read_metadata
from gtsam_rwhec.runs.solving_stage import Calibrated, solve_log

CELL = Path(__file__).resolve().parents[1] / "data" / "cell"
BAR = 1.2


@dataclass(frozen=True)
class Errors:
    """Root mean square over the frames."""

    mm: float
    degrees: float


def errors(refined: RefinedPoses) -> Errors:
    """Of the shipped log's frames."""
    truth = json.loads((CELL / "truth.json").read_text(encoding="utf-8"))
    poses = refined.X | refined.Y
    off = [
        gtsam.Pose3(np.array(T)).between(poses[n]) for n, T in (truth["T_hand_camera"] | truth["T_base_target"]).items()
    ]
    metres = [np.linalg.norm(pose.translation()) for pose in off]
    radians = [np.linalg.norm(gtsam.Rot3.Logmap(pose.rotation())) for pose in off]
    return Errors(
        1e3 * float(np.sqrt(np.mean(np.square(metres)))), float(np.degrees(np.sqrt(np.mean(np.square(radians)))))
    )


def predicted(refined: RefinedPoses) -> Errors:
    """What the covariances expect these errors to be: one log's are a draw."""
    covariances = [refined.covariance(name) for name in refined.X | refined.Y]
    radians, metres = (np.sqrt(np.mean([np.trace(C[b, b]) for C in covariances])) for b in (slice(0, 3), slice(3, 6)))
    return Errors(1e3 * float(metres), float(np.degrees(radians)))


def corrupt(detected: Path, path: Path, share: float, seed: int, *, leave_out: bool = False) -> int:
    """Write the detected log with a share of its detections wrong, or left out; how many are."""
    generator = np.random.default_rng(seed)
    wrong = 0
    with open_log(detected) as log, LogWriter(path) as out:
        metadata = read_metadata(log)
        topics = set(map(detections_topic, metadata.rig.sensors))
        out.copy(log, [topic.name for topic in log.topics() if topic.name not in topics])
        for topic in sorted(topics):
            records = [record for record in log.records([topic]) if isinstance(record, DetectionRecord)]
            usable = [i for i, record in enumerate(records) if record.T_camera_tag is not None and not record.reason]
            chosen = set(generator.permutation(usable)[: round(share * len(usable))].tolist())
            wrong += len(chosen)
            made = [
                _wrong(record, records, usable, generator) if i in chosen else record
                for i, record in enumerate(records)
            ]
            for stamp in sorted({record.stamp_ns for record in made}):
                tags = [record for record in made if record.stamp_ns == stamp]
                out.detections(topic, stamp, tags[0].frame, tags)
        metadata.write(out)
    return wrong


def _wrong(
    record: DetectionRecord, records: list[DetectionRecord], usable: list[int], generator: np.random.Generator
) -> DetectionRecord:
    assert record.T_camera_tag is not None
    T = record.T_camera_tag.copy()
    kind = generator.integers(3)
    if kind == 0:  # what was seen is another target, at another time
        other = records[int(generator.choice(usable))].T_camera_tag
        assert other is not None
        T = other
    elif kind == 1:  # the plane's other pose: its normal mirrored about the line of sight
        sight = T[:3, 3] / np.linalg.norm(T[:3, 3])
        turn = gtsam.Rot3.Expmap(np.pi * sight).matrix()
        T[:3, :3] = turn @ T[:3, :3] @ np.diag([-1.0, -1.0, 1.0])
    else:
        T = T @ gtsam.Pose3.Expmap(np.r_[generator.normal(0.0, 0.6, 3), generator.normal(0.0, 0.2, 3)]).matrix()
    return replace(record, T_camera_tag=T, corners_px=None, corner_indices=None)


def rows(seeds: int, share: float = 0.3) -> list[Row]:
    """Detect once; corrupt and calibrate, and leave the same ones out and calibrate, for each seed."""
    wrong: list[Errors] = []
    without: list[Errors] = []
    expected: list[Errors] = []
    certified = 0
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        detected, corrupted, cleaned = (Path(folder) / f"{name}.mcap" for name in ("detected", "corrupted", "cleaned"))
        detect_log(CELL / "robot_cell.mcap", read_rig(CELL / "rig.yaml"), detected)
        best = _calibrated(detected, cleaned).refined
        clean = errors(best)
        for seed in range(seeds):
            count = corrupt(detected, corrupted, share, seed)
            calibrated = _calibrated(corrupted, cleaned)
            wrong.append(errors(calibrated.refined))
            expected.append(predicted(calibrated.refined))
            certified += calibrated.refined.solution.certificate.is_certified
            corrupt(detected, corrupted, share, seed, leave_out=True)
            without.append(errors(_calibrated(corrupted, cleaned).refined))
            print(f"    seed {seed}: {count} wrong, {wrong[-1]}, without them {without[-1]}", file=sys.stderr)
    what = f"{100 * share:.0f} % of detections wrong, {seeds} seeds"
    result = [Row("the clean log's error, root mean square over frames", f"{clean.mm:.3f} mm, {clean.degrees:.4f} deg")]
    for name, unit in (("position", "mm"), ("rotation", "degrees")):
        found, known = (np.array([getattr(e, unit) for e in of_seeds]) for of_seeds in (wrong, without))
        against_clean = _rms(found) / getattr(clean, unit)
        result += [
            Row(
                f"{what}: {name} error over the clean log's",
                f"{against_clean:.3f}x",
                f"<= {BAR}x",
                against_clean <= BAR,
            ),
            Row(
                "    the wrong ones left out by hand: over the clean log's",
                f"{_rms(known) / getattr(clean, unit):.3f}x",
            ),
            Row(
                "    as the covariances expect it, over the same of the clean log",
                f"{_rms(np.array([getattr(e, unit) for e in expected])) / getattr(predicted(best), unit):.3f}x",
            ),
            Row("    wrong ones in over left out by hand", f"{_rms(found) / _rms(known):.3f}x"),
        ]
    result.append(Row(f"{what}: certified", f"{certified} of {seeds}", "all", certified == seeds))
    return result


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _calibrated(detected: Path, cleaned: Path) -> Calibrated:
    clean_log(detected, cleaned)
    return solve_log(cleaned)


if __name__ == "__main__":
    parser = benchmark_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--share", type=float, default=0.3)
    arguments = parser.parse_args()
    sys.exit(print_rows("Corrupted detections", rows(arguments.seeds, arguments.share), store=arguments.store))
