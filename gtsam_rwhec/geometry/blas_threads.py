"""One thread of linear algebra while the library computes: its matrices are small, and threads would only wait.

As installed, NumPy and SciPy each bring a BLAS of their own, which starts a thread on every core for a matrix of a few
dozen rows. The threads wait for each other in busy loops. If another program uses a core, a call of microseconds then
takes milliseconds, and a solve becomes a hundred times slower.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache

import scipy.linalg  # noqa: F401  # loads the BLAS of SciPy, so that `_libraries` finds it; NumPy's is loaded before
from threadpoolctl import LibController, OpenBLASController, ThreadpoolController


@cache
def _libraries() -> tuple[LibController, ...]:
    """Every BLAS that is loaded; looked up once, since the search takes milliseconds."""
    return tuple(ThreadpoolController().select(user_api="blas").lib_controllers)


def _set(counts: list[tuple[LibController, int]]) -> None:
    """Set the libraries' numbers of threads.

    threadpoolctl allows only the Python thread that changed OpenBLAS last to change it again. Here another thread may
    restore the number, and so may the user's own code.
    """
    for library, count in counts:
        library.set_num_threads(count)
    OpenBLASController.clear_controlling_thread()


@dataclass
class _Limit:
    """How many calls hold the limit now, in all Python threads, and the BLAS threads before the first of them."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    holders: int = 0
    before: list[tuple[LibController, int]] = field(default_factory=list)

    def enter(self) -> None:
        """Set one thread, if nobody holds the limit yet."""
        with self.lock:
            if self.holders == 0:
                self.before = [(library, library.get_num_threads()) for library in _libraries()]
                _set([(library, 1) for library, count in self.before if count != 1])
            self.holders += 1

    def leave(self) -> None:
        """Restore the numbers if no other call holds the limit; a number that other code set meanwhile stays."""
        with self.lock:
            self.holders -= 1
            if self.holders == 0:
                _set([(library, count) for library, count in self.before if library.get_num_threads() == 1 != count])


_limit = _Limit()
# Otherwise, after a fork while another thread holds the lock, the child process would wait for ever.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_limit.lock.acquire, after_in_parent=_limit.lock.release, after_in_child=_limit.lock.release
    )


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS use one thread, in a ``with`` block or as a decorator.

    The number of threads is one of the process, not of a Python thread. Calls may be nested, and may overlap in several
    Python threads: the first sets one thread, the last to leave sets what was there before, also after an exception.
    Meanwhile, BLAS calls of other code in the process have one thread as well.
    """
    _limit.enter()
    try:
        yield
    finally:
        _limit.leave()
