"""Fields that many ROS 2 messages share, read from batches of messages of one shape: headers, lists and poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs.cdr import Batch, Numbers, find
from gtsam_rwhec.logs.checked_poses import gtsam_covariances, transforms
from gtsam_rwhec.logs.records import Array, Record

#: A read message gives its records, or its fault in words.
Read: TypeAlias = Sequence[Record] | str
Decode: TypeAlias = Callable[[Batch, str, list[int]], list[Read]]


@dataclass(frozen=True)
class Pose:
    """Paths of a pose's fields; an empty path means no field. `parts` is the list whose entries have one pose each."""

    pose: str
    covariance: str = ""
    child: str = ""
    parts: str = ""


def stamps_of(batch: Batch, tree: Any) -> list[int]:
    """The stamp of each message's header, nanoseconds."""
    seconds = batch.numbers(tree, "header.stamp.sec").astype(np.int64)
    nanoseconds = batch.numbers(tree, "header.stamp.nanosec").astype(np.int64)
    stamps: list[int] = (seconds * 1_000_000_000 + nanoseconds).tolist()
    return stamps


def frame_of(batch: Batch, tree: Any, path: str = "header.frame_id") -> str:
    """A frame's name. Drivers from before tf2 begin it with a slash, which tf2 does not have."""
    return batch.text(tree, path).removeprefix("/")


def parts_of(batch: Batch, name: str) -> list[Any]:
    """The messages in the list `name` of a message. Without a name, the result is the message itself."""
    value = find(batch.shape.tree, name) if name else [batch.shape.tree]
    if not isinstance(value, list):
        raise MessageError(f"field {name} is not a list of messages")
    return value


def _columns_of_a_pose(batch: Batch, tree: Any, where: Pose) -> list[Numbers]:
    """Where a pose's x, y, z and x, y, z, w stand."""
    pose = find(tree, where.pose)
    position, rotation = ("translation", "rotation") if where.pose == "transform" else ("position", "orientation")
    leaves = [find(find(pose, position), name) for name in "xyz"]
    leaves += [find(find(pose, rotation), name) for name in "xyzw"]
    for leaf in leaves:
        if not isinstance(leaf, Numbers) or leaf.count is not None:
            raise MessageError(f"field {where.pose} has no {position} and {rotation}")
    return leaves


def poses_of(batch: Batch, trees: list[Any], where: Pose) -> tuple[Array, list[Sequence[Array | None]], dict[int, str]]:
    """Transforms (P, N, 4, 4) and covariances of P poses of each of N messages, and the faults of messages."""
    count = len(batch.rows)
    table = np.empty((len(trees), count, 7))
    # A message of its own shape has all its poses read together; of many messages, one pose of all is.
    if count < len(trees):
        offsets = np.array([[leaf.offset for leaf in _columns_of_a_pose(batch, tree, where)] for tree in trees])
        dtype = {leaf.dtype for leaf in _columns_of_a_pose(batch, trees[0], where)}.pop()
        size = np.dtype(dtype).itemsize
        places = offsets[:, :, None] + np.arange(size)
        table[:] = batch.rows[:, places].view(dtype)[..., 0].transpose(1, 0, 2)
    else:
        for i, tree in enumerate(trees):
            for j, leaf in enumerate(_columns_of_a_pose(batch, tree, where)):
                table[i, :, j] = batch.column(leaf)
    rows = table.reshape(-1, 7)
    T, wrong = transforms(rows[:, :3], rows[:, 3:])
    faults: dict[int, str] = {}
    for i, fault in wrong.items():
        faults.setdefault(i % count, fault)
    T = T.reshape(len(trees), count, 4, 4)
    covariances: list[Sequence[Array | None]] = [[None] * count for _ in trees]
    if where.covariance:
        for i, tree in enumerate(trees):
            numbers = batch.numbers(tree, where.covariance).astype(np.float64)
            if numbers.shape[1:] != (36,):
                raise MessageError(f"field covariance has {numbers.shape[1:]} numbers in place of 36")
            covariances[i] = gtsam_covariances(T[i], numbers.reshape(-1, 6, 6))
    return T, covariances, faults


def columns_of(batch: Batch, tree: Any, names: Sequence[str]) -> Array:
    """Numbers with these names as (N, len(names))."""
    return np.stack([batch.numbers(tree, name).astype(np.float64) for name in names], axis=1)


def by_message(parts: Sequence[Sequence[Record]], faults: dict[int, str], count: int) -> list[Read]:
    """The records of each message, joined from its parts. If one part has a fault, the whole message has it."""
    of_messages: list[Read] = list(zip(*parts, strict=True)) if parts else [()] * count
    for i, fault in faults.items():
        of_messages[i] = fault
    return of_messages
