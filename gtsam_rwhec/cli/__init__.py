"""What people type: the command ``gtsam-rwhec``. It parses, calls and prints; everything else is in the library."""

from gtsam_rwhec.cli.app import main

__all__ = ["main"]
