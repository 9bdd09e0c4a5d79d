"""A certified start, refined under the noise that there is, without the outliers; then on in the user's own graph."""

from pathlib import Path

import gtsam
import numpy as np

import gtsam_rwhec as rw

folder = Path(__file__).parents[1] / "data" / "demo"
problem = rw.read_csv(folder, sigma=0.005, kappa=0.5 / np.radians(0.5) ** 2)
solution = rw.solve(problem)
print(solution.certificate)
refined = rw.refine(problem, solution, rw.RefineOptions(noise="estimate", residual="geodesic", robust="gnc"))
for name, T_rig_cam in refined.Y.items():
    degrees, millimetres = refined.standard_deviations(name)  # about and along the camera's own x, y, z
    print(f"{name} at {T_rig_cam.translation().round(4)} m, +- {millimetres.round(2)} mm, {degrees.round(3)} degrees")
T_cam0_cam1, covariance = refined.relative("cam_0", "cam_1")
print(f"cam_1 in cam_0 at {T_cam0_cam1.translation().round(4)} m, 6 x 6 covariance of [omega, v] in cam_1's frame:")
print(covariance.round(9))

# A ruler says 126.5 +- 0.2 mm from camera to camera: one more factor, in the same graph.
graph, cam = refined.graph, refined.keys
graph.add(gtsam.RangeFactorPose3(cam["cam_0"], cam["cam_1"], 0.1265, gtsam.noiseModel.Isotropic.Sigma(1, 0.0002)))
values = gtsam.LevenbergMarquardtOptimizer(graph, refined.values).optimize()
between = values.atPose3(cam["cam_0"]).between(values.atPose3(cam["cam_1"]))
apart_mm = [1e3 * np.linalg.norm(pose.translation()) for pose in (T_cam0_cam1, between)]
print(f"They are {apart_mm[0]:.1f} mm apart; {apart_mm[1]:.1f} mm with the ruler.")
