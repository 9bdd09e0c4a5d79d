"""The sequences of KinHEC, a neutral benchmark of hand-eye calibration, as this library's problems.

Its package generates them (`pip install '.[bench]'`), offline and the same for a seed on every machine. In its words
A X = Y B has A = T_base_ee, and X is the pose of what the hand carries, camera or marker: the hand-eye pose. In ours:

    camera on the hand:  A = T_hand_base = T_base_ee^-1,  X = T_base_target,  Y = T_hand_camera: its X
    camera beside it:    A = T_base_hand = T_base_ee,     X = T_hand_marker: its X,  Y = T_base_camera

B = T_camera_target in both, as the camera measured it. A camera's stamp is the robot's time + KinHEC's offset; this
library's offset has the other sign.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rwhec_factors.se3 import inverse

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.trajectory import Trajectory

FloatArray = NDArray[np.float64]
TRACKS = ("noise", "motion", "outliers", "pnp", "mixed", "monocular", "robot_error", "temporal")
#: The seed of the tier as the package has it.
STANDARD_SEED = 20260909
TARGET, CAMERA = "target", "camera"


def of_kinhec(module: str) -> ModuleType:
    """A module of the installed package, which the script of the same name in this folder would hide."""
    here = str(Path(__file__).resolve().parent)
    sys.path[:] = [p for p in sys.path if str(Path(p).resolve()) != here] + [here]
    if not hasattr(sys.modules.get("kinhec"), "__path__"):
        sys.modules.pop("kinhec", None)
    return importlib.import_module(f"kinhec.{module}")


@dataclass(frozen=True)
class Keyframes:
    """What a solver is given: A, B (N, 4, 4), and stamps (N,) on the robot's clock, ns."""

    A: FloatArray
    B: FloatArray
    stamps_ns: NDArray[np.int64]


@dataclass(frozen=True)
class NeutralSequence:
    """One sequence: its truth, what its user would know of it, and the package's own object for its baselines."""

    name: str
    seed: int
    track: str
    number: int  #: Its place in the tier, which seeds its baselines
    hand_eye: Literal["X", "Y"]  #: Which of this library's poses is KinHEC's X
    #: X, Y: (4, 4)
    X: FloatArray
    Y: FloatArray
    scale: float  #: t_B = scale * true length
    #: Shared where the camera is a monocular one that tracks itself: the user of such odometry knows that.
    scale_mode: Literal["known", "shared"]
    stations: bool
    synchronous: bool
    time_offset_s: float
    package_object: Any

    @property
    def frame(self) -> str:
        """The name of the frame whose pose is KinHEC's X."""
        return TARGET if self.hand_eye == "X" else CAMERA

    def keyframes(self, time_offset_s: float | None = None) -> Keyframes | None:
        """What KinHEC's protocol gives a solver (at least 5 degrees or 2 cm apart, at most 200), in this form.

        The offset is the robot's, KinHEC's sign; None: the true one. None is returned where the protocol has no answer.
        """
        benchmark, motions = of_kinhec("benchmark"), of_kinhec("motions")
        offset = self.time_offset_s if time_offset_s is None else time_offset_s
        T_base_hand, B, measured = self.package_object.paired_measurements(None if self.synchronous else offset)
        T_base_hand, B = T_base_hand[measured], B[measured]
        if len(B) < 3:
            return None
        chosen = motions.select_keyframes(
            T_base_hand, benchmark.KEYFRAME_MIN_ROT_DEG, benchmark.KEYFRAME_MIN_TRANS_M, benchmark.MAX_KEYFRAMES
        )
        if len(chosen) < 3:
            chosen = np.arange(len(B))
        A = inverse(T_base_hand) if self.hand_eye == "Y" else T_base_hand
        stamps_s = self.package_object.camera.t[measured] - (0.0 if self.synchronous else offset)
        return Keyframes(A[chosen], B[chosen], np.round(1e9 * stamps_s[chosen]).astype(np.int64))

    def problem(self, keyframes: Keyframes) -> rw.Problem:
        """The problem, without a weight: nobody tells the noise."""
        problem = rw.Problem(scale=self.scale_mode)
        order = np.argsort(keyframes.stamps_ns, kind="stable")  # jitter can exchange neighbours
        A, B, stamps = keyframes.A[order], keyframes.B[order], keyframes.stamps_ns[order]
        problem.add(TARGET, CAMERA, A, B, stamps_ns=stamps, source=self.name)
        return problem

    def path(self) -> Trajectory:
        """The robot's log, T_sensorcarrier_targetcarrier over the robot's time."""
        robot = self.package_object.robot
        A = inverse(robot.T_base_ee_meas) if self.hand_eye == "Y" else robot.T_base_ee_meas
        return Trajectory.of(np.round(1e9 * robot.t).astype(np.int64), A, f"the robot's log of {self.name}")

    def detections(self) -> tuple[NDArray[np.int64], FloatArray]:
        """All of the camera's measurements in the order of its own stamps, ns: jitter can exchange neighbours."""
        camera = self.package_object.camera
        measured = np.flatnonzero(camera.has_measurement)
        measured = measured[np.argsort(camera.t[measured], kind="stable")]
        return np.round(1e9 * camera.t[measured]).astype(np.int64), camera.T_cam_target_meas[measured]


