# Bring sensor and carriers together in time.
# Remove what should not be used.
from .odometry import odometry_gates as odometry_gates
from .pair_consensus import Consensus as Consensus
from .pair_consensus import ConsensusOptions as ConsensusOptions
from .pair_consensus import find_consensus as find_consensus

# What is kept, and why the rest is removed.
from .removed import Kept as Kept
from .removed import RemovalReason as RemovalReason
from .removed import Removed as Removed
from .synchronisation import synchronise as synchronise
from .thinning import thin as thin
from .thinning import without_fast as without_fast
from .time_offset import TimeOffset as TimeOffset
from .time_offset import estimate_time_offset as estimate_time_offset
