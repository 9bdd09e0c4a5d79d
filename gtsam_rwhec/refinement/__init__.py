"""GTSAM after the certified solution: richer noise, priors, robust losses, time offsets, and honest covariances."""
