"""AX = XB, hand-eye calibration: the pose between two rigidly joined frames, from the motion of each.

``solve(C, H, method="dqopt")`` gives X = T_c_h of C_i X = X H_i. ``METHODS`` says what each method assumes and which
paper it is from. The DQ paper is Dekel, Harenstam-Nielsen, Caccamo: Optimal least-squares solution to the hand-eye
calibration problem (CVPR 2020).
"""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
