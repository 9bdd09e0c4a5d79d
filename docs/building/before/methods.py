"""A problem of one pair, which every method takes, and motions C, H of two odometries (C X = X H); after rig.py."""

moved = rw.simulate.general(0, 1, seed=7, odometry=40, odometry_noise=noise).problem.measurements("sensor0", "sensor0")  # noqa: F821
C, H = moved.A, moved.B
problem = rw.simulate.general(1, 1, seed=7, noise=noise, number_of_measurements=25).problem  # noqa: F821
