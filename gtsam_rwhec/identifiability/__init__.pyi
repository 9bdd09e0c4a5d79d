from .free_directions import FreeDirection as FreeDirection
from .free_directions import FreeKind as FreeKind
from .free_directions import FreeReason as FreeReason
from .verdicts import Identifiability as Identifiability
from .verdicts import PairIdentifiability as PairIdentifiability
