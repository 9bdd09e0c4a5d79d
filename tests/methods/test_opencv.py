"""The calls with OpenCV's names: its answers where OpenCV 4 is installed, stored ones everywhere, and properties."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hand_eye_stations import CASES, GOLDEN, METHODS, ROBOT_WORLD, largest_difference, parts, stations
from hypothesis import given, settings
from hypothesis import strategies as st
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec import simulate, solve
from gtsam_rwhec.errors import CountError, OptionError, PoseError, UnderdeterminedError
from gtsam_rwhec.methods import opencv
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms
from gtsam_rwhec.methods.hand_eye import solve_hand_eye
from gtsam_rwhec.methods.motions import motions_of, squared_residuals

OURS = {"dqopt": opencv.CALIB_HAND_EYE_DQOPT, "certified": opencv.CALIB_HAND_EYE_CERTIFIED}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_hand_eye_gives_the_stored_answers_of_opencv_4(case, method):
    stored = json.loads(GOLDEN.read_text())["cases"][case]
    poses = [np.array(stored[name]) for name in ("gripper2base", "target2cam")]
    answer = opencv.calibrateHandEye(*parts(*poses), method=method)
    expected = [np.array(part) for part in stored["hand_eye"][str(method)]]
    assert [part.shape for part in answer] == [(3, 3), (3, 1)]
    assert largest_difference(answer, expected) < 1e-9


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("method", ROBOT_WORLD.values(), ids=ROBOT_WORLD)
def test_robot_world_gives_the_stored_answers_of_opencv_4(case, method):
    stored = json.loads(GOLDEN.read_text())["cases"][case]
    gripper, seen = (np.array(stored[name]) for name in ("gripper2base", "target2cam"))
    answer = opencv.calibrateRobotWorldHandEye(*parts(seen, np.linalg.inv(gripper)), method=method)
    expected = [np.array(part) for part in stored["robot_world"][str(method)]]
    assert [part.shape for part in answer] == [(3, 3), (3, 1), (3, 3), (3, 1)]
    assert largest_difference(answer, expected) < 1e-9


@pytest.mark.parametrize("method", (METHODS | OURS).values(), ids=METHODS | OURS)
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(6, 300))
def test_exact_poses_give_the_truth(method, seed, count):
    gripper, seen, camera, _ = stations(count, seed, 0.0, 0.0)
    R, t = opencv.calibrateHandEye(*parts(gripper, seen), method=method)
    np.testing.assert_allclose(R, camera[:3, :3], atol=1e-8)
    np.testing.assert_allclose(t[:, 0], camera[:3, 3], atol=1e-8)


@pytest.mark.parametrize("method", [*ROBOT_WORLD.values(), 101], ids=[*ROBOT_WORLD, "certified"])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(6, 300))
def test_exact_poses_give_both_truths(method, seed, count):
    gripper, seen, camera, target = stations(count, seed, 0.0, 0.0)
    answer = opencv.calibrateRobotWorldHandEye(*parts(seen, np.linalg.inv(gripper)), method=method)
    base, hand = np.linalg.inv(target), np.linalg.inv(camera)
    for got, expected in zip(answer, (base[:3, :3], base[:3, 3:], hand[:3, :3], hand[:3, 3:]), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-8)


@pytest.mark.parametrize("method", (METHODS | OURS).values(), ids=METHODS | OURS)
def test_the_answer_does_not_depend_on_where_the_base_and_the_target_are(method):
    gripper, seen, _, _ = stations(15, 4)
    rng = np.random.default_rng(0)
    base, target = pose(Rotation.random(2, random_state=rng).as_matrix(), 1e3 * rng.normal(size=(2, 3)))
    if method == opencv.CALIB_HAND_EYE_CERTIFIED:  # errors of the measured rotation would move another origin
        target[:3, 3] = 0.0
    first = opencv.calibrateHandEye(*parts(gripper, seen), method=method)
    moved = opencv.calibrateHandEye(*parts(base @ gripper, seen @ target), method=method)
    assert largest_difference(first, moved) < 1e-7


def test_the_certified_answer_is_that_of_solve_with_the_true_noise():
    errors = {"certified": [], "solve": [], "park": []}
    for seed in range(20):
        simulated = simulate.general(1, 1, seed=seed, number_of_measurements=50, noise=simulate.Noise(0.01, 125.0))
        truth = simulated.Y["sensor0"][:3, 3]
        measured = simulated.problem.measurements("target0", "sensor0")
        poses = parts(np.linalg.inv(measured.A), measured.B)
        for name, method in (("certified", opencv.CALIB_HAND_EYE_CERTIFIED), ("park", opencv.CALIB_HAND_EYE_PARK)):
            errors[name].append(np.linalg.norm(opencv.calibrateHandEye(*poses, method=method)[1][:, 0] - truth))
        errors["solve"].append(np.linalg.norm(solve(simulated.problem).Y["sensor0"].translation() - truth))
    assert np.median(errors["certified"]) < 1.2 * np.median(errors["solve"])
    assert np.median(errors["certified"]) < 0.3 * np.median(errors["park"])


@pytest.mark.parametrize("method", (METHODS | OURS).values(), ids=METHODS | OURS)
def test_translations_scale_with_their_unit(method, recwarn):
    gripper, seen, _, _ = stations(15, 5)
    metres = opencv.calibrateHandEye(*parts(gripper, seen), method=method)
    gripper[:, :3, 3] *= 1000.0
    seen[:, :3, 3] *= 1000.0
    millimetres = opencv.calibrateHandEye(*parts(gripper, seen), method=method)
    if method in (opencv.CALIB_HAND_EYE_ANDREFF, opencv.CALIB_HAND_EYE_DANIILIDIS):  # weigh rotation by the unit
        np.testing.assert_allclose(millimetres[0], metres[0], atol=0.02)
    else:
        exact = method not in OURS.values()  # a closed form
        np.testing.assert_allclose(millimetres[0], metres[0], atol=1e-12 if exact else 1e-8)
        np.testing.assert_allclose(millimetres[1], 1000.0 * metres[1], rtol=1e-9, atol=1e-9 if exact else 1e-5)
    assert not recwarn.list


def test_blocks_of_pairs_change_nothing(monkeypatch):
    gripper, seen, _, _ = stations(40, 6, 0.05, 0.02)
    whole = [opencv.calibrateHandEye(*parts(gripper, seen), method=method) for method in METHODS.values()]
    monkeypatch.setattr("gtsam_rwhec.methods.opencv_methods.BLOCK_PAIRS", 100)
    for method, expected in zip(METHODS.values(), whole, strict=True):
        assert largest_difference(opencv.calibrateHandEye(*parts(gripper, seen), method=method), expected) < 1e-12


@pytest.mark.parametrize("shape", [(3,), (3, 1), (1, 3)])
def test_rotation_vectors_of_all_shapes_are_taken(shape):
    gripper, seen, _, _ = stations(8, 7)
    R_G, t_G, R_C, t_C = parts(gripper, seen)
    expected = opencv.calibrateHandEye(R_G, t_G, R_C, t_C)
    vectors = [[Rotation.from_matrix(R).as_rotvec().reshape(shape) for R in rotations] for rotations in (R_G, R_C)]
    columns = [[t.reshape(shape) for t in translations] for translations in (t_G, t_C)]
    answer = opencv.calibrateHandEye(vectors[0], columns[0], np.array(vectors[1]), tuple(columns[1]))
    assert largest_difference(answer, expected) < 1e-12
    mixed = [R_G[0], *vectors[0][1:]]
    assert largest_difference(opencv.calibrateHandEye(mixed, t_G, R_C, t_C), expected) < 1e-12


def test_a_rotation_vector_of_zero_is_the_identity():
    gripper, seen, _, _ = stations(8, 8)
    moved = np.linalg.inv(gripper[0]) @ gripper
    R_G, t_G, R_C, t_C = parts(moved, seen)
    vectors = [Rotation.from_matrix(R).as_rotvec() for R in R_G]
    expected = opencv.calibrateHandEye(R_G, t_G, R_C, t_C, method=1)
    assert largest_difference(opencv.calibrateHandEye(vectors, t_G, R_C, t_C, method=1), expected) < 1e-12


def test_given_arrays_are_filled_where_they_fit():
    gripper, seen, _, _ = stations(8, 9)
    R, t, single = np.zeros((3, 3)), np.zeros((3, 1)), np.zeros((3, 3), np.float32)
    answer = opencv.calibrateHandEye(*parts(gripper, seen), R, t)
    assert answer[0] is R
    assert answer[1] is t
    assert opencv.calibrateHandEye(*parts(gripper, seen), single)[0] is not single
    assert not single.any()


def bad_calls():
    gripper, seen, _, _ = stations(6, 10)
    R_G, t_G, R_C, t_C = parts(gripper, seen)
    mirror = np.diag([1.0, 1.0, -1.0])
    yield "two poses", (R_G[:2], t_G[:2], R_C[:2], t_C[:2]), CountError, "at least 3"
    yield "none", ([], [], [], []), CountError, "R_gripper2base: no poses"
    yield "fewer rotations", (R_G[:5], t_G, R_C, t_C), CountError, "5 rotations and t_gripper2base 6"
    yield "fewer in the camera", (R_G, t_G, R_C[:5], t_C[:5]), CountError, "6 poses and R_target2cam 5"
    yield "matrices 4x4", (list(gripper), t_G, R_C, t_C), PoseError, r"R_gripper2base: shape \(6, 4, 4\)"
    yield "translations of 4", (R_G, [np.zeros(4)] * 6, R_C, t_C), PoseError, r"t_gripper2base: shape \(6, 4\)"
    yield "one of another shape", ([*R_G[:5], np.zeros((2, 2))], t_G, R_C, t_C), PoseError, r"R_gripper2base\[5\]"
    yield "not a number", (R_G, t_G, R_C, [np.full(3, np.nan), *t_C[1:]]), PoseError, "t_target2cam: measurement 0"
    yield "no rotation", ([2.0 * R_G[0], *R_G[1:]], t_G, R_C, t_C), PoseError, "measurement 0 is off by 3"
    yield "left-handed", ([*R_G[:5], R_G[5] @ mirror], t_G, R_C, t_C), PoseError, "measurement 5 is left-handed"
    yield "complex", (np.array(R_G) * 1j, t_G, R_C, t_C), PoseError, "complex"
    yield "words", (["a"] * 6, t_G, R_C, t_C), PoseError, "R_gripper2base"
    yield "one rotation only", ([R_G[0]] * 6, t_G, [R_C[0]] * 6, t_C), UnderdeterminedError, "no motion rotates"
    about_z = list(Rotation.from_rotvec(np.outer(np.arange(6.0), [0, 0, 0.3])).as_matrix())
    yield "one axis", (about_z, t_G, about_z, t_C), UnderdeterminedError, "about one axis"


@pytest.mark.parametrize(("call", "error", "words"), [c[1:] for c in bad_calls()], ids=[c[0] for c in bad_calls()])
@pytest.mark.parametrize("method", [0, 1, 2, 3, 4, 100, 101])
def test_bad_input_is_refused_in_words(call, error, words, method):
    with pytest.raises(error, match=words):
        opencv.calibrateHandEye(*call, method=method)


def test_bad_input_of_the_robot_world_call():
    gripper, seen, _, _ = stations(6, 10)
    poses = parts(seen, np.linalg.inv(gripper))
    with pytest.raises(OptionError, match="CALIB_ROBOT_WORLD_HAND_EYE_LI = 1"):
        opencv.calibrateRobotWorldHandEye(*poses, method=7)
    with pytest.raises(CountError, match="R_world2cam"):
        opencv.calibrateRobotWorldHandEye(*[part[:2] for part in poses])
    about_z = list(Rotation.from_rotvec(np.outer(np.arange(6.0), [0, 0, 0.3])).as_matrix())
    for method in (0, 1, 101):
        with pytest.raises(UnderdeterminedError, match="one axis"):
            opencv.calibrateRobotWorldHandEye(about_z, poses[1], about_z, poses[3], method=method)


@pytest.mark.parametrize("method", [[10**400] * 1000, [[[[]]]], "x" * 100_000, {1: 2}])
def test_a_method_that_is_no_number_is_told_in_few_words(method):
    deep = []
    for _ in range(2000):
        deep = [deep]
    for each in (method, deep):
        with pytest.raises(OptionError, match="is not one of CALIB_HAND_EYE_TSAI = 0") as caught:
            opencv.calibrateHandEye(None, None, None, None, method=each)
        assert len(str(caught.value)) < 1000


def test_tsai_says_when_no_motion_is_in_its_range():
    gripper, seen, _, _ = stations(6, 11, spread_rad=0.05)
    with pytest.raises(UnderdeterminedError, match="0 of the 15 motions"):
        opencv.calibrateHandEye(*parts(gripper, seen))


def test_dqopt_over_all_pairs_is_solve_of_all_pairs():
    gripper, seen, _, _ = stations(12, 12)
    j, i = np.triu_indices(12, 1)[::-1]
    A, B = np.linalg.inv(gripper[j]) @ gripper[i], seen[j] @ np.linalg.inv(seen[i])
    turns = [np.arccos((np.trace(T[:, :3, :3], axis1=1, axis2=2) - 1.0) / 2.0) for T in (A, B)]
    kept = np.cos(turns[0] / 2.0) + np.cos(turns[1] / 2.0) >= 0.2
    alpha, X = 1.0, None
    for _ in range(8):
        X = solve_hand_eye(A[kept], B[kept], alpha=alpha).X.matrix()
        (q,), (dual,) = from_transforms(X[None])
        rotation, translation = squared_residuals(motions_of(A[kept], B[kept]), q, dual)
        alpha = np.sqrt(rotation / translation)
    R, t = opencv.calibrateHandEye(*parts(gripper, seen), method=opencv.CALIB_HAND_EYE_DQOPT)
    np.testing.assert_allclose(R, X[:3, :3], atol=1e-5)
    np.testing.assert_allclose(t[:, 0], X[:3, 3], atol=1e-5)


def test_integers_and_lists_of_lists_are_numbers():
    gripper, seen, _, _ = stations(6, 14)
    R_G, t_G, R_C, t_C = parts(gripper, seen)
    whole = [np.round(100.0 * t).astype(int) for t in t_G]
    expected = opencv.calibrateHandEye(R_G, [t.astype(float) for t in whole], R_C, t_C)
    assert largest_difference(opencv.calibrateHandEye(R_G, whole, R_C, t_C), expected) == 0.0
    mixed = [whole[0].astype(float), *whole[1:]]
    assert largest_difference(opencv.calibrateHandEye(R_G, mixed, R_C, t_C), expected) == 0.0
    lists = [[value.tolist() for value in values] for values in (R_G, whole, R_C, t_C)]
    assert largest_difference(opencv.calibrateHandEye(*lists), expected) < 1e-12


def poses_of(turns: np.ndarray, places: np.ndarray) -> list[np.ndarray]:
    """Rotations and translations of a gripper, and of the target that its camera sees."""
    G, X, W = (
        pose(Rotation.from_rotvec(turn).as_matrix(), place)
        for turn, place in ((turns, places), ([[0.4, -0.2, 0.9]], [[0.1, 0.2, 0.3]]), ([[1, 2, 3]],) * 2)
    )
    C = np.linalg.inv(X) @ np.linalg.inv(G) @ W
    return [G[:, :3, :3], G[:, :3, 3], C[:, :3, :3], C[:, :3, 3]]


RNG = np.random.default_rng(0)
TURNS, PLACES = RNG.normal(size=(12, 3)), RNG.normal(size=(12, 3))


def test_andreff_and_li_refuse_a_gripper_that_only_turns() -> None:
    R_G, t_G, R_C, t_C = poses_of(TURNS, np.zeros((12, 3)))
    with pytest.raises(UnderdeterminedError, match="Andreff's"):
        opencv.calibrateHandEye(R_G, t_G, R_C, t_C, method=opencv.CALIB_HAND_EYE_ANDREFF)
    with pytest.raises(UnderdeterminedError, match="Li's"):
        opencv.calibrateRobotWorldHandEye(
            R_C, t_C, R_G.transpose(0, 2, 1), t_G, method=opencv.CALIB_ROBOT_WORLD_HAND_EYE_LI
        )
    R, t = opencv.calibrateHandEye(R_G, t_G, R_C, t_C, method=opencv.CALIB_HAND_EYE_PARK)
    np.testing.assert_allclose(R, Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(t.ravel(), [0.1, 0.2, 0.3], atol=1e-12)


def test_tsai_refuses_one_axis_among_the_motions_that_it_uses() -> None:
    """About z within its range, about x beyond it."""
    turns = np.array([[0, 0, 0], [0, 0, 1.0], [0, 0, 0], [2.8, 0, 0]])
    with pytest.raises(UnderdeterminedError, match="rotate about one axis"):
        opencv.calibrateHandEye(*poses_of(turns, PLACES[:4]), method=opencv.CALIB_HAND_EYE_TSAI)
