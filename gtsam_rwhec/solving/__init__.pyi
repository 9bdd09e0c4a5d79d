from .certified_solution import solve as solve
from .given_certificate import certify as certify
from .solution import Solution as Solution
from .solution import SolvedPart as SolvedPart
