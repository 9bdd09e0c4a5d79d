"""Options and arguments that several subcommands share, and the report that two of them print."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus, exit_status
from gtsam_rwhec.files.terminal_text import say, shown_path

FOLDER_OF_CSV = "folder of CSV files such as tag_0_cam_0_A.csv and tag_0_cam_0_B.csv"
#: Headings in the help.
CSV_PANEL = "Options for a folder of CSV files"
LOG_PANEL = "Options for a log"
CHOICES_PANEL = "Choices for a folder of CSV files, which are otherwise made from the data"
Scale = Literal["known", "shared", "per_target"]

ScaleOption = Annotated[
    Scale,
    typer.Option(
        rich_help_panel=CSV_PANEL,
        help="known: the sizes of the targets are right. shared: one unknown factor for all sizes. per_target: an "
        "unknown factor for each size.",
    ),
]
SigmaOption = Annotated[
    float | None,
    typer.Option(
        rich_help_panel=CSV_PANEL, help="Standard deviation of a measured translation along each axis, metres."
    ),
]
KappaOption = Annotated[
    float | None,
    typer.Option(
        rich_help_panel=CSV_PANEL,
        help="Concentration of a measured rotation: 1/(2 s^2) for a standard deviation of s radians about each axis.",
    ),
]
TargetsOption = Annotated[
    str, typer.Option(rich_help_panel=CSV_PANEL, help="The word for a target in the names of the files.")
]
SensorsOption = Annotated[
    str, typer.Option(rich_help_panel=CSV_PANEL, help="The word for a sensor in the names of the files.")
]

McapOption = Annotated[Path, typer.Option("--output", "-o", help="MCAP file to write.")]
RigOption = Annotated[
    Path | None,
    typer.Option(rich_help_panel=LOG_PANEL, help="Rig file (YAML). A log that detect or clean wrote holds its own."),
]
ImagesOption = Annotated[
    bool, typer.Option("--images", rich_help_panel=LOG_PANEL, help="Copy the images too. They are large.")
]
NoReportImagesOption = Annotated[
    bool,
    typer.Option(
        "--no-report-images",
        rich_help_panel=LOG_PANEL,
        help="Leave images out of report.html. They may be confidential.",
    ),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        rich_help_panel=LOG_PANEL,
        help="Number of processes that search the images.",
        show_default="one for each core",
    ),
]


AnywayOption = Annotated[
    bool,
    typer.Option(
        "--anyway",
        rich_help_panel=LOG_PANEL,
        help="Write the files for other programs of poses that are not to be used too, with the reason in their heads.",
    ),
]


VerboseOption = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", help="Print everything, and not one screen: choices, corners, residuals, the proof."
    ),
]
#: The option for the whole report, as reports name it.
WHOLE = "--verbose"


def exported(solved: rw.runs.Solved | rw.odometry.OdometrySolved, *, anyway: bool) -> list[str]:
    """A message if poses must not be used: whether their files were written anyway; else no message."""
    if solved.judgement.verdict is not rw.Verdict.DO_NOT_USE:
        return []
    names = ", ".join([*rw.rig.FILES, *(f"{folder}/" for folder in rw.rig.FOLDERS)])
    if anyway:
        return [f"Written although the poses are not to be used, and marked so in the head: {names}."]
    return [f"Not written, as the poses are not to be used: {names}. --anyway writes them, marked."]


def show(
    calibrated: rw.runs.Calibrated, messages: Sequence[str], *, verbose: bool, page: Path | None = None
) -> ExitStatus:
    """Print the report of a calibrated log, and the command's messages, on one screen; its exit status."""
    rw.report.print_calibration(
        calibrated.calibration,
        log=calibrated.log,
        verbose=verbose,
        lines=rw.report.lines_beside(messages),
        page=page,
        whole=WHOLE,
    )
    for message in messages:
        say(message, to_errors=True)
    return exit_status(calibrated.judgement, of_rig=True)


def written_in(output: Path) -> tuple[str, Path | None]:
    """A message with the files that a calibration wrote into its folder; and its page, if it wrote one."""
    written = [name for name in rw.runs.OUTPUTS if (output / name).exists()]
    page = output / rw.runs.REPORT_FILE if rw.runs.REPORT_FILE in written else None
    return f"Written to {shown_path(output)}: {', '.join(written)}.", page


def show_odometries(solved: rw.odometry.OdometrySolved, output: Path, *, anyway: bool, verbose: bool) -> ExitStatus:
    """Print the report of sensors that know only their own motion, and where the files are; its exit status."""
    written, page = written_in(output)
    rw.odometry.print_odometry(solved.result, verbose=verbose, page=page)
    for message in (written, *exported(solved, anyway=anyway)):
        say(message, to_errors=True)
    return exit_status(solved.judgement, of_rig=True)


def refuse(context: typer.Context, options: Mapping[str, Collection[str]]) -> None:
    """Refuse the named options if the user wrote them, even with the default value.

    `options` has the names of parameters without effect, by the reason and what to do. Raises `typer.BadParameter`
    if the user wrote some of them; its message has the options and the reasons.
    """
    lines = []
    for why, names in options.items():
        refused = [
            max(parameter.opts, key=len)
            for parameter in context.command.params
            if parameter.name in names and is_given(context, parameter.name)
        ]
        if refused:
            lines.append(f"{', '.join(refused)}: {why}")
    if lines:
        raise typer.BadParameter("\n".join(lines))


def is_given(context: typer.Context, name: str) -> bool:
    """Whether the user wrote this option."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def command_of(context: typer.Context) -> str:
    """The command as the user gave it: its arguments, and the options without their default value."""
    words = ["gtsam-rwhec", context.info_name or ""]
    for parameter in context.command.params:
        name, value = str(parameter.name), context.params.get(str(parameter.name))
        if parameter.param_type_name == "argument":
            words.append(str(value))
        elif is_given(context, name):
            words += [parameter.opts[0]] if value is True else [parameter.opts[0], str(value)]
    return shlex.join(words)
