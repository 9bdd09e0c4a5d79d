"""Every table and figure of the two papers that can be made, into one folder.

    python examples/papers/all.py [--runs N] [--output FOLDER] [--utias FOLDER]

Without ``--runs`` each script takes its own number, the papers' where they state one. The recordings of the DQ paper
and the ground truth of the RWHEC paper's Table 6 are not public: their rows cannot be made. Section 9's certificate,
with known scale, and Figure 8 need the RWHEC paper's real dataset (``gtsam-rwhec fetch utias FOLDER``).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from rich.console import Console

HERE = Path(__file__).resolve().parent
SCRIPTS = ("dq_table_1", "dq_table_2", "dq_figure_2", "dq_figure_3", "dq_figure_6", "rwhec_tables")


def main() -> int:
    """Run them one after the other, each with all cores; 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, help="of every script (default: each one's own)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes (all cores: %(default)s)")
    parser.add_argument("--output", type=Path, default=HERE.parent / "output" / "papers", metavar="FOLDER")
    parser.add_argument("--utias", type=Path, default=os.environ.get("GTSAM_RWHEC_UTIAS"), metavar="FOLDER")
    arguments = parser.parse_args()
    shared = ["--seed", str(arguments.seed), "--workers", str(arguments.workers), "--output", str(arguments.output)]
    if arguments.runs is not None:
        shared += ["--runs", str(arguments.runs)]
    commands = {name: [f"papers/{name}.py", *shared] for name in SCRIPTS}
    commands["Figure 10 (RWHEC)"] = ["sparsity.py", "--save", str(arguments.output)]
    console = Console(stderr=True)
    if arguments.utias is None:
        console.print(
            "Left out: Section 9 and Figure 8 of the RWHEC paper; neither --utias nor GTSAM_RWHEC_UTIAS is given"
        )
    else:
        grid = ["figure_8_grid.py", str(arguments.utias), "--save", str(arguments.output)]
        commands["Section 9 and Figure 8 (RWHEC)"] = grid
    failed = []
    for name, (script, *options) in commands.items():
        console.rule(name)
        if subprocess.run([sys.executable, str(HERE.parent / script), *options], check=False).returncode:
            failed.append(name)
    if failed:
        console.print(f"failed: {', '.join(failed)}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
