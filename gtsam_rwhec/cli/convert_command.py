"""``gtsam-rwhec convert``: make an MCAP log of the files of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus
from gtsam_rwhec.cli.shared_options import McapOption, refuse
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.terminal_text import say, shown_path, some

Columns = Literal["tx ty tz qx qy qz qw", "tx ty tz qw qx qy qz", "qw qx qy qz tx ty tz", "qx qy qz qw tx ty tz"]


#: Parameters that count beside a file of poses.
OF_POSES = frozenset({"columns", "parent", "child", "camera"})
NOT_FOR_A_BAG = {"only for a folder of images with --poses. Add --poses FILE, or leave the option out.": OF_POSES}
NOT_WITH_A_RIG = {"not with --rig, whose file states it. Leave one of them out.": OF_POSES | {"poses"}}


def convert(
    context: typer.Context,
    source: Annotated[
        Path,
        typer.Argument(help="ROS 1 bag, folder of a ROS 2 db3 bag, folder of images, or samples of a hand-eye tool."),
    ],
    output: McapOption,
    rig: Annotated[
        Path | None,
        typer.Option(help="For folders of images: rig file that names them, their poses and their cameras."),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="For a folder of images: file of poses. Each line has an image name or a stamp, and seven numbers."
        ),
    ] = None,
    columns: Annotated[Columns, typer.Option(help="With --poses: the order of the seven numbers.")] = (
        "tx ty tz qx qy qz qw"
    ),
    parent: Annotated[str, typer.Option(help="With --poses: the fixed frame, in which the poses are given.")] = "base",
    child: Annotated[str, typer.Option(help="With --poses: the moving frame, whose poses are given.")] = "hand",
    camera: Annotated[str, typer.Option(help="With --poses: name of the camera.")] = "camera",
) -> ExitStatus:
    """Make an MCAP log of a ROS bag, or of a folder of images and a file of poses."""
    with StageDisplay() as stage:
        stage(f"converting {source}")
        if rig is not None:
            refuse(context, NOT_WITH_A_RIG)
            described = rw.rig.read_rig(rig)
            if rw.runs.is_file_of_samples(source, described):
                said = f"{rw.runs.write_samples_log(source, described, output)}.\nWritten to {shown_path(output)}."
            elif rw.runs.is_folder_of_images(source, described):
                images, number = rw.runs.write_folder_log(source, described, output, progress=stage)
                what = "images" if any(sensor.images is not None for sensor in described.sensors.values()) else "clouds"
                said = f"Written to {shown_path(output)}: {images} {what} and {number} poses."
            else:
                raise LogError(
                    f"{source}: --rig is for a folder of images with poses beside them, and a rig file with "
                    "carriers.poses: {frames: [parent, child]}. Leave --rig out for a bag"
                )
            say(f"{said}\nNext: gtsam-rwhec calibrate {shown_path(output)} --rig {shown_path(rig)} -o out")
            return ExitStatus.DONE
        if poses is not None:
            images, number = rw.logs.write_image_folder(
                source, poses, output, columns=columns, parent=parent, child=child, camera=camera
            )
            said = f"{images} images and {number} poses"
        else:
            refuse(context, NOT_FOR_A_BAG)
            if rw.logs.is_samples_file(source):
                raise LogError(
                    f"{source}: samples of a hand-eye tool become a log with --rig FILE, whose carriers have poses: "
                    "{frames: [base, hand]}. Without one, gtsam-rwhec calibrate reads them as they are"
                )
            if rw.logs.is_image_folder(source):
                raise LogError(
                    f"{source} is a folder of images. Name the file with the robot's poses as well: --poses FILE; or "
                    "describe the folder in a rig file: --rig FILE"
                )
            said = f"{rw.logs.convert_ros_bag(source, output)} messages{messages_not_read(output)}"
    say(f"Written to {shown_path(output)}: {said}.\nNext: gtsam-rwhec init {shown_path(output)} -o rig.yaml")
    return ExitStatus.DONE


#: At most so many types of messages are named.
MOST_NAMED = 8


def messages_not_read(log: Path) -> str:
    """The types of a log's messages that the next step passes over, as a clause; empty if it reads all."""
    counts: dict[str, int] = {}
    with rw.logs.open_log(log) as opened:
        for topic in opened.topics():
            if topic.unreadable:
                counts[topic.schema] = counts.get(topic.schema, 0) + topic.count
    if not counts:
        return ""
    named = some([f"{schema} ({counts[schema]})" for schema in sorted(counts)], MOST_NAMED)
    return f". The next step does not read {named}; they are kept in the log"
