# The methods, and one call for each of them. Records of methods and answers are those of gtsam_rwhec.methods.
from .motions import Motions as Motions
from .motions import motions_of as motions_of
from .on_pairs import PAIR_SOLVERS as PAIR_SOLVERS
from .registry import METHODS as METHODS
from .registry import solve as solve
from .request import Request as Request

# The cost that the dual-quaternion methods minimise.
from .cost import DualQuaternionCost as DualQuaternionCost
from .motion_costs import cost_of as cost_of
from .prior import DualQuaternionPrior as DualQuaternionPrior
