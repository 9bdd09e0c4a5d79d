# The result file.
from .result_file import Result as Result
from .result_file import read_calibration as read_calibration
from .result_file import read_refined as read_refined
from .result_file import read_result as read_result
from .result_file import read_solution as read_solution
from .result_file import result_path as result_path
from .result_file import write_calibration as write_calibration
from .result_file import write_refined as write_refined
from .result_file import write_solution as write_solution
from .result_judgement import judge as judge

# The evidence beside it.
from .evidence import Evidence as Evidence
from .evidence import InputFile as InputFile
from .evidence import Inputs as Inputs
from .evidence import evidence_of as evidence_of
from .evidence import evidence_path as evidence_path
from .evidence import input_files as input_files
from .evidence import read_evidence as read_evidence
from .evidence import versions as versions
from .evidence import write_evidence as write_evidence
from .linear_model import MeasuredRows as MeasuredRows
from .linear_model import measured_rows as measured_rows

# What changed, and whether it still holds.
from .change_test import LEVEL as LEVEL
from .change_test import ChangeTest as ChangeTest
from .change_test import GroupChange as GroupChange
from .common_quantities import Movement as Movement
from .control_chart import RATE as RATE
from .control_chart import checked_rate as checked_rate
from .changed_frames import Difference as Difference
from .changed_frames import NumberChange as NumberChange
from .changed_frames import difference as difference
from .verification import SensorCheck as SensorCheck
from .verification import Verification as Verification
from .verification import verify as verify

# That it is off by less than a limit: known points, or a board that is new to it.
from .acceptance import accept as accept
from .acceptance import write_acceptance as write_acceptance
from .acceptance_record import Acceptance as Acceptance
from .acceptance_record import Answer as Answer
from .acceptance_record import Volume as Volume
from .acceptance import Touches as Touches
from .acceptance import is_touches_file as is_touches_file
from .acceptance import read_touches as read_touches
