# Which robots, and what came of each.
from .manifest import LogSource as LogSource
from .manifest import Manifest as Manifest
from .manifest import Robot as Robot
from .manifest import is_pattern as is_pattern
from .manifest import manifest_of_pattern as manifest_of_pattern
from .manifest import parse_manifest as parse_manifest
from .manifest import read_manifest as read_manifest
from .rows import FailedLog as FailedLog
from .rows import RobotRow as RobotRow
from .rows import RowFrame as RowFrame
from .rows import read_rows as read_rows
from .rows import rows_json as rows_json
from .parquet import read_parquet as read_parquet
from .parquet import rows_parquet as rows_parquet

# A run over all of them.
from .planning import FleetOptions as FleetOptions
from .running import FleetRun as FleetRun
from .running import read_fleet as read_fleet
from .running import run as run
from .fleet_report import print_fleet as print_fleet

# The work of a run, and what carries it out.
from .engines import StartedLate as StartedLate
from .engines import bytes_of as bytes_of
from .engines import engine_of as engine_of
from .tasks import Engine as Engine
from .tasks import Failed as Failed
from .tasks import Receipt as Receipt
from .tasks import Task as Task
from .dask_engine import DaskEngine as DaskEngine
from .in_process import InProcess as InProcess
from .without_secrets import shown as shown

# Drift of each robot over time.
from .watching import RobotChart as RobotChart
from .watching import Watched as Watched
from .watching import watch as watch
from .watch_events import AlarmEvent as AlarmEvent
from .watch_stream import stream as stream
from .history import read_history as read_history
from .watch_words import alarm_lines as alarm_lines
from .watch_words import day_ns_of as day_ns_of
from .watch_words import remarks as remarks
from .watch_words import verdict as verdict

# What people read.
from .summary_page import put_summary as put_summary
from .summary_page import write_summary as write_summary
from .watch_page import write_watch_page as write_watch_page
