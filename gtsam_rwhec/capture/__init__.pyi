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
