"""Find boards whose tags are not where the rig file has them, or of which a part is never seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.shape_evidence import (
    LEAST_IMAGES,
    BoardView,
    Key,
    ShapeEvidence,
    evidence_of_shape,
    never_seen,
)
from gtsam_rwhec.cameras.targets import AprilGrid, Bundle, Charuco, TagGrid, Target
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.run_log import seen_corners


def doubted_shapes(log: Log, rig: Rig, cameras: Mapping[str, Camera]) -> tuple[Finding, ...]:
    """Findings where the corners in a log contradict the shape of a board of tags in the rig file."""
    boards = {
        target.name: target for target in rig.target_list if isinstance(target, Bundle | AprilGrid | TagGrid | Charuco)
    }
    findings = []
    for sensor, camera in cameras.items():
        if not boards or sensor not in rig.sensors:
            continue
        views: dict[str, list[BoardView]] = {name: [] for name in boards}
        for seen in seen_corners(log, sensor, boards):
            views[seen.target].append(BoardView(seen.indices, seen.corners_px, seen.T))
        for name, board in boards.items():
            findings += _of_board(board, sensor, camera, views[name], rig)
    return tuple(findings)


def continued_boards(strangers: Mapping[str, int], rig: Rig) -> tuple[Finding, ...]:
    """ChArUco boards whose ids go on in tags that the rig file does not name: the printed board may have more rows.

    `strangers` has how often each such tag was seen, by family and id ("aruco_5x5_100 14").
    """
    findings = []
    for board in rig.target_list:
        if not isinstance(board, Charuco):
            continue
        more = 0
        while strangers.get(f"{board.family} {board.ids[-1] + 1 + more}", 0) >= LEAST_IMAGES:
            more += 1
        if not more:
            continue
        first, last = board.ids[-1] + 1, board.ids[-1] + more
        seen = f"markers {first} to {last}" if more > 1 else f"marker {first}"
        rows = -(-2 * (len(board.ids) + more) // board.columns)
        squares = f"write squares: [{board.columns}, {max(rows, board.rows + 1)}]"
        words = (
            f"{LEAST_IMAGES} images or more show {seen} of {board.family}, which continue the ids of {board.name} "
            f"({rig.source.place(('targets', board.name))}): if they are printed on it, it has more rows, and its "
            f"middle is elsewhere ({squares}); if they are not, name them as a target of their own"
        )
        findings.append(Finding(Ground.SHAPE_UNCERTAIN, words))
    return tuple(findings)


def hypotheses_of(board: Target) -> dict[Key, Array]:
    """Derivatives (n, 3, q) of a board's corners (n, 3) by each hypothesis' q numbers (metres, radians, shares).

    A hypothesis is the "gap" of a grid, or "place", "turn" or "size" of a bundle's tag, with the tag's number.
    """
    corners = board.corners()
    n = len(corners)
    tags = corners.reshape(-1, 4, 3) if n % 4 == 0 else np.zeros((0, 4, 3))
    if isinstance(board, AprilGrid | TagGrid):
        pitch = board.tag_m + _gap_m(board)
        steps = np.repeat(tags.mean(axis=1), 4, axis=0) / pitch
        return {("gap", 0): steps[..., None]} if len(tags) > 1 else {}
    made: dict[Key, Array] = {}
    if isinstance(board, Bundle) and len(tags) > 1:
        for k, tag in enumerate(tags):
            from_middle = tag - tag.mean(axis=0)
            normal = np.cross(tag[1] - tag[0], tag[0] - tag[3])
            normal /= np.linalg.norm(normal)
            of_tag = {
                "place": np.broadcast_to(np.eye(3), (4, 3, 3)),
                "turn": np.cross(normal, from_middle)[..., None],
                "size": from_middle[..., None],
            }
            for what, G in of_tag.items():
                made[what, k] = np.zeros((n, 3, G.shape[2]))
                made[what, k][4 * k : 4 * k + 4] = G
    return made


def _gap_m(board: AprilGrid | TagGrid) -> float:
    return board.gap_m if isinstance(board, TagGrid) else board.spacing * board.tag_m


def _of_board(board: Target, sensor: str, camera: Camera, views: Sequence[BoardView], rig: Rig) -> list[Finding]:
    place = rig.source.place(("targets", board.name))
    findings = []
    found = evidence_of_shape(camera, board.corners(), hypotheses_of(board), views)
    if found is not None and found.contradicts:
        words = (
            f"{_off(board, found)} ({place}): the corners that {sensor} saw in {found.views} images fit with "
            f"{found.fitted_px:.2f} px rms then, and with {found.stated_px:.2f} px as stated"
        )
        findings.append(Finding(Ground.SHAPE_DOUBTED if found.is_far_off else Ground.SHAPE_UNCERTAIN, words))
    unseen = never_seen(board, camera, views)
    if unseen:
        words = (
            f"{sensor} never saw {unseen} of {board.name} ({place}), though {LEAST_IMAGES} images or more have the "
            "place where the rig file puts it, beside what was seen: it is not there, is covered, or is stated wrongly"
        )
        findings.append(Finding(Ground.SHAPE_UNCERTAIN, words))
    return findings


def _off(board: Target, found: ShapeEvidence) -> str:
    """The message about what is wrong with the board, and by how much."""
    what, k = found.key
    value, sigma = float(found.theta[0]), float(found.sigma[0])
    if isinstance(board, TagGrid):
        seen, give = board.gap_m + value, 2.0 * sigma
        return f"the images show gap_m {seen:.5f} (to {give:.5f}) on {board.name}, and not {board.gap_m:g}"
    if isinstance(board, AprilGrid):
        seen, give = board.spacing + value / board.tag_m, 2.0 * sigma / board.tag_m
        return f"the images show spacing {seen:.4f} (to {give:.4f}) on {board.name}, and not {board.spacing:g}"
    assert isinstance(board, Bundle)
    tag = f"tag {board.ids[k]} of {board.name}"
    if what == "turn":
        return f"{tag} is turned by {np.degrees(value):+.1f}° about its normal from how the rig file has it"
    if what == "size":
        side = 1e3 * board.tags[k].size_m
        return f"{tag} has a side of {side * (1.0 + value):.2f} mm, by the other tags, and not {side:g} mm"
    x, y, z = (1e3 * found.theta).tolist()
    off = 1e3 * float(np.linalg.norm(found.theta))
    beside = f" relative to tag {board.ids[1 - k]}" if len(board.ids) == 2 else ""
    return (
        f"{tag} is {off:.1f} mm from where the rig file has it{beside} (x {x:+.1f}, y {y:+.1f}, z {z:+.1f} mm in the "
        "board's frame)"
    )
