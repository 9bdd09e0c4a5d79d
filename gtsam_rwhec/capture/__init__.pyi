# A session while the robot stands there, and where its messages come from.
from .live_session import LiveOptions as LiveOptions
from .live_session import Session as Session
from .live_session import source_of as source_of
from .live_streams import StillOptions as StillOptions
from .sources import Source as Source

# What it answers after each take, and what it calls for the next pose and the end.
from .live_answer import Answer as Answer
from .live_answer import Decision as Decision
from .live_answer import Hooks as Hooks
from .live_answer import Proposal as Proposal
from .live_answer import Wanted as Wanted

# Who shows it.
from .live_server import PageServer as PageServer
from .live_terminal import show_on_terminal as show_on_terminal
