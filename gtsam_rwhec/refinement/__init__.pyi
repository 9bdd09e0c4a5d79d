from .options import CarrierNoise as CarrierNoise
from .options import RefineOptions as RefineOptions
from .refined import Movement as Movement
from .refined import PairNoise as PairNoise
from .refined import Refined as Refined
from .refined import RefinedPoses as RefinedPoses
