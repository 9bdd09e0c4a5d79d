# Which poses to measure next.
from .plan_poses import plan as plan
from .plan_options import PlanOptions as PlanOptions
from .plan_poses import Plan as Plan
from .plan_poses import PlannedPose as PlannedPose
from .plan_poses import Outlook as Outlook
from .plan_poses import Reason as Reason
from .plan_arm import Arm as Arm

# The same in files, and as pictures.
from .plan_files import picture_of as picture_of
from .plan_files import print_plan as print_plan
from .plan_files import write_plan as write_plan

# The answer after each measurement, and when it is good enough.
from .stopping import Accuracy as Accuracy
from .stopping import StopDecision as StopDecision
from .stopping import StoppingRule as StoppingRule
from .stopping import Why as Why
from .stream import Stream as Stream
from .stream import StreamOptions as StreamOptions
from .stream_update import Outlier as Outlier
from .stream_update import StreamUpdate as StreamUpdate
