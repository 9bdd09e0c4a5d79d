"""The command ``gtsam-rwhec``. It parses, calls the library and prints.

The modules reach the library as any program does, by ``import gtsam_rwhec as rw``: so a command imports only what it
uses, and ``--help`` imports nothing.
"""

import gc
import sys

from gtsam_rwhec.errors import MissingPackageError
from gtsam_rwhec.files.optional_packages import extra_named

#: Python looks for garbage after so many new objects: most of a run's stay, and looking often took 0.8 s of 100 tags.
GARBAGE = 50_000


def main() -> None:
    """Run the command; without the extra ``cli`` it ends with a message that names this extra."""
    gc.set_threshold(GARBAGE)
    try:
        with extra_named():
            from gtsam_rwhec.cli.app import main
    except MissingPackageError as error:
        sys.exit(f"Error: {error}")
    main()


__all__ = ["main"]
