# The work of a run, and what carries it out.
from .tasks import Engine as Engine
from .tasks import Failed as Failed
from .tasks import Receipt as Receipt
from .tasks import Task as Task
