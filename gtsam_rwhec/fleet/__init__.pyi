# Which robots, and what came of each.
from .manifest import LogSource as LogSource
from .manifest import Manifest as Manifest
from .manifest import Robot as Robot
from .manifest import is_pattern as is_pattern
from .manifest import manifest_of_pattern as manifest_of_pattern
from .manifest import parse_manifest as parse_manifest
from .manifest import read_manifest as read_manifest
from .fleet_rows import FailedLog as FailedLog
from .fleet_rows import RobotRow as RobotRow
from .fleet_rows import RowFrame as RowFrame
from .fleet_rows import read_rows as read_rows
from .fleet_rows import rows_json as rows_json
from .fleet_rows import read_history as read_history
from .fleet_rows import read_parquet as read_parquet
from .fleet_rows import rows_parquet as rows_parquet

# A run over all of them.
from .fleet_run import FleetRun as FleetRun
from .fleet_run import read_fleet as read_fleet
from .fleet_run import run as run

# The work of a run, and what carries it out.
from .tasks import Engine as Engine
from .tasks import Failed as Failed
from .tasks import InProcess as InProcess
from .tasks import Receipt as Receipt
from .tasks import Task as Task
from .dask_engine import DaskEngine as DaskEngine
from .dask_engine import bytes_of as bytes_of
from .stores import shown as shown

# Drift of each robot over time.
from .watching import RobotChart as RobotChart
from .watching import Watched as Watched
from .watching import watch as watch
from .drift_events import AlarmEvent as AlarmEvent
from .fleet_report import alarm_lines as alarm_lines
from .fleet_report import day_ns_of as day_ns_of
from .fleet_report import drift_remarks as drift_remarks
from .fleet_report import drift_verdict as drift_verdict
from .watching import stream as stream

# What people read.
from .fleet_report import print_fleet as print_fleet
from .fleet_page import put_page as put_page
from .fleet_page import write_fleet_page as write_fleet_page
