"""What several pages take as given: two cameras that see two tags, as a problem, and its certified solution."""

import numpy as np

import gtsam_rwhec as rw

noise = rw.simulate.Noise(sigma_m=0.003, kappa=0.5 / np.radians(0.3) ** 2)
simulated = rw.simulate.general(2, 2, seed=7, noise=noise, number_of_measurements=25).problem
measurements = {}
for pair in simulated.pairs:
    names = f"tag_{pair.target[-1]}", f"cam_{pair.sensor[-1]}"
    measurements[names] = simulated.measurements(pair.target, pair.sensor).A, simulated.measurements(*pair).B
problem = rw.Problem(sensor_carrier="hand", target_carrier="base")
for (target, sensor), (A, B) in measurements.items():
    problem.add(target, sensor, A, B)
T_hand_base = A[0]
solution = rw.solve(problem)
