"""What a log's corners contradict in the rig file: intrinsics, and boards with tags elsewhere or never seen."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_evidence import LEAST_CORNERS, IntrinsicsEvidence, View, evidence_of_intrinsics
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
from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.run_log import detections_topic, records_of

#: If all ratios of fitted to stated numbers differ from 0.5, or all from 2, by at most this share, the stated numbers
#: are for another resolution.
RESOLUTION_SHARE = 0.1


def _views(log: Log, sensor: str, targets: Collection[str]) -> dict[str, list[BoardView]]:
    """The corners of a sensor's detections of some targets that were not rejected, and have corners and a pose."""
    views: dict[str, list[BoardView]] = defaultdict(list)
    for record in records_of(log, [detections_topic(sensor)], DetectionRecord):
        indices, pixels, T = record.corner_indices, record.corners_px, record.T_camera_tag
        if record.reason or record.id not in targets or indices is None or pixels is None or T is None:
            continue
        views[record.id].append(BoardView(np.array(indices), pixels, T))
    return views


def doubted_intrinsics(log: Log, rig: Rig, cameras: Mapping[str, Camera]) -> dict[str, IntrinsicsEvidence]:
    """Evidence of a log's corners against stated intrinsics, by sensor, for those that the corners contradict.

    Sensors that state no intrinsics, and those whose targets have few corners (single tags), are not judged.
    """
    corners = {target.name: target.corners() for target in rig.target_list}
    boards = {name: points for name, points in corners.items() if len(points) >= LEAST_CORNERS}
    doubted = {}
    for sensor, camera in cameras.items():
        if not boards or sensor not in rig.sensors or rig.stated_of(sensor) == "unknown":
            continue
        views = _views(log, sensor, boards)
        of_planes = [View(boards[name][s.indices], s.corners_px, s.T) for name, seen in views.items() for s in seen]
        found = evidence_of_intrinsics(camera, of_planes)
        if found is not None and found.contradicts:
            doubted[sensor] = found
    return doubted


def finding_against(sensor: str, found: IntrinsicsEvidence, rig: Rig, estimated: Camera | None = None) -> Finding:
    """The finding that corners contradict the stated intrinsics. `estimated` are those used in their place, if any."""

    def numbers(camera: Camera) -> str:
        K = np.rint(camera.K).astype(int)
        words = f"fx, fy = {K[0, 0]}, {K[1, 1]} and cx, cy = {K[0, 2]}, {K[1, 2]}"
        if len(found.sigma) == 4 or not camera.D.any():
            return words
        k1, k2 = np.round(np.pad(camera.D, (0, 2))[:2], 3) + 0.0
        return f"{words}, k1, k2 = {k1:g}, {k2:g}"

    words = (
        f"the intrinsics of {sensor} ({rig.source.place(('sensors', sensor, 'intrinsics'))}) do not fit its corners: "
        f"{numbers(found.stated)}, as stated, leave {found.stated_px:.2f} px rms in {found.views} images, and "
    )
    if estimated is not None:
        words += f"{numbers(estimated)}, which the images alone tell, are used"
        return Finding(Ground.INTRINSICS_ESTIMATED, words + _of_another_resolution(found.stated, estimated))
    give_or_take = f"standard deviations {found.sigma[:2].max():.2g} and {found.sigma[2:4].max():.2g} px"
    words += f"{numbers(found.fitted)} would leave {found.fitted_px:.2f} px ({give_or_take})"
    words += _of_another_resolution(found.stated, found.fitted)
    if (shared := rig.sensors[sensor].shared) is not None:
        words += f"; they are those of {shared} (shared), and {sensor} is another camera: give it its own"
    return Finding(Ground.INTRINSICS_DOUBTED if found.is_far_off else Ground.INTRINSICS_UNCERTAIN, words)


def _of_another_resolution(stated: Camera, right: Camera) -> str:
    """A clause of the message if the stated intrinsics are of images of half or double the resolution; else empty."""
    at = ([0, 1, 0, 1], [0, 1, 2, 2])
    ratio = right.K[at] / stated.K[at]
    for times, words in ((2.0, "half"), (0.5, "double")):
        if np.abs(ratio / times - 1.0).max() < RESOLUTION_SHARE:
            return f"; the stated ones look like those of images of {words} the resolution"
    return ""


def doubted_shapes(log: Log, rig: Rig, cameras: Mapping[str, Camera]) -> tuple[Finding, ...]:
    """Findings where the corners in a log contradict the shape of a board of tags in the rig file."""
    boards = {t.name: t for t in rig.target_list if isinstance(t, Bundle | AprilGrid | TagGrid | Charuco)}
    findings: list[Finding] = []
    for sensor, camera in cameras.items():
        if boards and sensor in rig.sensors:
            views = _views(log, sensor, boards)
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
        gap_m = board.gap_m if isinstance(board, TagGrid) else board.spacing * board.tag_m
        steps = np.repeat(tags.mean(axis=1), 4, axis=0) / (board.tag_m + gap_m)
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


def _of_board(board: Target, sensor: str, camera: Camera, views: Sequence[BoardView], rig: Rig) -> Iterator[Finding]:
    place = rig.source.place(("targets", board.name))
    found = evidence_of_shape(camera, board.corners(), hypotheses_of(board), views)
    if found is not None and found.contradicts:
        words = (
            f"{_off(board, found)} ({place}): the corners that {sensor} saw in {found.views} images fit with "
            f"{found.fitted_px:.2f} px rms then, and with {found.stated_px:.2f} px as stated"
        )
        yield Finding(Ground.SHAPE_DOUBTED if found.is_far_off else Ground.SHAPE_UNCERTAIN, words)
    unseen = never_seen(board, camera, views)
    if unseen:
        words = (
            f"{sensor} never saw {unseen} of {board.name} ({place}), though {LEAST_IMAGES} images or more have the "
            "place where the rig file puts it, beside what was seen: it is not there, is covered, or is stated wrongly"
        )
        yield Finding(Ground.SHAPE_UNCERTAIN, words)


def _off(board: Target, found: ShapeEvidence) -> str:
    """The message about what is wrong with the board, and by how much."""
    what, k = found.key
    value, sigma = float(found.theta[0]), float(found.sigma[0])
    if isinstance(board, AprilGrid | TagGrid):
        key, stated, unit_m, digits = (
            ("gap_m", board.gap_m, 1.0, 5) if isinstance(board, TagGrid) else ("spacing", board.spacing, board.tag_m, 4)
        )
        seen, give = stated + value / unit_m, 2.0 * sigma / unit_m
        return f"the images show {key} {seen:.{digits}f} (to {give:.{digits}f}) on {board.name}, and not {stated:g}"
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
