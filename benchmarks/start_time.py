"""How fast a program starts, beside one that imports gtsam alone.

    python benchmarks/start_time.py [--repetitions 15]

Every repetition starts each program once, in turns; a ratio is the median over the repetitions. The third row has no
bar: what a name costs when it is first asked for is no part of the import, and must not hide there.
"""

from __future__ import annotations

import subprocess
import sys
from functools import partial

from bars import Row, benchmark_parser, print_rows
from interleaved import in_words, interleaved

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
        ratio, bar = times.ratio(name, "import gtsam"), BARS.get(name)
        figure = f"{ratio:.2f}x ({in_words(times.median(name))})"
        table.append(
            Row(f"{name}, over import gtsam", figure)
            if bar is None
            else Row(f"{name}, over import gtsam", figure, f"<= {bar}x", ratio <= bar)
        )
    return table


def main() -> int:
    """Print the table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--repetitions", type=int, default=15)
    arguments = parser.parse_args()
    return print_rows("Start", rows(arguments.repetitions))


if __name__ == "__main__":
    raise SystemExit(main())
