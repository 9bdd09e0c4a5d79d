from .certificate import Certificate as Certificate
from .certificate import Status as Status
from .options import SolveOptions as SolveOptions
