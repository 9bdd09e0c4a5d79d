# What a sensor says of its own motion.
from .tracks import OdometryNoise as OdometryNoise
from .tracks import OdometryTrack as OdometryTrack
