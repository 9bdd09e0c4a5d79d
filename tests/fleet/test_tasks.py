"""Tasks and receipts travel between processes."""

from __future__ import annotations

import pickle

from gtsam_rwhec import fleet


def written(key: str) -> fleet.Receipt:
    return fleet.Receipt(key, f"partials/{key}", "00")


def test_they_are_the_same_on_the_other_side() -> None:
    task = fleet.Task("a", written, ("a",), after=("b",))
    again = pickle.loads(pickle.dumps(task))
    assert again == task
    assert pickle.loads(pickle.dumps(again.function(*again.arguments))) == written("a")
