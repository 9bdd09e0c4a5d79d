from .csv_folder import read_csv as read_csv
from .knowledge import Prior as Prior
from .knowledge import ScaleMode as ScaleMode
from .measurements import Measurements as Measurements
from .measurements import Pair as Pair
from .problem import Problem as Problem
