"""The step of variance factors where rotations and translations are correlated."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.fitting.variance_components import _step, _Sums


def test_a_sum_below_zero_is_a_step_down_and_no_end() -> None:
    """Of a bust's nine clouds the translations' factor became 1e-12 at once, and no measurement was left."""
    sums = _Sums(np.array([60.0, -4.0]), np.array([20.0, 20.0]), np.diag([10.0, 10.0]))
    assert _step("all", sums, 1.0) == pytest.approx([3.0, 0.5])
