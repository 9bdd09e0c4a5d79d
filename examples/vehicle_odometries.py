"""A vehicle on a flat floor whose sensors each know only their own motion: where they are, with heights and without.

It writes a simulated drive as TUM files, as odometries do, and calibrates it with examples/vehicle_rig.yaml. On your
own files: gtsam-rwhec calibrate FOLDER --rig examples/vehicle_rig.yaml -o out
Run it: python examples/vehicle_odometries.py [FOLDER for the files]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import SimulatedOdometry, drive

# About x, y, z in degrees, and the place on the vehicle in metres.
MOUNTS = {
    "lidar_front": ([0, 0, 0], [1.8, 0.0, 0.6]),
    "lidar_rear": ([0, 0, 178], [-1.5, 0.1, 0.9]),
    "camera_left": ([-90, 0, -30], [0.9, 0.7, 1.4]),
    "wheels": ([0, 0, 0], [0.0, 0.0, 0.3]),
}
sensors = {}
for name, (turned, place) in MOUNTS.items():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", turned, degrees=True).as_matrix(), place
    scale = 0.4 if name == "camera_left" else 1.0
    sensors[name] = SimulatedOdometry(T, rotation_rad_per_sqrt_s=0.001, translation_m_per_sqrt_s=0.01, scale=scale)
driven = drive(sensors, "planar", seconds=60.0, seed=4)

folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp())
folder.mkdir(parents=True, exist_ok=True)
for name, (stamps_ns, poses) in driven.tracks.items():
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()  # x, y, z, w
    np.savetxt(folder / f"{name}.tum", np.c_[1.7e9 + 1e-9 * stamps_ns, poses[:, :3, 3], quaternions], fmt="%.9f")

rig = rw.rig.read_rig(Path(__file__).with_name("vehicle_rig.yaml"))
without = rig.model_copy(update={"given": rw.rig.GivenSection()})
for words, described in (("Without heights", without), ("With heights", rig)):
    solved = rw.odometry.calibrate_odometry_log(folder, described, folder / words.lower().replace(" ", "_"))
    print(f"\n{words}:")
    rw.odometry.print_odometry(solved.result)
    for name in list(MOUNTS)[1:]:
        off = rw.simulate.frame_distance(solved.result.pose(name), driven.T("lidar_front", name))
        print(f"{name} is {off.translation_mm:.0f} mm and {off.rotation_deg:.2f} degrees from the truth")
