"""OpenCV 4's hand-eye methods: our calls of the same names, and the certified solution, beside them.

    python benchmarks/opencv_hand_eye.py [--repetitions 3] [--problems 200]

Needs opencv-python-headless of version 4 (5 has dropped the functions). OpenCV gets the lists of arrays that it wants,
made beforehand, and so do ours of the same names. For the robot-world methods arrays (N, 3, 3) and (N, 3), which both
take as well, have rows of their own, and the bar: reading 1,600 small arrays takes longer than all the rest of ours.
Calls take turns; ratios are medians within the repetitions. Eye-in-hand and eye-to-hand are one computation.

Methods of 1,000 poses take OpenCV seconds, so each is timed once there, after one that does not count, and errors to
the truth at N = 1,000 are those of our calls of the same names, whose answers are OpenCV's (first table). At N = 50
they are OpenCV's own.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import cv2
import numpy as np
from bars import Row, Times, in_words, interleaved, run_script
from rich.progress import track

import gtsam_rwhec as rw
from gtsam_rwhec.methods import opencv as ours
from gtsam_rwhec.simulate import Noise, Simulation, frame_distance, general

HAND_EYE = {"Tsai": 0, "Park": 1, "Horaud": 2, "Andreff": 3, "Daniilidis": 4}
ROBOT_WORLD = {"Shah": 0, "Li": 1}
NOISE = Noise(sigma_m=0.01, kappa=2000.0)
#: Calls in a row where one takes less than a millisecond.
BLOCK = 20
SAME, FASTER, CERTIFIED_FASTER = 1e-9, 20.0, 100.0


def hand_eye_poses(simulation: Simulation) -> list[np.ndarray]:
    """R_gripper2base, t_gripper2base, R_target2cam, t_target2cam as arrays."""
    measured = simulation.problem.measurements("target0", "sensor0")
    gripper = np.linalg.inv(measured.A)
    return [np.ascontiguousarray(part) for T in (gripper, measured.B) for part in (T[:, :3, :3], T[:, :3, 3])]


def robot_world_poses(simulation: Simulation) -> list[np.ndarray]:
    """R_world2cam, t_world2cam, R_base2gripper, t_base2gripper as arrays."""
    measured = simulation.problem.measurements("target0", "sensor0")
    return [np.ascontiguousarray(part) for T in (measured.B, measured.A) for part in (T[:, :3, :3], T[:, :3, 3])]


def as_lists(arrays: list[np.ndarray]) -> list[list[np.ndarray]]:
    """Separate arrays of each pose, as programs that call OpenCV have them."""
    return [[entry.copy() for entry in array] for array in arrays]


def difference(first: tuple[np.ndarray, ...], second: tuple[np.ndarray, ...]) -> float:
    """Largest difference of any entry."""
    return float(max(np.abs(a - b).max() for a, b in zip(first, second, strict=True)))


def same_names(repetitions: int, count: int = 400) -> list[Row]:
    """Method by method: the same answer, and how much faster."""
    simulation = general(1, 1, seed=1, number_of_measurements=count, noise=NOISE)
    rows = []
    arrays = hand_eye_poses(simulation)
    poses = as_lists(arrays)
    for name, method in HAND_EYE.items():
        # Arguments are bound now: the calls run within this turn of the loop all the same.
        times = interleaved(
            repetitions,
            {
                "opencv": lambda method=method: cv2.calibrateHandEye(*poses, method=method),
                "ours": lambda method=method: ours.calibrateHandEye(*poses, method=method),
            },
        )
        apart = difference(ours.calibrateHandEye(*poses, method=method), cv2.calibrateHandEye(*poses, method=method))
        rows += verdicts(f"{name}, N = {count}", times.ratio("opencv", "ours"), times, apart)
    for name, method in ROBOT_WORLD.items():
        rows += robot_world_rows(f"{name}, N = {count}", robot_world_poses(simulation), method, repetitions)
    return rows


def robot_world_rows(what: str, arrays: list[np.ndarray], method: int, repetitions: int) -> list[Row]:
    """Calls of a fraction of a millisecond: blocks of twenty in turns, and one at a time with cold caches."""
    rows = []
    for kind, given in (("arrays", arrays), ("lists of arrays", as_lists(arrays))):

        def opencv(given: list = given) -> tuple[np.ndarray, ...]:
            return cv2.calibrateRobotWorldHandEye(*given, method=method)

        def own(given: list = given) -> tuple[np.ndarray, ...]:
            return ours.calibrateRobotWorldHandEye(*given, method=method)

        def opencvs(call: Callable[[], object] = opencv) -> None:
            for _ in range(BLOCK):
                call()

        def owns(call: Callable[[], object] = own) -> None:
            for _ in range(BLOCK):
                call()

        blocks = interleaved(2 * repetitions + 1, {"opencv": opencvs, "ours": owns})
        single = interleaved(20 * repetitions + 1, {"opencv": opencv, "ours": own})
        apart = difference(own(), opencv())
        ratio = blocks.ratio("opencv", "ours")
        rows += verdicts(f"{what}, {kind}, {BLOCK} at a time", ratio, blocks, apart, BLOCK, barred=kind == "arrays")
        rows.append(
            Row(
                "    one at a time in turns",
                f"{single.ratio('opencv', 'ours'):.3g}x ({in_words(single.median('ours'))})",
            )
        )
    return rows


def verdicts(what: str, ratio: float, times: Times, apart: float, calls: int = 1, *, barred: bool = True) -> list[Row]:
    """How much faster, and how far apart."""
    own, peer = times.median("ours") / calls, times.median("opencv") / calls
    return [
        Row(
            f"{what}: OpenCV over ours",
            f"{ratio:.3g}x ({in_words(peer)} over {in_words(own)})",
            f">= {FASTER:g}x" if barred else "",
            ratio >= FASTER if barred else None,
        ),
        Row("    largest difference of the answers", f"{apart:.1e}", f"<= {SAME:g}", apart <= SAME),
    ]


def certified_speed(count: int = 1000) -> list[Row]:
    """All of stating and solving the problem with a certificate, against OpenCV's fastest method."""
    simulation = general(1, 1, seed=2, number_of_measurements=count, noise=NOISE)
    measured = simulation.problem.measurements("target0", "sensor0")
    poses = as_lists(hand_eye_poses(simulation))

    def certified() -> rw.Solution:
        problem = rw.Problem()
        problem.add("target0", "sensor0", measured.A, measured.B, NOISE.sigma_m, NOISE.kappa)
        return rw.solve(problem)

    calls = {
        name: lambda method=method: cv2.calibrateHandEye(*poses, method=method) for name, method in HAND_EYE.items()
    }
    own = interleaved(21, {"ours": certified}).median("ours")
    from_lists = interleaved(
        11, {"ours": lambda: ours.calibrateHandEye(*poses, method=ours.CALIB_HAND_EYE_CERTIFIED)}
    ).median("ours")
    theirs = interleaved(1, calls)
    fastest = min(calls, key=theirs.median)
    ratio = theirs.median(fastest) / own
    status = certified().certificate.status
    return [
        Row(
            f"certified, N = {count}: OpenCV's fastest ({fastest}) over Problem, add and solve ({status})",
            f"{ratio:.3g}x ({in_words(theirs.median(fastest))} over {in_words(own)})",
            f">= {CERTIFIED_FASTER:g}x",
            ratio >= CERTIFIED_FASTER,
        ),
        Row(
            "    the same over calibrateHandEye(..., CALIB_HAND_EYE_CERTIFIED), from lists, noise estimated",
            f"{theirs.median(fastest) / from_lists:.3g}x ({in_words(from_lists)})",
        ),
        Row("    OpenCV's methods", ", ".join(f"{name} {in_words(theirs.median(name))}" for name in calls)),
    ]


