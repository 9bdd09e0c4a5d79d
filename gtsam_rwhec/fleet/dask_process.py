"""Dask's scheduler and workers in processes of their own: ``python -m gtsam_rwhec.fleet.dask_process``.

`DaskCluster` starts them, as commands and not by multiprocessing: the script that calls the library is not imported
again, so it needs no ``if __name__ == "__main__"``. They read from the standard input, and end when it ends: no process
outlives a caller that was killed.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
from typing import Any


async def _scheduler(options: dict[str, Any]) -> None:
    from distributed import Scheduler

    async with Scheduler(**options) as scheduler:
        told = {"address": scheduler.address, "dashboard": _dashboard(scheduler)}
        print(json.dumps(told), flush=True)
        await scheduler.finished()


async def _workers(address: str, count: int, options: dict[str, Any]) -> None:
    """Workers, each with a nanny that starts it anew when it dies or takes more memory than it may."""
    from distributed import Nanny

    nannies = [await Nanny(address, name=f"worker-{number}", **options) for number in range(count)]
    await asyncio.gather(*(nanny.finished() for nanny in nannies))


def _dashboard(scheduler: Any) -> str:
    port = scheduler.services["dashboard"].port if "dashboard" in scheduler.services else None
    return f"http://{scheduler.ip}:{port}/status" if port else ""


def _end_with_the_caller() -> None:
    """Read until the caller closes the other end, or ends."""
    while os.read(0, 1024):
        pass
    os._exit(1)


def main() -> None:
    """Run what the arguments say: ``scheduler OPTIONS``, or ``workers COUNT OPTIONS`` with the address on a line."""
    what, *words = sys.argv[1:]
    if what == "scheduler":
        running = _scheduler(json.loads(words[0]))
    else:
        import distributed  # noqa: F401  # while the scheduler starts, which tells the address when it has

        address = ""
        while not address.endswith("\n"):
            letter = os.read(0, 1).decode()  # not more: the rest is read by the thread
            if not letter:
                return
            address += letter
        running = _workers(address.strip(), int(words[0]), json.loads(words[1]))
    threading.Thread(target=_end_with_the_caller, daemon=True).start()
    asyncio.run(running)


if __name__ == "__main__":
    main()
