"""Good measurements of one pair, for tests to spoil."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from rwhec_factors.se3 import inverse

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.simulate.simulated_noise import random_poses

GENERATOR = np.random.default_rng(5)
X_TRUE, Y_TRUE = random_poses(2, 1.0, GENERATOR)
A = random_poses(8, 1.0, GENERATOR)
B = inverse(Y_TRUE) @ A @ X_TRUE
ROWS = np.concatenate([np.tile([1.0, 0.0, 0.0, 0.0], (8, 1)), A[:, :3, 3]], axis=1)
EYE = np.eye(4)


# -- what only the whole problem shows --------------------------------------------------------------


def of_one(count: int, scale: Any = "known") -> rw.Problem:
    problem = rw.Problem(scale)
    problem.add("tag0", "cam0", A[:count], B[:count], 0.01, 100.0)
    return problem


def with_(problem: rw.Problem, *calls: Callable[[rw.Problem], None]) -> rw.Problem:
    for call in calls:
        call(problem)
    return problem


@contextmanager
def says(error: type[Exception], said: str) -> Iterator[None]:
    """An error of the library whose message has all these words, with | between them."""
    with pytest.raises(error) as caught:
        yield
    assert isinstance(caught.value, RwhecError)
    assert [words for words in said.split("|") if words not in str(caught.value)] == []
