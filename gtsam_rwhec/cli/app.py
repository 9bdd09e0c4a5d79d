"""The subcommands of ``gtsam-rwhec`` and their options."""

from __future__ import annotations

import io
import math
import shlex
import sys
import warnings
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from gtsam_rwhec import __version__
from gtsam_rwhec.cli.compare_command import add_compare_command
from gtsam_rwhec.cli.exit_status import HELP, ExitStatus, exit_status
from gtsam_rwhec.cli.failures import failures_in_words
from gtsam_rwhec.cli.log_commands import add_log_commands, calibrate_from_log, is_log
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.datasets.demo_log import LOG, RIG, demo_folder
from gtsam_rwhec.datasets.download import UTIAS_URL, fetch_utias
from gtsam_rwhec.errors import FileFormatError, NotCertifiedWarning, NotUniqueWarning
from gtsam_rwhec.problem.csv_folder import read_csv
from gtsam_rwhec.refinement.options import CarrierNoise, RefineOptions
from gtsam_rwhec.refinement.refining import refine
from gtsam_rwhec.report import print_refined, print_solution, report_console
from gtsam_rwhec.results.refined_file import write_refined
from gtsam_rwhec.results.solution_file import read_solution, write_solution
from gtsam_rwhec.solving.certified_solution import solve

app = typer.Typer(
    name="gtsam-rwhec",
    help="Calibrate sensors against their carriers and targets, with a proof that no answer is better.",
    epilog=HELP,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
fetch_app = typer.Typer(help="Download public measurements.", no_args_is_help=True)
app.add_typer(fetch_app, name="fetch")
add_log_commands(app)
add_compare_command(app)


class Scale(StrEnum):
    """What is known about the scale of the measured translations."""

    known = "known"
    shared = "shared"
    per_target = "per_target"


class Refine(StrEnum):
    """Whose noise the refinement takes."""

    given = "given"
    estimate = "estimate"


class Robust(StrEnum):
    """What the refinement does about measurements that are wrong."""

    none = "none"
    gnc = "gnc"
    huber = "huber"
    cauchy = "cauchy"
    tukey = "tukey"
    geman_mcclure = "geman_mcclure"


class Method(StrEnum):
    """How to solve."""

    auto = "auto"
    sdp = "sdp"
    local = "local"


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"gtsam-rwhec {__version__} (gtsam {version('gtsam')})")
        raise typer.Exit


