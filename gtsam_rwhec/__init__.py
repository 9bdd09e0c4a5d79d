"""Certifiably optimal robot-world and hand-eye calibration around GTSAM.

State a ``Problem``, ``solve`` it: poses of every sensor and target, with a proof that no better answer exists and
what the motion leaves undetermined.
"""

from gtsam_rwhec.files.optional_packages import lazy_names

__version__ = "0.1.0"

# The public names stand in __init__.pyi, where type checkers and editors read them. Each name is imported when a
# program first uses it. A package with public names has these two lines and an __init__.pyi, whose lines
# are "from .module import Name as Name"; only modules of the package itself may stand there.
__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
