"""From corners in images: poses, intrinsics and their uncertainty, where the camera's K is only roughly known.

A camera on a robot's hand looks at a checkerboard. Corners come as OpenCV's detectors give them: one array an image, of
the corners that it saw. The stated K is off by 12 pixels. Run it: python examples/from_corners.py
"""

import numpy as np
from rwhec_factors import se3

import gtsam_rwhec as rw

rng = np.random.default_rng(3)
board = rw.cameras.Checkerboard("board", 9, 6, 0.025).corners()  # (54, 3), metres
true = rw.Camera.of(1280, 960, "radtan", [[1012, 0, 652], [0, 1012, 473], [0, 0, 1]], [-0.1, 0.05, 0, 0], "true")
stated = rw.Camera.of(1280, 960, "radtan", [[1000, 0, 640], [0, 1000, 480], [0, 0, 1]], [-0.1, 0.05, 0, 0], "stated")
# T_base_board and T_hand_camera
X, Y = se3.expmap(np.array([[0.1, -0.2, 0.3, 0.5, 0.1, 0.0], [0.02, 0.01, 1.6, 0.03, -0.05, 0.08]]))
A, image_points, corner_ids = [], [], []
while len(A) < 40:
    turn = rng.normal([np.pi, 0.0, 0.0], [0.5, 0.5, 1.0])
    B = se3.pose(se3.expmap(np.r_[turn, 0, 0, 0][None])[0, :3, :3], rng.normal([0, 0, 0.5], [0.06, 0.05, 0.08]))
    pixels = true.project(board @ B[:3, :3].T + B[:3, 3]) + rng.normal(scale=0.1, size=(54, 2))
    seen = np.flatnonzero(true.inside(np.nan_to_num(pixels, nan=-99.0)))
    if len(seen) > 30:
        A.append(Y @ B @ se3.inverse(X) @ se3.expmap(rng.normal(scale=[5e-4] * 3 + [2e-4] * 3)[None])[0])  # T_hand_base
        image_points.append(pixels[seen])
        corner_ids.append(seen)

problem = rw.Problem(sensor_carrier="hand", target_carrier="base")
problem.add_corners("board", "camera", A, image_points, board, stated, corner_ids=corner_ids)
calibration = rw.calibrate(problem)

print(calibration.judgement)
for choice in calibration.choices:
    print(" -", choice)
print(calibration.Y["camera"])  # T_hand_camera, gtsam.Pose3, metres
off_mm = 1e3 * np.linalg.norm(calibration.Y["camera"].translation() - Y[:3, 3])
print(f"The camera is {off_mm:.2f} mm from where it is.")