def errors(problems: int, count: int, noise: Noise, *, opencv_itself: bool) -> list[Row]:
    """Median errors of the camera's pose over simulated problems."""
    found: dict[str, list[tuple[float, float]]] = {}
    for seed in track(range(problems), f"errors, N = {count}", transient=True):
        simulation = general(1, 1, seed=seed, number_of_measurements=count, noise=noise)
        truth = simulation.Y["sensor0"]
        arrays = hand_eye_poses(simulation)
        with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
            answers = {"solve": rw.solve(simulation.problem).Y["sensor0"].matrix()}
            answers["CERTIFIED"] = transform(ours.calibrateHandEye(*arrays, method=ours.CALIB_HAND_EYE_CERTIFIED))
        for name, method in HAND_EYE.items():
            call = cv2.calibrateHandEye if opencv_itself else ours.calibrateHandEye
            answers[name] = transform(call(*arrays, method=method))
        for name, T in answers.items():
            distance = frame_distance(T, truth)
            found.setdefault(name, []).append((distance.translation_mm, distance.rotation_deg))
    medians = {name: np.median(values, axis=0) for name, values in found.items()}
    whose = "OpenCV itself" if opencv_itself else "our calls of OpenCV's names"
    rows = []
    for index, unit in enumerate(("mm", "deg")):
        best = min(HAND_EYE, key=lambda name: medians[name][index])
        rows += [
            Row(
                f"median error over {problems} problems, N = {count}, "
                f"{noise.sigma_m * 1e3:g} mm, kappa {noise.kappa:g}: {name}; best of {whose} ({best})",
                f"{medians[name][index]:.4f} {unit}; {medians[best][index]:.4f} {unit}",
                "no higher",
                bool(medians[name][index] <= medians[best][index]),
            )
            for name in ("solve", "CERTIFIED")
        ]
    return rows


def transform(answer: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(4, 4) of a rotation and a column."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3:] = answer
    return T


def rows(repetitions: int, problems: int) -> list[Row]:
    """All of it."""
    cv2.setNumThreads(1)
    return [
        *same_names(repetitions),
        *certified_speed(),
        *errors(problems, 50, NOISE, opencv_itself=True),
        *errors(problems, 1000, NOISE, opencv_itself=False),
    ]


if __name__ == "__main__":
    run_script("Hand-eye calls", rows, repetitions=3, problems=200)
