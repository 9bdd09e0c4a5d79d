"""From what a log holds to measurements that agree: synchronised, thinned, without gross outliers."""

from gtsam_rwhec.cleaning.consensus import Consensus, ConsensusOptions, consensus
from gtsam_rwhec.cleaning.odometry import odometry_gates
from gtsam_rwhec.cleaning.removed import Kept, Removed
from gtsam_rwhec.cleaning.synchronisation import synchronise
from gtsam_rwhec.cleaning.thinning import thin, without_fast
from gtsam_rwhec.cleaning.time_offset import TimeOffset, coarse_time_offset
from gtsam_rwhec.trajectories.trajectory import Trajectory

__all__ = [
    "Consensus",
    "ConsensusOptions",
    "Kept",
    "Removed",
    "TimeOffset",
    "Trajectory",
    "coarse_time_offset",
    "consensus",
    "odometry_gates",
    "synchronise",
    "thin",
    "without_fast",
]
