from .result_file import read_refined as read_refined
from .result_file import read_solution as read_solution
from .result_file import write_refined as write_refined
from .result_file import write_solution as write_solution
from .verdict import Ground as Ground
from .verdict import Judgement as Judgement
from .verdict import Verdict as Verdict
from .verdict import judge as judge
