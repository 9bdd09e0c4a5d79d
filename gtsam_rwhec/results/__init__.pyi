from .refined_file import read_refined as read_refined
from .refined_file import write_refined as write_refined
from .solution_file import read_solution as read_solution
from .solution_file import write_solution as write_solution
