"""Where a point may be expressed: a carrier, or a frame on one; on the other carrier where the pose A is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam

from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.refined import RefinedPoses

#: The words for a carrier that a problem does not name. Without A, each but one means the carrier of the point's own
#: frame; with A, the other one.
CARRIER_WORDS = {
    "sensor": ("sensorcarrier", "hand", "base", "rig"),
    "target": ("targetcarrier", "base", "hand", "world"),
}
#: Of these words, the one that is more often the other carrier. Without A it says too little.
MORE_OFTEN_THE_OTHER = {"sensor": "base", "target": "hand"}


@dataclass(frozen=True)
class Carriers:
    """The names of the carriers as the problem states them; None where it does not."""

    sensors: str | None = None
    targets: str | None = None

    def of(self, side: str) -> str | None:
        """The name of the carrier of "sensor" or "target"."""
        return self.sensors if side == "sensor" else self.targets


@dataclass(frozen=True)
class Side:
    """The frames on one carrier.

    Attributes
    ----------
    kind : "sensor" or "target"
    poses : dict of str to gtsam.Pose3
        On the carrier.
    words : tuple of str
        What the carrier is called.
    """

    kind: str
    poses: Mapping[str, gtsam.Pose3]
    words: tuple[str, ...]


@dataclass(frozen=True)
class Place:
    """Where a point is expressed.

    Attributes
    ----------
    name : str
    frame : gtsam.Pose3 or None
        The pose of the frame on its carrier; None for the carrier itself.
    is_across : bool
        Whether it is on the other carrier than the point's own frame.
    """

    name: str
    frame: gtsam.Pose3 | None
    is_across: bool


def sides_of(refined: RefinedPoses, frame: object, carriers: Carriers, *, has_A: bool) -> tuple[Side, Side]:
    """The carrier of a frame, and the other one. A FrameError where there is no such frame."""
    poses = {"sensor": refined.Y, "target": refined.X}
    own = next((kind for kind, of in poses.items() if isinstance(frame, str) and frame in of), None)
    if own is None:
        raise FrameError(
            f"there is no frame {brief(frame)}; there are the sensors {', '.join(refined.Y) or '(none)'} and the "
            f"targets {', '.join(refined.X) or '(none)'}"
        )

    def side(kind: str, *, all_words: bool) -> Side:
        name = carriers.of(kind)
        known: tuple[str, ...] = CARRIER_WORDS[kind]
        if not has_A:
            known = tuple(word for word in known if word != MORE_OFTEN_THE_OTHER[kind])
        words = (known if all_words else known[:1]) if name is None else (name, known[0])
        return Side(kind, poses[kind], words)

    other = "target" if own == "sensor" else "sensor"
    return side(own, all_words=not has_A), side(other, all_words=has_A)


def place_of(seen_from: object, frame: str, own: Side, other: Side, carriers: Carriers, *, has_A: bool) -> Place:
    """Where a point of ``frame`` is expressed, by the word that a user gave, or None.

    Raises
    ------
    FrameError
        There is no such place, or it is on the other carrier and A is not given.
    OptionError
        A is given, and has no use.
    """
    place = _named(seen_from, frame, own, other, carriers, has_A=has_A)
    is_unclear = isinstance(seen_from, str) and seen_from == MORE_OFTEN_THE_OTHER[own.kind]
    if place is None and is_unclear and not has_A and carriers.of(own.kind) is None:
        raise FrameError(
            f"it is not clear which carrier {seen_from!r} is, as the problem does not name its carriers; name them: "
            f'rw.Problem(sensor_carrier="hand", target_carrier="base"), or say seen_from="{own.words[0]}" for the '
            f"carrier of {frame}; for the other carrier, which moves relative to {frame}, give the pose at that moment "
            "too: uncertainty_at(..., A=T_sensorcarrier_targetcarrier)"
        )
    if place is None:
        raise FrameError(
            f"{brief(seen_from)} is no frame in which a point of {frame} can be expressed; there are its carrier "
            f"{_listed(own, frame)}, and with A = T_sensorcarrier_targetcarrier the other carrier "
            f"{_listed(other, frame)}"
        )
    if place.is_across and not has_A:
        raise FrameError(
            f"{place.name} is on the carrier of the {other.kind}s, which moves relative to {frame}; give the pose at "
            "that moment too: uncertainty_at(..., A=T_sensorcarrier_targetcarrier)"
        )
    if has_A and not place.is_across:
        raise OptionError(
            f"A has no use: {place.name} and {frame} are on one carrier; leave A out, or take a frame on the other "
            f"carrier {_listed(other, frame)}"
        )
    return place


def _named(seen_from: object, frame: str, own: Side, other: Side, carriers: Carriers, *, has_A: bool) -> Place | None:
    word = seen_from if isinstance(seen_from, str) else None
    asked = next((side for side in (own, other) if word in side.words), None)
    if seen_from is None:
        asked = other if has_A else own
    if asked is not None:
        standing_in = f"the frame that carries {frame}" if asked is own else f"the frame that carries the {other.kind}s"
        return Place(carriers.of(asked.kind) or standing_in, None, asked is other)
    for side in (own, other):
        if word is not None and word != frame and word in side.poses:
            return Place(word, side.poses[word], side is other)
    return None


def _listed(side: Side, frame: str) -> str:
    others = [name for name in side.poses if name != frame]
    return f"({', '.join(side.words)}){' and ' + ', '.join(others) if others else ''}"
