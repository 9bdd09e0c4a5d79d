"""One X, one Y: all of ``solve`` against OpenCV 4's closed form ``calibrateRobotWorldHandEye`` (Shah; no certificate).

    python benchmarks/one_pair.py [--repetitions 51]

Needs opencv-python-headless of version 4 (5 has dropped the function). Ours is ``rw.solve(problem)`` with the problem
built; another row has the building too. OpenCV gets the lists of arrays that it wants, made beforehand. Each ratio is
the median of those within the repetitions, which take turns.
"""

from __future__ import annotations

import cv2
import numpy as np
from bars import Row, at_most, in_words, interleaved, run_script
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, frame_distance, general

NOISE = Noise(sigma_m=0.01, kappa=125.0)
BARS = {20: 25.0, 1000: 1.0, 10000: 1.0}


def rows_of(count: int, repetitions: int) -> list[Row]:
    """Both methods on the same measurements."""
    simulation = general(1, 1, seed=1, number_of_measurements=count, noise=NOISE)
    measured = simulation.problem.measurements("target0", "sensor0")
    A, B = measured.A, measured.B
    # In OpenCV's words A = T_cam_world, B = T_gripper_base, X = T_world_base, Y = T_cam_gripper.
    lists = [[np.ascontiguousarray(block) for block in part] for T in (A, B) for part in (T[:, :3, :3], T[:, :3, 3:])]

    def opencv() -> tuple[np.ndarray, ...]:
        return cv2.calibrateRobotWorldHandEye(*lists, method=cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH)

    def solve() -> rw.Solution:
        return rw.solve(simulation.problem)

    def build_and_solve() -> rw.Solution:
        problem = rw.Problem(scale="known")
        problem.add("target0", "sensor0", A, B, NOISE.sigma_m, NOISE.kappa)
        return rw.solve(problem)

    times = interleaved(repetitions, {"opencv": opencv, "solve": solve, "build": build_and_solve})
    solution, (R, t, *_) = solve(), opencv()
    theirs = se3.pose(R, t.ravel())
    errors = [frame_distance(T, simulation.X["target0"]) for T in (solution.X["target0"].matrix(), theirs)]
    ratio, with_build = times.ratio("solve", "opencv"), times.ratio("build", "opencv")
    took = f" ({in_words(times.median('solve'))}; OpenCV {in_words(times.median('opencv'))})"
    return [
        at_most(f"N = {count}: solve over OpenCV", ratio, BARS.get(count), "x", more=took),
        Row("    building the problem and solving it over OpenCV", f"{with_build:.3g}x"),
        Row(
            "    status; error of X, ours and OpenCV's",
            f"{solution.certificate.status}; "
            + ", ".join(f"{e.translation_mm:.2f} mm {e.rotation_deg:.3f} deg" for e in errors),
        ),
    ]


def rows(repetitions: int) -> list[Row]:
    """All sizes; the larger ones less often."""
    return [
        row
        for count in (20, 100, 1000, 10000)
        for row in rows_of(count, repetitions if count < 1000 else max(5, repetitions // 5))
    ]


if __name__ == "__main__":
    run_script(f"One X, one Y, against OpenCV {cv2.__version__}", rows, repetitions=51)
