"""How fast a program starts, beside one that imports gtsam alone.

    python benchmarks/start_time.py [--repetitions 15]

Every repetition starts each program once, in turns; a ratio is the median over the repetitions. The third row has no
bar: what a name costs when it is first asked for is no part of the import, and must not hide there.
"""

from __future__ import annotations

import subprocess
import sys
from functools import partial

from bars import Row, at_most, in_words, interleaved, run_script

PROGRAMS = {
    "import gtsam": ("-c", "import gtsam"),
    "import gtsam_rwhec": ("-c", "import gtsam_rwhec"),
    "gtsam-rwhec --help": ("-m", "gtsam_rwhec", "--help"),
    "import gtsam_rwhec as rw; rw.Problem; rw.solve": ("-c", "import gtsam_rwhec as rw; rw.Problem; rw.solve"),
}
BARS = {"import gtsam_rwhec": 2.5, "gtsam-rwhec --help": 4.0}


def rows(repetitions: int) -> list[Row]:
    """Each program's time over that of `import gtsam`."""
    times = interleaved(
        repetitions,
        {
            name: partial(subprocess.run, [sys.executable, *arguments], check=True, capture_output=True)
            for name, arguments in PROGRAMS.items()
        },
    )
    table = []
    for name in list(PROGRAMS)[1:]:
        ratio, took = times.ratio(name, "import gtsam"), in_words(times.median(name))
        table.append(at_most(f"{name}, over import gtsam", ratio, BARS.get(name), "x", ".2f", f" ({took})"))
    return table


if __name__ == "__main__":
    run_script("Start", rows, repetitions=15)
