from .calibration_files import read_calibration as read_calibration
from .change_test import LEVEL as LEVEL
from .change_test import ChangeTest as ChangeTest
from .change_test import GroupChange as GroupChange
from .comparing import Difference as Difference
from .comparing import NumberChange as NumberChange
from .comparing import difference as difference
from .quantities import Movement as Movement
