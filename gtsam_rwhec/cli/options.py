"""Options and arguments that several subcommands share: the type of each, and its help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

FOLDER_OF_CSV = "folder of <targets>_<id>_<sensors>_<id>_{A,B}.csv files"
Scale = Literal["known", "shared", "per_target"]

ScaleOption = Annotated[
    Scale, typer.Option(help="The sizes of the targets are known, wrong by one factor for all, or by one factor each.")
]
SigmaOption = Annotated[
    float | None, typer.Option(help="Standard deviation of a measured translation along each axis, m.")
]
KappaOption = Annotated[
    float | None,
    typer.Option(
        help="Concentration of a measured rotation: 1/(2 s^2) for a standard deviation of s rad about each axis."
    ),
]
TargetsOption = Annotated[str, typer.Option(help="The word for targets in the names of the files.")]
SensorsOption = Annotated[str, typer.Option(help="The word for sensors in the names of the files.")]

LogArgument = Annotated[Path, typer.Argument(help="MCAP file, or a folder of them (a ROS 2 bag).")]
McapOption = Annotated[Path, typer.Option("--output", "-o", help="MCAP file to write.")]
RigOption = Annotated[
    Path | None, typer.Option(help="For a log: rig file (YAML). A log that detect or clean wrote has one inside.")
]
ImagesOption = Annotated[bool, typer.Option("--images", help="For a log: copy its images too. They are large.")]
WorkersOption = Annotated[
    int | None, typer.Option(min=1, help="For a log: processes that look at images.", show_default="one for each core")
]
