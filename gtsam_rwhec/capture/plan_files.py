"""A plan in files: YAML, CSV, the poses in MCAP for ROS 2, and the pictures that the cameras should see."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gtsam_rwhec.capture.plan_poses import Plan, PlannedPose
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.pictures import Picture, draw, jpeg_of
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.logs.mcap_writer import LogWriter
from gtsam_rwhec.logs.records import DetectionRecord
from gtsam_rwhec.report.report_blocks import Paragraph, Table
from gtsam_rwhec.report.terminal_report import print_blocks, report_console

#: The topic of the poses.
POSES_TOPIC = "/plan/poses"
#: A picture's paper and what is around it, gray; and bytes of a JPEG file.
PAPER, AROUND, MOST_BYTES = 245, 150, 300_000
#: The board's paper is larger than its corners by this share.
MARGIN = 1.15
HEADINGS = ("tour", "x m", "y m", "z m", "turn x°", "turn y°", "turn z°", "bits", "left mm", "sees")
LEGEND = (
    "tour: its place on a short way. turn: the rotation vector. bits: the information that it adds. left: after it a "
    "point before the worst sensor is within this distance of its true place."
)
FILES = ("plan.yaml", "plan.csv", "plan.mcap")


def write_plan(plan: Plan, folder: str | Path) -> tuple[Path, ...]:
    """Write a plan into a folder; returns the files.

    ``plan.yaml`` and ``plan.csv`` have T_parent_child of the carrier that the robot moves, metres and quaternions with
    x first, and the joints where an arm was given; the best pose is first, and ``tour`` is its place on a short way.
    ``plan.mcap`` has the same poses as one geometry_msgs/PoseArray in the frame of the parent. ``pictures`` has a JPEG
    for each pose and camera that should see something there.

    Raises
    ------
    FileFormatError, LogError
        The folder cannot be written.
    """
    folder = Path(folder)
    try:
        (folder / "pictures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"{folder} cannot be written: {error.strerror or error}.") from error
    rows = [_row(plan, i) for i in range(len(plan.poses))]
    text = io.StringIO()
    table = csv.DictWriter(text, [*rows[0]] if rows else ["pose"], lineterminator="\n")
    table.writeheader()
    table.writerows(
        {name: " ".join(cell) if isinstance(cell, list) else cell for name, cell in row.items()} for row in rows
    )
    files = [folder / name for name in FILES]
    write_atomically(files[0], _yaml(plan, rows).encode())
    write_atomically(files[1], text.getvalue().encode())
    if plan.poses:
        with LogWriter(files[2]) as out:
            out.pose_array(POSES_TOPIC, 0, plan.poses[0].parent, np.array([one.T_parent_child for one in plan.poses]))
    else:
        files.pop()
    for i, pose in enumerate(plan.poses):
        for sensor in dict.fromkeys(pair.sensor for pair in pose.sees if pair.sensor in plan.kit.cameras):
            files.append(folder / "pictures" / f"{i + 1:02d}_{sensor.replace('/', '_')}.jpg")
            write_atomically(files[-1], jpeg_of(picture_of(plan, pose, sensor), MOST_BYTES))
    return tuple(files)


def print_plan(plan: Plan) -> None:
    """Print a plan: the verdict first, then a table of the poses, the best first."""
    outlook, rows = plan.outlook, {}
    for i, pose in enumerate(plan.poses):
        T = pose.T_parent_child
        turn = Rotation.from_matrix(T[:3, :3]).as_rotvec(degrees=True)
        seen: dict[str, list[str]] = {}
        for pair in pose.sees:
            seen.setdefault(shown(pair.sensor), []).append(shown(pair.target))
        sees = ", ".join(f"{name} {of[0] if len(of) == 1 else f'{len(of)} targets'}" for name, of in seen.items())
        left = f"{pose.deviation_mm:.3f}" if np.isfinite(pose.deviation_mm) else "free"
        cells = (
            *(f"{value:.3f}" for value in T[:3, 3].round(3) + 0.0),
            *(f"{value:.1f}" for value in turn.round(1) + 0.0),
        )
        rows[str(i + 1)] = (str(plan.tour.index(i) + 1), *cells, f"{pose.bits:.1f}", left, sees)
    console = report_console()
    print_blocks(console, [Paragraph(str(plan), "good" if outlook.can_be_reached else "bad")])
    if plan.poses:
        first = plan.poses[0]
        caption = f"Poses of {shown(first.child)} in {shown(first.parent)}, the best first"
        print_blocks(console, [Table.of(caption, "pose", HEADINGS, rows, LEGEND)])
        share = f"{100.0 * plan.guarantee:.0f} %"
        say = f"{plan.drawn} poses were drawn: at {plan.visible} a target is seen, {plan.within} are within the limits"
        reached = "" if first.joints is None else f", of which the arm was tried on some and reaches {plan.reached}"
        note = f"The planned ones add at least {share} of the information that any {len(rows)} of these add."
        print_blocks(console, [Paragraph(f"{say}{reached}. {note}", "note")])


def _row(plan: Plan, i: int) -> dict[str, Any]:
    """A pose with the names of its numbers."""
    pose = plan.poses[i]
    T = pose.T_parent_child
    q = Rotation.from_matrix(T[:3, :3]).as_quat()
    joints = {} if pose.joints is None else {f"joint_{k + 1}": value for k, value in enumerate(pose.joints.tolist())}
    return {
        "pose": i + 1,
        "tour": plan.tour.index(i) + 1,
        "parent": pose.parent,
        "child": pose.child,
        **dict(zip(("x_m", "y_m", "z_m"), (T[:3, 3] + 0.0).tolist(), strict=True)),
        **dict(zip(("qx", "qy", "qz", "qw"), q.tolist(), strict=True)),
        **joints,
        "sees": [f"{pair.sensor}:{pair.target}" for pair in pose.sees],
        "bits": round(pose.bits, 3),
        "deviation_mm": round(pose.deviation_mm, 4) if np.isfinite(pose.deviation_mm) else None,
    }


def _yaml(plan: Plan, rows: list[dict[str, Any]]) -> str:
    import yaml

    outlook = plan.outlook
    content = {
        "verdict": str(plan),
        "wanted_mm": outlook.wanted_mm,
        "distance_m": round(outlook.distance_m, 6),
        "needed": outlook.needed,
        "guarantee": round(plan.guarantee, 4),
        "poses": rows,
    }
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110)


def picture_of(plan: Plan, pose: PlannedPose, sensor: str, background: Gray | None = None) -> Picture:
    """What a camera should see at a pose: each target's paper, corners and axes; (height, width, 3), blue, green, red.

    Parameters
    ----------
    background : (height, width) array, optional
        A gray image to draw over, such as what the camera sees now; papers are not drawn then.
    """
    camera = plan.kit.cameras[sensor]
    is_empty = background is None
    empty = np.full((camera.height, camera.width), AROUND, np.uint8)
    gray: Gray = empty if background is None else background.copy()
    records = []
    for pair, B in pose.T_sensor_target.items():
        if pair.sensor != sensor:
            continue
        board = plan.kit.boards[pair.target]
        pixels = camera.project(board @ B[:3, :3].T + B[:3, 3])
        paper = camera.project(MARGIN * board @ B[:3, :3].T + B[:3, 3])
        paper = pixels if not np.isfinite(paper).all() else paper
        if is_empty:
            hull = cv2.convexHull(np.round(paper).astype(np.int32).reshape(-1, 1, 2))
            cv2.fillConvexPoly(gray, hull, PAPER, cv2.LINE_AA)
        records.append(
            DetectionRecord(
                0, 0, "", sensor, "", pair.target, corners_px=np.asarray(pixels, np.float64), T_camera_tag=np.asarray(B)
            )
        )
    return draw(gray, records, camera, f"{sensor} should see this")
