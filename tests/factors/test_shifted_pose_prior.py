"""The prior on a carrier's pose with a time offset."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numeric_jacobians import check_jacobians, values_of
from rwhec_factors import shifted_pose_prior_factor

POSE, OFFSET = gtsam.symbol("p", 0), gtsam.symbol("d", 0)
NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]))
TWIST = np.array([0.4, -0.7, 0.2, 0.5, 0.1, -0.3])
numbers = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)


@given(numbers, numbers, st.floats(-0.3, 0.3))
def test_jacobians(measured: np.ndarray, off: np.ndarray, offset_s: float) -> None:
    T = gtsam.Pose3.Expmap(measured)
    factor = shifted_pose_prior_factor(POSE, OFFSET, T, TWIST, NOISE)
    check_jacobians(factor, values_of({POSE: T.retract(0.5 * off), OFFSET: offset_s}), NOISE.sigmas(), atol=1e-6)


def test_the_error_is_zero_at_the_shifted_pose() -> None:
    T = gtsam.Pose3.Expmap(np.array([0.3, 0.1, -0.2, 1.0, 2.0, 3.0]))
    then = T.compose(gtsam.Pose3.Expmap(0.05 * TWIST))
    factor = shifted_pose_prior_factor(POSE, OFFSET, T, TWIST, NOISE)
    assert factor.error(values_of({POSE: then, OFFSET: 0.05})) == pytest.approx(0.0, abs=1e-18)
    # Half of the noise's first component is 1/8, along the first axis only.
    off = then.retract(np.array([0.005, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert factor.error(values_of({POSE: off, OFFSET: 0.05})) == pytest.approx(0.125)


def test_bad_arguments() -> None:
    T = gtsam.Pose3()
    with pytest.raises(ValueError, match="twist"):
        shifted_pose_prior_factor(POSE, OFFSET, T, np.full(6, np.nan), NOISE)
    with pytest.raises(ValueError, match="6"):
        shifted_pose_prior_factor(POSE, OFFSET, T, TWIST, gtsam.noiseModel.Isotropic.Sigma(3, 1.0))
    with pytest.raises(TypeError, match="Pose3"):
        shifted_pose_prior_factor(POSE, OFFSET, np.eye(4), TWIST, NOISE)  # type: ignore[arg-type]
