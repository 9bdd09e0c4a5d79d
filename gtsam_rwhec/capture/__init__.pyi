# Which poses to measure next.
from .plan_poses import plan as plan
from .plan_options import PlanOptions as PlanOptions
from .plan_poses import Plan as Plan
from .plan_poses import PlannedPose as PlannedPose
from .plan_poses import Outlook as Outlook
from .plan_poses import Reason as Reason
from .plan_arm import Arm as Arm
from .plan_candidates import stated_pose as stated_pose

# The same in files, and as pictures.
from .plan_files import picture_of as picture_of
from .plan_files import print_plan as print_plan
from .plan_files import write_plan as write_plan

# The answer after each measurement, and when it is good enough.
from .accuracy import Accuracy as Accuracy
from .stopping import StopDecision as StopDecision
from .stopping import StoppingRule as StoppingRule
from .stopping import Why as Why
from .stream import Stream as Stream
from .stream import StreamOptions as StreamOptions
from .stream_update import Outlier as Outlier
from .stream_update import StreamUpdate as StreamUpdate

# A session while the robot stands there, and where its messages come from.
from .live_session import LiveOptions as LiveOptions
from .live_session import Session as Session
from .live_session import source_of as source_of
from .live_streams import StillOptions as StillOptions
from .sources import Source as Source

# What it answers after each take: the calibration so far, the next pose, and whether it is enough.
from .live_answer import Answer as Answer
from .live_answer import Decision as Decision
from .live_answer import Proposal as Proposal

# Who shows it.
from .live_server import PageServer as PageServer
from .live_terminal import show_on_terminal as show_on_terminal
