from . import opencv as opencv
