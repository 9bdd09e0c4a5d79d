"""The command ``gtsam-rwhec``. It parses, calls the library and prints.

A subcommand is a module with the same name. The modules reach the library as any program does, by
``import gtsam_rwhec as rw``: so a command imports only what it uses, and ``--help`` imports nothing.
"""

from gtsam_rwhec.cli.app import main

__all__ = ["main"]
