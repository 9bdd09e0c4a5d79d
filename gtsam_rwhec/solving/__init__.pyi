from .certified_solution import certify as certify
from .certified_solution import solve as solve
from .solution import Solution as Solution
from .solution import SolvedPart as SolvedPart
