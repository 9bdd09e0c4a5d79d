"""One call: from measurements to poses, a verdict, and how far off a point is, with outliers and without settings.

A camera on a robot's hand looks at a board. One measurement in ten is wrong. Run it: python examples/one_call.py
"""

import numpy as np

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general

noise = Noise(sigma_m=0.003, kappa=0.5 / np.radians(0.3) ** 2)
measured = general(1, 1, seed=7, noise=noise, number_of_measurements=60).problem.measurements("target0", "sensor0")
B = measured.B.copy()
B[::10, :3, 3] += 0.3  # metres: another board was taken for this one

problem = rw.Problem(sensor_carrier="hand", target_carrier="base")
problem.add("board", "camera", measured.A, B)  # A = T_hand_base, B = T_camera_board
calibration = rw.calibrate(problem)

print(calibration.judgement)
for choice in calibration.choices:
    print(" -", choice)
print(calibration.uncertainty_at([0.0, 0.0, 0.8], frame="camera", seen_from="hand", level=0.95))
print(calibration.Y["camera"])  # T_hand_camera, gtsam.Pose3, metres
