"""The pairs of moving frames in a log that could be the carriers of the sensors and of the targets."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from gtsam_rwhec.first_rig.log_contents import PoseTopic
from gtsam_rwhec.first_rig.names import frame_name
from gtsam_rwhec.rig.field_types import is_name
from gtsam_rwhec.rig.sections import PoseSource


@dataclass(frozen=True)
class MovingPair:
    """Two frames that move relative to each other."""

    source: PoseSource  #: where the log has their poses
    words: str  #: the topic, the number of poses, and how far they move
    on_child: int = 0  #: how many of the cameras' frames are fixed to the child in tf
    on_parent: int = 0  #: how many are fixed to the parent


def moving_pairs(poses: Iterable[PoseTopic], camera_frames: Iterable[str]) -> tuple[list[MovingPair], list[str]]:
    """Pairs of frames that could be the carriers, the most likely first; and remarks on pairs that cannot be used.

    Frames of tf that do not move relative to each other are one body. Each moving body that carries no other moving
    body gives a pair. The child is the body's own moving frame; the parent is the frame below the first moving link of
    its chain, such as base for base -> link -> hand.
    """
    poses = list(poses)
    cameras = list(camera_frames)
    pairs, remarks = _of_tf([p for p in poses if p.is_tf and p.child and p.child != p.parent], cameras)
    by_topic: dict[str, list[PoseTopic]] = {}
    for series in poses:
        if not series.is_tf:
            by_topic.setdefault(series.topic, []).append(series)
    pairs += [_of_topic(series) for (series, *others) in by_topic.values() if series.is_moving and not others]
    # The sort is stable: pairs of tf stay before topics, and pairs with more poses before others.
    pairs.sort(key=lambda pair: (pair.on_child, pair.on_parent), reverse=True)
    return pairs, remarks


def _of_tf(series: list[PoseTopic], cameras: list[str]) -> tuple[list[MovingPair], list[str]]:
    links: dict[str, PoseTopic] = {}
    for link in series:
        links.setdefault(link.child, link)
    moving = {child for child, link in links.items() if link.is_moving}

    def up(frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in links and links[chain[-1]].parent not in chain:
            chain.append(links[chain[-1]].parent)
        return chain

    def body(frame: str) -> str:
        """The frame that stands for the body of a frame: its nearest moving frame, or its root."""
        chain = up(frame)
        return next((f for f in chain if f in moving), chain[-1])

    known = {frame for child in links for frame in up(child)}
    bodies = [body(camera) for camera in cameras if camera in known]
    carrying_others = {frame for child in moving for frame in up(child)[1:]}
    pairs, remarks = [], []
    for child in sorted(
        moving - carrying_others, key=lambda child: (-links[child].count, *(-x for x in links[child].motion()))
    ):
        top = [frame for frame in up(child) if frame in moving][-1]
        parent = links[top].parent
        bad = [frame for frame in (parent, child) if not is_name(frame)]
        if bad:
            remarks.append(f"tf {parent} to {child} moves, but a rig file cannot name {', '.join(map(repr, bad))}")
            continue
        words = _words(links[child], "/tf" if child == top else f"chain of {len(up(child)) - 1} links")
        pairs.append(MovingPair(PoseSource(tf=(parent, child)), words, bodies.count(child), bodies.count(body(parent))))
    return pairs, remarks


def _of_topic(series: PoseTopic) -> MovingPair:
    child = frame_name(series.child) or frame_name(series.topic) or "moving"
    parent = frame_name(series.parent) or "world"
    if parent == child:
        parent = f"{parent}_origin"
    return MovingPair(PoseSource(topic=series.topic, parent=parent, child=child), _words(series, series.topic))


def _words(series: PoseTopic, where: str) -> str:
    moved, turned = series.motion()
    return f"{where}: {series.count} poses, up to {moved:.2f} m and {math.degrees(turned):.0f} degrees"
