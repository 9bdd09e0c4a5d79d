"""The tree of frames of a log, as tf has it: chains of static and moving transforms, composed at given stamps."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from rwhec_factors import se3

from gtsam_rwhec.errors import TransformError
from gtsam_rwhec.logs.records import Array, PoseRecord

Stamps: TypeAlias = NDArray[np.int64]


@dataclass
class _Link:
    """T_parent_child over time. A static link has one transform and no stamps."""

    parent: str
    child: str
    topic: str
    is_static: bool
    stamps_ns: list[int] = field(default_factory=list)
    T: list[Array] = field(default_factory=list)
    sorted: tuple[Stamps, Array] | None = None

    def by_stamp(self) -> tuple[Stamps, Array]:
        """Strictly increasing stamps and their transforms. Of several transforms with one stamp, the last counts."""
        if self.sorted is None:
            stamps = np.array(self.stamps_ns, dtype=np.int64)
            order = np.argsort(stamps, kind="stable")
            last = np.append(np.diff(stamps[order]) != 0, True)
            self.sorted = stamps[order][last], np.stack(self.T)[order][last]
        return self.sorted


class TfBuffer:
    """Transforms of a log. `at` gives T_a_b of any two frames that a chain joins."""

    def __init__(self, records: Iterable[object] = ()) -> None:
        self._links: dict[str, _Link] = {}
        for record in records:
            if isinstance(record, PoseRecord) and record.child:
                self.add(record)

    def add(self, record: PoseRecord) -> None:
        """Take a transform. It is static if its topic is ``tf_static``.

        Raises
        ------
        TransformError
            It has no child frame, a frame is its own parent, has two parents, or is both static and moving.
        """
        parent, child = record.parent, record.child
        if not child or not parent:
            raise TransformError(
                f"topic {record.topic}: a pose of {child or 'no frame'} in {parent or 'no frame'} is not a transform "
                "between two named frames"
            )
        if parent == child:
            raise TransformError(f"topic {record.topic}: frame {child} is its own parent")
        link = self._links.get(child)
        if link is None:
            link = self._links[child] = _Link(parent, child, record.topic, record.is_static)
        if link.parent != parent:
            raise TransformError(
                f"frame {child} has two parents, {link.parent} (topic {link.topic}) and {parent} (topic "
                f"{record.topic}); leave one of them out"
            )
        if link.is_static != record.is_static:
            raise TransformError(
                f"T_{parent}_{child} is said to be static and moving (topics {link.topic} and {record.topic}); "
                "leave one of them out"
            )
        if link.is_static:
            link.T = [record.T.copy()]
        else:
            link.stamps_ns.append(record.stamp_ns)
            link.T.append(record.T)
            link.sorted = None

    def moving_links(self) -> dict[str, tuple[Stamps, Array]]:
        """The stamps (N,), increasing, and transforms (N, 4, 4) of each moving link, by its child."""
        return {child: link.by_stamp() for child, link in self._links.items() if not link.is_static}

    def frames(self) -> tuple[str, ...]:
        """Every frame, by name."""
        return tuple(sorted(set(self._links) | {link.parent for link in self._links.values()}))

    def chain(self, parent: str, child: str) -> tuple[str, ...]:
        """The frames on the way from `parent` to `child`, both included.

        Raises
        ------
        TransformError
            A frame is unknown, a link is missing, or there is a loop. The message has the chains as far as they go.
        """
        up_from_parent, up_from_child = self._up(parent), self._up(child)
        common = next((frame for frame in up_from_parent if frame in set(up_from_child)), None)
        if common is None:
            raise TransformError(
                f"no chain of transforms from {parent} to {child}: {_arrows(up_from_parent)} ends there, and "
                f"{_arrows(up_from_child)} does; a link between the two chains is missing"
            )
        down = up_from_child[: up_from_child.index(common)]
        return (*up_from_parent[: up_from_parent.index(common) + 1], *reversed(down))

    def is_above(self, frame: str, other: str) -> bool:
        """Whether `frame` is on the way from `other` up to its root; errors as in `chain`."""
        return frame in self._up(other)

    def stamps(self, parent: str, child: str) -> Stamps:
        """Every stamp at which a moving link of the chain has a transform, (N,) increasing; errors as in `chain`."""
        moving = [link.by_stamp()[0] for link, _ in self._links_of(parent, child) if not link.is_static]
        return np.unique(np.concatenate(moving)) if moving else np.zeros(0, dtype=np.int64)

    def stamps_as_logged(self, parent: str, child: str) -> dict[str, Stamps]:
        """The stamps of each moving link, by its child, in the order in which they were added; errors as in `chain`."""
        links = [link for link, _ in self._links_of(parent, child) if not link.is_static]
        return {link.child: np.array(link.stamps_ns, dtype=np.int64) for link in links}

    def at(self, parent: str, child: str, stamps_ns: Stamps) -> tuple[Array, Array]:
        """T_parent_child at stamps (M,), for any two frames that a chain joins, in either direction; errors as in
        `chain`.

        Returns
        -------
        T : (M, 4, 4)
            Each moving link is interpolated on SE(3) between its neighbours in time, T_i Expmap(tau Log(T_i^-1 T_i+1)).
        gap_s : (M,)
            The longest time between two such neighbours. It is 0 where each link is static or has a transform at the
            stamp, and infinite where a link has no transform before or after (T then has the nearest).
        """
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        T = np.broadcast_to(np.eye(4), (len(stamps_ns), 4, 4))
        gap_s = np.zeros(len(stamps_ns))
        for link, is_down in self._links_of(parent, child):
            T_link, gap_link = _at(link, stamps_ns)
            T = T @ (T_link if is_down else se3.inverse(T_link))
            gap_s = np.maximum(gap_s, gap_link)
        return np.array(T), gap_s

    def _links_of(self, parent: str, child: str) -> list[tuple[_Link, bool]]:
        """The links of the chain. Each comes with whether the chain goes from the link's parent to its child."""
        steps = list(itertools.pairwise(self.chain(parent, child)))
        down = [b in self._links and self._links[b].parent == a for a, b in steps]
        return [(self._links[b if is_down else a], is_down) for (a, b), is_down in zip(steps, down, strict=True)]

    def _up(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root."""
        if frame not in self._links and all(link.parent != frame for link in self._links.values()):
            raise TransformError(f"no frame {frame}; there are: {', '.join(self.frames()) or 'none'}")
        chain = [frame]
        while chain[-1] in self._links:
            parent = self._links[chain[-1]].parent
            if parent in chain:
                raise TransformError(f"the transforms go round in a loop: {_arrows([*chain, parent])}")
            chain.append(parent)
        return chain


def _at(link: _Link, stamps_ns: Stamps) -> tuple[Array, Array]:
    count = len(stamps_ns)
    if link.is_static:
        return np.broadcast_to(link.T[0], (count, 4, 4)), np.zeros(count)
    stamps, T = link.by_stamp()
    after = np.clip(np.searchsorted(stamps, stamps_ns), 0, len(stamps) - 1)
    met = stamps[after] == stamps_ns
    outside = (stamps_ns < stamps[0]) | (stamps_ns > stamps[-1])
    between = ~met & ~outside
    poses, gap_s = T[after], np.where(outside, np.inf, 0.0)
    late, early = after[between], after[between] - 1
    gap_ns = stamps[late] - stamps[early]
    share = (stamps_ns[between] - stamps[early]) / gap_ns
    step = se3.logmap(se3.inverse(T[early]) @ T[late])
    poses[between] = T[early] @ se3.expmap(share[:, None] * step)
    gap_s[between] = gap_ns * 1e-9
    return poses, gap_s


def _arrows(frames: list[str]) -> str:
    return " -> ".join(frames)
