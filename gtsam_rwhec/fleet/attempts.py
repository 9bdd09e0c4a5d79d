"""One task carried out in a worker: errors become a row, and what another attempt may mend is tried again."""

from __future__ import annotations

import time
import traceback
from pathlib import Path

from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.fleet.measured_task import bounded_memory
from gtsam_rwhec.fleet.tasks import Failed, Receipt, Task
from gtsam_rwhec.fleet.without_secrets import without_secrets
from gtsam_rwhec.geometry.blas_threads import one_blas_thread

#: A task is tried so often, for errors of the system and for workers that die.
ATTEMPTS = 3
#: Seconds before the second attempt; three times as many before each further one.
PAUSE_S = 0.2


def attempted(
    task: Task,
    done: tuple[Receipt | Failed, ...] = (),
    *,
    attempts: int = ATTEMPTS,
    memory_bytes: int | None = None,
    pause_s: float = PAUSE_S,
) -> Receipt | Failed:
    """The task's receipt, or why there is none.

    Errors of the system (`OSError`: a disk, a network, a store) are tried again. Those of the library, and all others,
    are not: they would come again. BLAS has one thread.

    Parameters
    ----------
    task
        The task.
    done
        The outcomes of the tasks it comes after; given to it where it has any.
    attempts
        How often it is tried.
    memory_bytes
        What the process may have; None for no bound. More is a Failed of kind ``MemoryError``.
    pause_s
        Seconds before the second attempt.
    """
    arguments = (*task.arguments, done) if task.after else task.arguments
    attempt = 0
    while True:
        attempt += 1
        try:
            with one_blas_thread(), bounded_memory(memory_bytes):
                receipt = task.function(*arguments)
            if not isinstance(receipt, Receipt):
                raise TypeError(f"{task.function.__qualname__} gave {type(receipt).__name__}, not a Receipt")
            return receipt
        except OSError as error:
            if attempt >= attempts:
                return _failed(task, error, str(error) or type(error).__name__, attempt)
            time.sleep(pause_s * 3 ** (attempt - 1))
        except RwhecError as error:
            return _failed(task, error, str(error), attempt)
        except MemoryError as error:
            most = "" if memory_bytes is None else f" than the {memory_bytes} bytes that a worker may have"
            return _failed(task, error, f"it needs more memory{most}; give workers more", attempt)
        except Exception as error:  # noqa: BLE001  (one task's fault is a row of the report, not the end of the run)
            words = f"a fault of the program: {type(error).__name__}: {error} ({_place(error)})"
            return _failed(task, error, words, attempt)


def _failed(task: Task, error: Exception, words: str, attempts: int) -> Failed:
    return Failed(task.key, without_secrets(words), type(error).__name__, attempts)


def _place(error: Exception) -> str:
    """File and line where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"{Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else "unknown place"
