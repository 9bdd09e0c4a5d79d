"""One rule: when residuals contradict the weights."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.solver.solution import contradicted_by


@pytest.mark.parametrize(
    ("cost", "degrees_of_freedom", "ratio"),
    [
        (100.0, 200, None),  # what true weights predict
        (190.0, 200, None),  # less than twice that
        (210.0, 200, 2.1),
        (3.0, 2, None),  # three times, but chance makes that once in twenty
        (10.0, 2, 10.0),
        (10.0, 0, None),  # nothing tells
    ],
)
def test_twice_what_is_predicted_and_beyond_chance(cost: float, degrees_of_freedom: int, ratio: float | None) -> None:
    assert contradicted_by(cost, degrees_of_freedom) == (None if ratio is None else pytest.approx(ratio))


def test_true_weights_are_contradicted_less_than_once_in_a_thousand() -> None:
    generator = np.random.default_rng(0)
    for degrees_of_freedom in (1, 3, 10, 100):
        costs = 0.5 * generator.chisquare(degrees_of_freedom, 20_000)
        told = sum(contradicted_by(float(cost), degrees_of_freedom) is not None for cost in costs)
        assert told <= 40
