from .csv_folder import read_csv as read_csv
from .measurements import Measurements as Measurements
from .priors import Prior as Prior
from .problem import Problem as Problem
from .problem import ScaleMode as ScaleMode
