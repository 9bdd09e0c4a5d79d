# A X = Y B: the methods, one call for each of them, and all that apply side by side.
from .comparison import Chained as Chained
from .comparison import Compared as Compared
from .comparison import Comparison as Comparison
from .comparison import compare as compare
from .comparison import write_comparison as write_comparison
from .comparison_report import print_comparison as print_comparison
from .registry import METHODS as METHODS
from .registry import cost_of_answer as cost_of_answer
from .registry import run as run

# What a method is, and which of them can solve a problem.
from .method import Estimate as Estimate
from .method import Method as Method
from .method import MethodOptions as MethodOptions
from .method import Proof as Proof
from .method import Properties as Properties
from .method import Takes as Takes
from .method import refusal as refusal

# Methods on corners in pixels: `reprojection.run` and `reprojection.compare`.
from . import reprojection as reprojection

# A X = X B: the methods, and the call for each of them.
from .hand_eye import HAND_EYE_METHODS as HAND_EYE_METHODS
from .hand_eye import solve_hand_eye as solve_hand_eye
from .hand_eye_request import DualQuaternionPrior as DualQuaternionPrior
from .hand_eye_request import Request as Request
from .motions import Motions as Motions
from .motions import motions_of as motions_of
from .dual_quaternion_cost import DualQuaternionCost as DualQuaternionCost
from .motions import cost_of as cost_of

# OpenCV's calls: `from gtsam_rwhec.methods import opencv as cv2`.
from . import opencv as opencv