@app.callback()
def common(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options of the command itself; what it does is in the subcommands."""


@app.command(epilog=HELP)
def calibrate(
    source: Annotated[
        Path, typer.Argument(help="MCAP log, or folder of <targets>_<id>_<sensors>_<id>_{A,B}.csv files.")
    ],
    rig: Annotated[
        Path | None, typer.Option(help="Of a log: rig file (YAML). Left out for a log that a stage wrote.")
    ] = None,
    scale: Annotated[Scale, typer.Option(help="Is the targets' size known, wrong by one factor, or by one each?")] = (
        Scale.known
    ),
    sigma: Annotated[
        float | None, typer.Option(help="Standard deviation of a measured translation along each axis, m.")
    ] = None,
    kappa: Annotated[
        float | None,
        typer.Option(help="Concentration of a measured rotation: 1/(2 s^2) for a deviation of s rad about each axis."),
    ] = None,
    method: Annotated[
        Method, typer.Option(help="Fastest proof; always the semidefinite relaxation; from --initial only.")
    ] = Method.auto,
    targets: Annotated[str, typer.Option(help="The file names' word for targets.")] = "tag",
    sensors: Annotated[str, typer.Option(help="The file names' word for sensors.")] = "cam",
    initial: Annotated[
        Path | None, typer.Option(help="Result of an earlier calibration (JSON) to start from; for --method local.")
    ] = None,
    refine_with: Annotated[
        Refine | None,
        typer.Option("--refine", help="Refine the certified answer; noise as given, or estimated; report covariances."),
    ] = None,
    robust: Annotated[
        Robust,
        typer.Option(help="With --refine: gnc leaves outliers out, certified; the others are losses of GTSAM."),
    ] = Robust.none,
    carrier_noise_deg: Annotated[
        float | None, typer.Option(help="With --refine: noise of the carriers' poses A about each axis, degrees.")
    ] = None,
    carrier_noise_mm: Annotated[
        float | None, typer.Option(help="With --refine: noise of the carriers' poses A along each axis, mm.")
    ] = None,
    images: Annotated[bool, typer.Option("--images", help="Of a log: have the images in clean.mcap too.")] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Of a log: threads for detection.", show_default="all cores")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Of CSV files: result (JSON). Of a log: the folder for everything."),
    ] = None,
) -> None:
    """Calibrate from a log, or from a folder of CSV files; print poses, residuals, the certificate, covariances.

    For a log, noise, scale and the like are in the rig file, and everything is written to a folder: clean.mcap,
    result.json, static_tf.launch.py, tf.yaml, rig.urdf.xacro, camchain.yaml and plots.
    """
    if is_log(source, rig):
        _refuse_csv_options(scale, sigma, kappa, method, initial, refine_with, robust)
        if output is None:
            raise typer.BadParameter("a log's calibration is a folder of files: say which with -o FOLDER")
        calibrate_from_log(source, rig, output, images=images, workers=workers)
        return
    if images or workers is not None:
        raise typer.BadParameter("--images and --workers are for logs")
    folder = source
    if (initial is not None) != (method is Method.local):
        raise typer.BadParameter("--method local and --initial FILE go together")
    carrier_noises = {carrier_noise_deg is None, carrier_noise_mm is None}
    if refine_with is None and (robust is not Robust.none or False in carrier_noises):
        raise typer.BadParameter("without --refine, --robust and --carrier-noise-deg, --carrier-noise-mm say nothing")
    if len(carrier_noises) > 1:
        raise typer.BadParameter("--carrier-noise-deg and --carrier-noise-mm go together")
    with failures_in_words():
        if output is not None and not output.absolute().parent.is_dir():
            raise FileFormatError(f"{output} cannot be written: there is no folder {output.parent}.")
        with StageDisplay() as stage, warnings.catch_warnings():
            warnings.simplefilter("ignore", NotUniqueWarning)  # the report says it, with the directions
            warnings.simplefilter("ignore", NotCertifiedWarning)
            stage(f"reading {folder}")
            keep = refine_with is not None
            problem = read_csv(folder, scale.value, sigma, kappa, targets, sensors, keep_measurements=keep)
            start = None
            if initial is not None:
                earlier = read_solution(initial)
                start = (earlier.X, earlier.Y, earlier.scale)
            solution = solve(problem, method=method.value, initial=start, progress=stage)
            refined = None
            if refine_with is not None:
                options = RefineOptions(
                    noise=refine_with.value,
                    robust=robust.value,
                    carrier_noise=_carrier_noise(carrier_noise_deg, carrier_noise_mm),
                )
                refined = refine(problem, solution, options, progress=stage)
                solution = refined.solution  # that of the inliers, where outliers were left out
        try:
            if output is not None:
                if refined is None:
                    write_solution(solution, output)
                else:
                    write_refined(refined, output)
                typer.echo(f"Written to {output}.", err=True)
        finally:  # a result that cannot be written is shown all the same
            print_solution(solution)
            if refined is not None:
                report_console().print()
                print_refined(refined)
        status = exit_status(solution)
        if refined is not None and refined.free_directions and status is ExitStatus.CERTIFIED:
            status = ExitStatus.NOT_UNIQUE
        raise typer.Exit(status)


def _refuse_csv_options(
    scale: Scale,
    sigma: float | None,
    kappa: float | None,
    method: Method,
    initial: Path | None,
    refine_with: Refine | None,
    robust: Robust,
) -> None:
    """A log's rig file says all this: an option that would be passed over is refused."""
    given = {
        "--scale": scale is not Scale.known,
        "--sigma": sigma is not None,
        "--kappa": kappa is not None,
        "--method": method is not Method.auto,
        "--initial": initial is not None,
        "--refine": refine_with is not None,
        "--robust": robust is not Robust.none,
    }
    names = [name for name, is_given in given.items() if is_given]
    if names:
        raise typer.BadParameter(f"{', '.join(names)}: of a log, the rig file says this (sizes, noise, cleaning)")


def _carrier_noise(deg: float | None, mm: float | None) -> CarrierNoise | None:
    return None if deg is None or mm is None else CarrierNoise(math.radians(deg), 1e-3 * mm)


@app.command(epilog=HELP)
def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for everything.")] = Path("gtsam-rwhec-demo"),
) -> None:
    """Calibrate two cameras on a robot's hand from a log of images, which comes with this package."""
    with failures_in_words():
        folder = demo_folder()
    log, rig = folder / LOG, folder / RIG
    command = (
        f"gtsam-rwhec calibrate {shlex.quote(str(log))} --rig {shlex.quote(str(rig))} -o {shlex.quote(str(output))}"
    )
    report_console().print(f"The same as: {command}\n", markup=False, soft_wrap=True)
    calibrate_from_log(log, rig, output, images=False, workers=None)


@fetch_app.command(epilog=HELP)
def utias(
    destination: Annotated[Path, typer.Argument(help="Folder to write to; made if it is not there.")] = Path("utias"),
    base_url: Annotated[
        str, typer.Option(help="Where the files are, for a mirror.", show_default="the authors' repository on GitHub")
    ] = UTIAS_URL,
) -> None:
    """Download the real dataset of the RWHEC paper: 16 tags, 8 cameras, 3230 measurements, 1.4 MB.

    Call it again to go on with an interrupted download; files that are there are verified and kept.
    """
    with failures_in_words():
        with StageDisplay() as stage:
            fetched = fetch_utias(
                destination,
                base_url,
                lambda done, total, name: stage(f"downloading file {done + 1} of {total}: {name}"),
            )
        typer.echo(
            f"{len(fetched.downloaded)} files downloaded to {fetched.folder}, {len(fetched.already_there)} were there; "
            "all verified."
        )
        typer.echo(f"Next: gtsam-rwhec calibrate {shlex.quote(str(fetched.folder))} --scale shared")


def main() -> None:
    """Entry point of the command ``gtsam-rwhec``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal or pipe that lacks a sign gets a question mark
            stream.reconfigure(errors="replace")
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(ExitStatus.INTERRUPTED)
