"""What people type: the command ``gtsam-rwhec``. It parses, calls and prints; everything else is in the library.

A subcommand is a module with the same name. The modules reach the library as any program does, by
``import gtsam_rwhec as rw``: so a command brings in only what it uses, and ``--help`` brings in nothing.
"""

from gtsam_rwhec.cli.app import main

__all__ = ["main"]
