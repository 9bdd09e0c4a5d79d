"""AX = XB: two rigidly joined frames, each of which knows its own motion.

``solve(C, H, method="dqopt")`` gives X of C_i X = X H_i, T_c_h; ``METHODS`` has what each method assumes and where it
is from. The DQ paper is Dekel, Harenstam-Nielsen, Caccamo: Optimal least-squares solution to the hand-eye calibration
problem (CVPR 2020).
"""

from gtsam_rwhec.handeye.cost import DualQuaternionCost
from gtsam_rwhec.handeye.method import HandEye, Method
from gtsam_rwhec.handeye.motion_costs import cost_of
from gtsam_rwhec.handeye.motions import Motions, motions_of
from gtsam_rwhec.handeye.prior import DualQuaternionPrior
from gtsam_rwhec.handeye.registry import METHODS, solve

__all__ = [
    "METHODS",
    "DualQuaternionCost",
    "DualQuaternionPrior",
    "HandEye",
    "Method",
    "Motions",
    "cost_of",
    "motions_of",
    "solve",
]
