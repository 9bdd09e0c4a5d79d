from .components import Component as Component
from .found import Deviation as Deviation
from .found import NoiseInData as NoiseInData
from .options import NoiseOptions as NoiseOptions
from .refining import refine_under_noise as refine_under_noise
from .refining import under_noise as under_noise
from .refining import UnderNoise as UnderNoise
