# The methods, and one call for each of them.
from .registry import METHODS as METHODS
from .registry import run as run

# What a method is, and which of them can solve a problem.
from .applicability import refusal as refusal
from .estimate import Estimate as Estimate
from .estimate import Proof as Proof
from .evaluation import cost_of_answer as cost_of_answer
from .method import Method as Method
from .method import MethodOptions as MethodOptions
from .method import Properties as Properties
from .method import Takes as Takes

# All that apply, side by side.
from .chained import Chained as Chained
from .chained import PairSolver as PairSolver
from .comparison import Compared as Compared
from .comparison import Comparison as Comparison
from .comparison import compare as compare
from .comparison_file import write_comparison as write_comparison

# Methods on corners in pixels: `reprojection.run` and `reprojection.compare`.
from . import reprojection as reprojection
