"""What the numbers of a result file mean: each file has these sentences under `conventions`."""

from __future__ import annotations

CONVENTIONS = {
    "poses": (
        "sensors and targets at the top are the poses to use: the refined poses if the answer was refined, otherwise "
        "the certified poses; certified has the certified poses in either case"
    ),
    "pose": (
        "T_parent_child is the pose of frame child in frame parent: p_parent = T_parent_child p_child. "
        "quaternion_wxyz is scalar first, of unit norm, and the same rotation as rotation_matrix (rows)."
    ),
    "model": (
        "T_sensorcarrier_targetcarrier T_targetcarrier_target = T_sensorcarrier_sensor T_sensor_target (A X = Y B); "
        "X are the targets' poses and Y the sensors'."
    ),
    "scale": "length of the measured translation of T_sensor_target = scale * true length",
    "units": "m, rad, s; sigma in m, kappa in 1/rad^2 (1/(2 s^2) for a standard deviation of s about each axis)",
    "covariance": (
        "of xi in T_parent_child Expmap(xi), xi = [omega (rad), v (m)], rotation first, in the axes and about the "
        "origin of child (GTSAM's right perturbation)"
    ),
    "intrinsics": (
        "of refined.intrinsics: fx, fy, cx, cy in pixels, with the middle of the upper left pixel at (0, 0), and the "
        "coefficients of the model, as OpenCV has them: radtan k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 (4, 5, 8 "
        "or 12 of them), equidistant k1, k2, k3, k4 of the fisheye model, pinhole none, unified xi, k1, "
        "k2, p1, p2 of the omnidir model, whose fx and fy are divided by 1 + xi here. Their covariance is that of "
        "intrinsics:SENSOR in refined.joint, in the order of names"
    ),
    "shape": (
        "of refined.reprojection.boards: size is the true size less the stated one, a share of 1 (its covariance is "
        "that of the target's scale, 1 / (1 + size)); warp_x and warp_y are heights of its edge over its middle, "
        "metres; corners_off_m is how far each corner is from its place on that board, x, y, z in the target's frame, "
        "where corners were free"
    ),
    "infinity": (
        "null means an infinite number: minus infinity in lower_bound, float_bound and min_eigenvalue (no bound was "
        "found), infinity of either sign in a covariance, and plus infinity elsewhere"
    ),
    "sentence": "the meaning of a record in words; not read back",
}