def generated(seed: int, folder: Path | None, tier: str = "small", *, jobs: int = 1) -> Path:
    """The folder of a tier's data; what is not there yet is generated, some minutes for the small one."""
    import yaml

    pipeline, plans, version = of_kinhec("pipeline"), of_kinhec("plans"), of_kinhec("version").__version__
    root = (folder or Path(tempfile.gettempdir()) / f"kinhec-{version}") / f"{tier}_{seed}"
    if not (root / "complete").is_file():
        print(f"generating the {tier} tier of seed {seed} in {root}: some minutes ...", file=sys.stderr, flush=True)
        root.mkdir(parents=True, exist_ok=True)
        plan = {k: v for k, v in plans.load_tier(tier).items() if not k.startswith("_")} | {"global_seed": seed}
        of_seed = root / f"{tier}.yaml"
        of_seed.write_text(yaml.safe_dump(plan, sort_keys=False), encoding="utf-8")
        pipeline.generate_dataset(
            str(of_seed), root, workers=jobs, work_dir=root / "work", write_card=False, progress=False
        )
        (root / "complete").write_text("", encoding="utf-8")
    return root


def numbers_of(root: Path, tracks: tuple[str, ...] = TRACKS, *, synchronous: bool = True) -> list[int]:
    """The places in the tier of some tracks' sequences, with those that have one clock or without."""
    rows = of_kinhec("io").load_manifest(root)
    return [
        number
        for number, (track, sync) in enumerate(zip(rows["track"], rows["sync"], strict=True))
        if track in tracks and (synchronous or sync == "asynchronous")
    ]


def sequences(root: Path, seed: int, numbers: list[int]) -> Iterator[NeutralSequence]:
    """The sequences of these numbers."""
    io = of_kinhec("io")
    manifest = io.load_manifest(root)
    for number in numbers:
        yield of_package(io._load_from_row(root, manifest.iloc[number].to_dict()), seed, number)


def of_package(found: Any, seed: int, number: int) -> NeutralSequence:
    """The package's sequence in this library's convention."""
    on_hand = found.eye_in_hand
    X, Y = (found.Y, found.X) if on_hand else (found.X, found.Y)
    return NeutralSequence(
        name=f"{found.id} of seed {seed}",
        seed=seed,
        track=found.manifest["track"],
        number=number,
        hand_eye="Y" if on_hand else "X",
        X=X,
        Y=Y,
        scale=found.scale,
        scale_mode="shared" if found.config.scale.get("enabled") else "known",
        stations=found.manifest["sampling_mode"] == "stations",
        synchronous=found.synchronous,
        time_offset_s=found.time_offset,
        package_object=found,
    )
