from .judging import judge as judge
from .result_file import read_refined as read_refined
from .result_file import Result as Result
from .result_file import read_result as read_result
from .result_file import read_solution as read_solution
from .written_result import write_calibration as write_calibration
from .written_result import write_refined as write_refined
from .written_result import write_solution as write_solution
