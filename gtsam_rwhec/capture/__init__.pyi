# The answer after each measurement, and when it is good enough.
from .stopping import Accuracy as Accuracy
from .stopping import StopDecision as StopDecision
from .stopping import StoppingRule as StoppingRule
from .stopping import Why as Why
from .stream import Stream as Stream
from .stream import StreamOptions as StreamOptions
from .stream_update import Outlier as Outlier
from .stream_update import StreamUpdate as StreamUpdate
