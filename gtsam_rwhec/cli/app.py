"""The command ``gtsam-rwhec`` with all its subcommands."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import gtsam_rwhec as rw
from gtsam_rwhec.cli.calibrate_command import calibrate
from gtsam_rwhec.cli.compare_methods import compare
from gtsam_rwhec.cli.compare_results import accept, diff, verify
from gtsam_rwhec.cli.convert_command import convert
from gtsam_rwhec.cli.demo_and_data import demo, utias
from gtsam_rwhec.cli.failures import HELP, ExitStatus, failures_in_words
from gtsam_rwhec.cli.fleet_commands import run, watch
from gtsam_rwhec.cli.init_command import init
from gtsam_rwhec.cli.live_command import live
from gtsam_rwhec.cli.plan_command import plan
from gtsam_rwhec.cli.report_command import report
from gtsam_rwhec.cli.stage_commands import clean, detect, export, solve
from gtsam_rwhec.files.terminal_text import printable, say

#: The base class of all usage errors. Typer contains its own copy of click, without public names for the classes.
_UsageError: Any = typer.BadParameter.__base__


class PrintableUsage(TyperGroup):
    """Subcommands whose usage errors cannot control the terminal. They repeat arguments, which may be hostile."""

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        """The context of the command itself."""
        with _printable_usage():
            return super().make_context(*arguments, **options)

    def invoke(self, ctx: Any) -> Any:
        """Parse the subcommand's arguments and run it."""
        with _printable_usage():
            return super().invoke(ctx)


@contextmanager
def _printable_usage() -> Iterator[None]:
    try:
        yield
    except _UsageError as error:
        error.message = printable(error.message)
        raise


app = typer.Typer(
    name="gtsam-rwhec",
    cls=PrintableUsage,
    help="Find the poses of cameras and other sensors on a robot or rig, with a proof that no answer is better.",
    epilog=HELP,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
fetch_app = typer.Typer(help="Download public measurements.", no_args_is_help=True)
app.add_typer(fetch_app, name="fetch")
fleet_app = typer.Typer(help="Many robots: calibrate all from their logs, and watch them drift.", no_args_is_help=True)
app.add_typer(fleet_app, name="fleet")


def add(subcommand: Callable[..., ExitStatus], to: typer.Typer) -> None:
    """Register a subcommand. Its errors are printed as messages, and it returns the exit status."""

    @wraps(subcommand)
    def run(*arguments: Any, **options: Any) -> None:
        with failures_in_words():
            status = subcommand(*arguments, **options)
        raise typer.Exit(status)

    to.command(epilog=HELP)(run)


OF_CALIBRATION = (calibrate, demo, init, plan, live, convert, detect, clean, solve, export, report, compare)
for subcommand in (*OF_CALIBRATION, diff, verify, accept):
    add(subcommand, app)
add(utias, fetch_app)
add(run, fleet_app)
add(watch, fleet_app)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        say(f"gtsam-rwhec {rw.__version__} (gtsam {version('gtsam')})")
        raise typer.Exit


@app.callback()
def common(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options of the command itself; the subcommands do the work."""


def main() -> None:
    """Entry point of the command ``gtsam-rwhec``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a question mark replaces a sign that the terminal lacks
            stream.reconfigure(errors="replace")
    try:
        app(prog_name="gtsam-rwhec")
    except KeyboardInterrupt:
        sys.exit(ExitStatus.INTERRUPTED)
