from .identification import Identifiability as Identifiability
from .identification import PairIdentifiability as PairIdentifiability
