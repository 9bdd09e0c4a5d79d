"""AX = XB: two rigidly joined frames, each of which knows its own motion.

``solve(C, H, method="dqopt")`` gives X of C_i X = X H_i, T_c_h; ``METHODS`` has what each method assumes and where it
is from. The DQ paper is Dekel, Harenstam-Nielsen, Caccamo: Optimal least-squares solution to the hand-eye calibration
problem (CVPR 2020).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
