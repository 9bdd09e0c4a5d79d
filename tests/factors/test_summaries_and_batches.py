"""One factor for all measurements of a pair, against single factors of the same measurements."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import D, S, X, Y
from numeric_jacobians import check_jacobians, graph_of, values_of
from rwhec_factors import (
    EdgeSummary,
    edge_summary_factor,
    hand_eye_factor,
    hand_eye_summary_factor,
    robot_world_hand_eye_batch_factor,
    robot_world_hand_eye_factor,
    se3,
)

SIGMA_R, SIGMA_T = 0.1, 0.3
SIGMAS = np.repeat([SIGMA_R, SIGMA_T], 3)
NOISE = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
KAPPA = 0.5 / SIGMA_R**2


def measurements(count: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(count)
    A, B = (se3.expmap(size * generator.standard_normal((count, 6))) for _ in range(2))
    return A, B, generator.standard_normal((count, 6))


def point(seed: int, size: float = 1.0, scale: float = 0.7) -> gtsam.Values:
    generator = np.random.default_rng(seed)
    x, y = (gtsam.Pose3.Expmap(size * generator.standard_normal(6)) for _ in range(2))
    return values_of({X(0): x, Y(0): y, S(0): scale, D(0): 0.05})


def assert_same(one: gtsam.NonlinearFactorGraph, other: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    """Cost, gradient and Gauss-Newton Hessian, 1e-9 relative."""
    assert one.error(values) == pytest.approx(other.error(values), rel=1e-9)
    ordering = gtsam.Ordering()
    for key in (X(0), Y(0), S(0), D(0)):
        if other.keys().count(key):
            ordering.push_back(key)
    (H, g), (H_other, g_other) = (graph.linearize(values).hessian(ordering) for graph in (one, other))
    assert np.abs(H - H_other).max() <= 1e-9 * np.abs(H_other).max()
    assert np.abs(g - g_other).max() <= 1e-9 * np.abs(g_other).max()


def singles(A: np.ndarray, B: np.ndarray, scaled: bool, **options: object) -> gtsam.NonlinearFactorGraph:
    options["scale_key"] = S(0) if scaled else None
    poses = [(gtsam.Pose3(a), gtsam.Pose3(b)) for a, b in zip(A, B, strict=True)]
    return graph_of(*(robot_world_hand_eye_factor(X(0), Y(0), a, b, NOISE, **options) for a, b in poses))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("count", [1, 40])
def test_summary_is_all_its_measurements(seed: int, scaled: bool, count: int) -> None:
    A, B, _ = measurements(count)
    origins = {"target_origin": [3.0, -2.0, 1.0], "sensor_origin": [0.5, 4.0, -1.0]}
    summary = EdgeSummary.of(A, B, SIGMA_T, KAPPA, **origins)
    factor = edge_summary_factor(X(0), Y(0), summary, scale_key=S(0) if scaled else None)
    assert factor.dim() <= 25
    assert_same(graph_of(factor), singles(A, B, scaled, residual="chordal"), point(seed))


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_summary_jacobians_are_the_numeric_ones(scaled: bool, size: float) -> None:
    A, B, _ = measurements(30, size)
    summary = EdgeSummary.of(A, B, SIGMA_T, KAPPA, target_origin=[1.0, 2.0, 3.0])
    factor = edge_summary_factor(X(0), Y(0), summary, scale_key=S(0) if scaled else None)
    check_jacobians(factor, point(1, size), np.ones(factor.dim()), atol=1e-6)


@pytest.mark.parametrize("scaled", [False, True])
def test_hand_eye_summary_is_all_its_motions(scaled: bool) -> None:
    A, B, _ = measurements(25)
    key = S(0) if scaled else None
    summary = EdgeSummary.of(A, B, SIGMA_T, KAPPA, target_origin=[1.0, 2.0, 3.0])
    factor = hand_eye_summary_factor(Y(0), summary, scale_key=key)
    others = graph_of(
        *(
            hand_eye_factor(Y(0), gtsam.Pose3(a), gtsam.Pose3(b), NOISE, scale_key=key, residual="chordal")
            for a, b in zip(A, B, strict=True)
        )
    )
    assert_same(graph_of(factor), others, point(4))


def test_summaries_add_up_about_whichever_origin() -> None:
    A, B, _ = measurements(30)
    whole = EdgeSummary.of(A, B, SIGMA_T, KAPPA)
    first = EdgeSummary.of(A[:10], B[:10], SIGMA_T, KAPPA, target_origin=[5.0, 0.0, -3.0])
    both = first + EdgeSummary.of(A[10:], B[10:], SIGMA_T, KAPPA, sensor_origin=[0.0, 7.0, 0.0])
    assert both.count == 30
    factors = (edge_summary_factor(X(0), Y(0), summary) for summary in (both, whole))
    assert_same(*(graph_of(factor) for factor in factors), point(5))


def test_summary_far_from_the_world_origin_keeps_its_digits() -> None:
    A, B, _ = measurements(40)
    near = EdgeSummary.of(A, B, SIGMA_T, KAPPA)
    far = np.array([1e5, -1e5, 1e4])  # the sensor's carrier's frame moved away
    A_far = A.copy()
    A_far[:, :3, 3] += far
    moved = EdgeSummary.of(A_far, B, SIGMA_T, KAPPA, sensor_origin=far)
    values = point(6)
    values_far = gtsam.Values(values)
    y = values.atPose3(Y(0))
    values_far.update(Y(0), gtsam.Pose3(y.rotation(), y.translation() + far))
    cost = edge_summary_factor(X(0), Y(0), near).error(values)
    assert edge_summary_factor(X(0), Y(0), moved).error(values_far) == pytest.approx(cost, rel=1e-8)


@pytest.mark.parametrize("scaled", [False, True])
def test_batch_is_all_its_measurements(scaled: bool) -> None:
    A, B, _ = measurements(20, 0.6)
    key = S(0) if scaled else None
    factor = robot_world_hand_eye_batch_factor(X(0), Y(0), A, B, np.diag(1.0 / SIGMAS), scale_key=key)
    assert_same(graph_of(factor), singles(A, B, scaled), point(7, 0.6))


def test_batch_of_one_frame_is_ax_xb() -> None:
    A, B, _ = measurements(10, 0.6)
    factor = robot_world_hand_eye_batch_factor(Y(0), Y(0), A, B, np.diag(1.0 / SIGMAS))
    others = (hand_eye_factor(Y(0), gtsam.Pose3(a), gtsam.Pose3(b), NOISE) for a, b in zip(A, B, strict=True))
    assert_same(graph_of(factor), graph_of(*others), point(9, 0.6))


def test_bad_input_of_summaries_and_batches_is_refused() -> None:
    A, B, twists = measurements(5)
    with pytest.raises(ValueError, match=r"A has shape \(5, 4, 4\) and B \(4, 4, 4\)"):
        EdgeSummary.of(A, B[:4], 1.0, 1.0)
    with pytest.raises(ValueError, match=r"sigma is 0\.0; it must be positive"):
        EdgeSummary.of(A, B, 0.0, 1.0)
    with pytest.raises(ValueError, match=r"kappa has shape \(3,\)"):
        EdgeSummary.of(A, B, 1.0, np.ones(3))
    with pytest.raises(ValueError, match="NaN"):
        EdgeSummary.of(A * np.nan, B, 1.0, 1.0)
    summary = EdgeSummary.of(A, B, 1.0, 1.0)
    with pytest.raises(ValueError, match="x0, x0 are not all different"):
        edge_summary_factor(X(0), X(0), summary)
    with pytest.raises(ValueError, match="x0, y0, y0 are not all different"):
        edge_summary_factor(X(0), Y(0), summary, scale_key=Y(0))
    with pytest.raises(TypeError, match=r"give EdgeSummary\.of"):
        edge_summary_factor(X(0), Y(0), summary.form)
    with pytest.raises(ValueError, match="not positive semidefinite"):
        edge_summary_factor(X(0), Y(0), EdgeSummary(-np.eye(25), 1))
    with pytest.raises(ValueError, match=r"A has shape \(5, 4, 4\) and B \(4, 4, 4\)"):
        robot_world_hand_eye_batch_factor(X(0), Y(0), A, B[:4], np.eye(6))
    with pytest.raises(ValueError, match=r"shape \(3, 3\)"):
        robot_world_hand_eye_batch_factor(X(0), Y(0), A, B, np.eye(3))
    with pytest.raises(ValueError, match="needs both"):
        robot_world_hand_eye_batch_factor(X(0), Y(0), A, B, np.eye(6), twists=twists)


@pytest.mark.parametrize("kind", ["summary", "batch"])
def test_missing_and_wrong_variables_are_named(kind: str) -> None:
    A, B, _ = measurements(5)
    if kind == "summary":
        factor = edge_summary_factor(X(0), Y(0), EdgeSummary.of(A, B, 1.0, 1.0), scale_key=S(0))
    else:
        factor = robot_world_hand_eye_batch_factor(X(0), Y(0), A, B, np.eye(6), scale_key=S(0))
    graph = graph_of(factor)
    pose = gtsam.Pose3()
    with pytest.raises(KeyError, match=r"y0 is not in the values; it should be Y = T_sensorcarrier_sensor"):
        graph.error(values_of({X(0): pose, S(0): 1.0}))
    values = values_of({X(0): pose, Y(0): pose})
    values.insert(S(0), gtsam.Rot3())
    with pytest.raises(TypeError, match="s0 should be the scale"):
        graph.linearize(values)


def test_lists_of_poses_are_arrays_of_matrices() -> None:
    generator = np.random.default_rng(0)
    matrices = se3.expmap(generator.standard_normal((4, 6)))
    poses = [gtsam.Pose3(T) for T in matrices]
    one, other = EdgeSummary.of(poses, poses, 0.1, 3.0), EdgeSummary.of(matrices, matrices, 0.1, 3.0)
    np.testing.assert_allclose(one.form, other.form, atol=1e-12)
    robot_world_hand_eye_batch_factor(1, 2, poses, poses, np.eye(6))


@pytest.mark.parametrize(
    ("root", "error", "words"),
    [
        (np.zeros((6, 6)), ValueError, "singular"),
        (gtsam.noiseModel.Unit.Create(6), TypeError, "is a noise model; give a"),
    ],
)
def test_weights_that_are_not_valid(root: object, error: type[Exception], words: str) -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    with pytest.raises(error, match=words):
        robot_world_hand_eye_batch_factor(1, 2, poses, poses, root)
