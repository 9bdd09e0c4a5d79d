"""``gtsam-rwhec plan``: which poses to measure next, and whether more of them reach a wanted accuracy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import say, shown, shown_path

ARM_PANEL = "Options for an arm, of which a URDF tells the reach (pip install 'gtsam-rwhec[plan]')"


def plan(
    source: Annotated[
        Path | None,
        typer.Argument(
            help="result.json, or the folder that calibrate wrote; without it the rig file alone is known.",
            show_default=False,
        ),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option(help="Rig file (YAML).", show_default="the one of the calibrated log")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for plan.yaml, plan.csv, plan.mcap (ROS 2) and pictures."),
    ] = None,
    wanted_mm: Annotated[
        float | None, typer.Option("--wanted-mm", help="The wanted accuracy of a point before a sensor, mm.")
    ] = None,
    point_m: Annotated[
        float | None,
        typer.Option("--at-m", help="The distance of that point, m.", show_default="where the sensor sees its targets"),
    ] = None,
    sensor: Annotated[str | None, typer.Option(help="The sensor that counts.", show_default="the worst one")] = None,
    poses: Annotated[int, typer.Option(min=1, help="How many poses are proposed.")] = 12,
    near_m: Annotated[float | None, typer.Option("--near-m", help="The nearest target that is detected, m.")] = None,
    far_m: Annotated[float | None, typer.Option("--far-m", help="The farthest target that is detected, m.")] = None,
    tilt_deg: Annotated[float, typer.Option("--tilt-deg", help="The most that a target is tilted.")] = 55.0,
    turn_deg: Annotated[float, typer.Option("--turn-deg", help="The most that the robot turns from its pose.")] = 90.0,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            help="Where the moving carrier's origin stays: XMIN YMIN ZMIN XMAX YMAX ZMAX, m, in the other's frame."
        ),
    ] = None,
    present: Annotated[
        tuple[float, float, float, float, float, float, float] | None,
        typer.Option(
            help="Where the robot stands: X Y Z QX QY QZ QW of the moving carrier in the other's frame, m.",
            show_default="the last measurement",
        ),
    ] = None,
    urdf: Annotated[Path | None, typer.Option(rich_help_panel=ARM_PANEL, help="The robot's URDF.")] = None,
    base_link: Annotated[
        str | None, typer.Option(rich_help_panel=ARM_PANEL, help="The link that stands.", show_default="as the frame")
    ] = None,
    tip_link: Annotated[
        str | None, typer.Option(rich_help_panel=ARM_PANEL, help="The link that moves.", show_default="as the frame")
    ] = None,
    joints: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=ARM_PANEL, help="Where the joints are: rad, commas between.", show_default="in the middle"
        ),
    ] = None,
) -> ExitStatus:
    """Which poses to measure next, the best first: what makes every frame unique, then what a point gains most from.

    The robot is not moved. Exit status 0: the poses are proposed, and lead to the wanted accuracy. 3: they do not, or
    there are none; the first line says why.
    """
    if source is None and rig is None:
        raise typer.BadParameter("give a calibration, or --rig")
    file, old = None if rig is None else rw.rig.read_rig(rig), None
    if source is not None:
        old = rw.runs.OldCalibration.read(source)
        file = file or old.rig
    names = (file.carriers.sensors, file.carriers.targets) if file is not None else ("sensorcarrier", "targetcarrier")
    sensors_move = file is None or file.carriers.poses.parent_and_child[1] == names[0]
    fixed, moving = names[::-1] if sensors_move else names
    now = None if present is None else rw.capture.stated_pose(present, "--present", is_inverse=sensors_move)
    arm = None
    if urdf is not None:
        arm = rw.capture.Arm.read(
            urdf, base_link or fixed, tip_link or moving, None if joints is None else _numbers(joints)
        )
    radius_m = math.inf if wanted_mm is None else 1e-3 * wanted_mm
    wanted = rw.Accuracy(radius_m, point_m, sensors=() if sensor is None else (sensor,))
    options = rw.PlanOptions(
        poses=poses, wanted=wanted, near_m=near_m, far_m=far_m, tilt_deg=tilt_deg,
        turn_deg=turn_deg, box_m=None if box is None else (box[:3], box[3:]), present=now, arm=arm,
        moves="sensors" if sensors_move else "targets",
    )  # fmt: skip
    found = rw.plan(None if old is None else old.result, options, rig=file, cameras={} if old is None else old.cameras)
    rw.capture.print_plan(found)
    if output is not None:
        rw.capture.write_plan(found, output)
        say(f"Written to {shown_path(output)}.", to_errors=True)
    return ExitStatus.DONE if found.outlook.can_be_reached else ExitStatus.NOT_UNIQUE


def _numbers(words: str) -> list[float]:
    try:
        return [float(word) for word in words.split(",")]
    except ValueError as error:
        raise OptionError(f"--joints {shown(words)}; give numbers with commas between them") from error
