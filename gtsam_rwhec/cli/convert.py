"""``gtsam-rwhec convert``: an MCAP log of what other programs recorded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.options import McapOption
from gtsam_rwhec.cli.roads import refuse_others
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.errors import LogError

Columns = Literal["tx ty tz qx qy qz qw", "tx ty tz qw qx qy qz", "qw qx qy qz tx ty tz", "qx qy qz qw tx ty tz"]


@dataclass(frozen=True)
class BagOptions:
    """What the conversion of a ROS bag takes."""

    source: Path
    output: Path


@dataclass(frozen=True)
class ImageFolderOptions:
    """What the conversion of a folder of images takes."""

    source: Path
    output: Path
    poses: Path
    columns: Columns
    parent: str
    child: str
    camera: str


NOT_FOR_A_BAG: dict[type, str] = {
    ImageFolderOptions: "only for a folder of images with --poses. Add --poses FILE, or leave the option out."
}


def convert(
    context: typer.Context,
    source: Annotated[Path, typer.Argument(help="ROS 1 bag, folder of a ROS 2 db3 bag, or folder of images.")],
    output: McapOption,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="For a folder of images: text or CSV file of poses; each line has a name or stamp and seven numbers."
        ),
    ] = None,
    columns: Annotated[Columns, typer.Option(help="With --poses: the order of the seven numbers.")] = (
        "tx ty tz qx qy qz qw"
    ),
    parent: Annotated[str, typer.Option(help="With --poses: they are poses of --child in this frame.")] = "base",
    child: Annotated[str, typer.Option(help="With --poses: the frame that moves.")] = "hand",
    camera: Annotated[str, typer.Option(help="With --poses: name of the camera.")] = "camera",
) -> ExitStatus:
    """Make an MCAP log of a ROS bag, or of a folder of images with a file of poses."""
    if poses is None:
        refuse_others(context, [BagOptions], NOT_FOR_A_BAG)
        said = convert_bag(BagOptions(source, output))
    else:
        said = convert_images(ImageFolderOptions(source, output, poses, columns, parent, child, camera))
    typer.echo(f"{said} written to {output}.")
    return ExitStatus.DONE


def convert_bag(options: BagOptions) -> str:
    """Convert a ROS bag; say how much was written."""
    if rw.logs.is_image_folder(options.source):
        raise LogError(
            f"{options.source} is a folder of images, which say nothing of where they were taken: give --poses"
        )
    with StageDisplay() as stage:
        stage(f"converting {options.source}")
        return f"{rw.logs.convert_ros_bag(options.source, options.output)} messages"


def convert_images(options: ImageFolderOptions) -> str:
    """Convert a folder of images and a file of poses; say how much was written."""
    with StageDisplay() as stage:
        stage(f"converting {options.source}")
        images, poses = rw.logs.write_image_folder(
            options.source,
            options.poses,
            options.output,
            columns=options.columns,
            parent=options.parent,
            child=options.child,
            camera=options.camera,
        )
    return f"{images} images and {poses} poses"
