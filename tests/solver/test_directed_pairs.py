"""Points, planes and registrations that slide in the certified problem: the form, information, and free directions."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mixed_sets import MOVE_M, TURN_RAD, mixed_set, pose, solved
from rwhec_factors import se3
from scipy.optimize import least_squares

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CountError, MeasurementsNotKeptError, NoiseError, OptionError, PoseError, ScaleError
from gtsam_rwhec.fitting.robust_solution import robust_solution
from gtsam_rwhec.problem.directions import SLIDES, aligned, centres_of, motions_of_slides, scaled, with_common_slides
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.selection import VarianceFactors, aligned_at, reweighted
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver.answers import PairPoses, given_answer, parts_about
from gtsam_rwhec.solver.part_form import PartForm


@pytest.mark.parametrize("seed", range(8))
def test_the_form_is_the_sum_of_the_weighted_squares(seed: int) -> None:
    of = mixed_set(seed, ("point_0", "spread_1", "plane_2", "slide_3"), scale=("known", "shared")[seed % 2])
    rng = np.random.default_rng(seed)
    about = {name: gtsam.Pose3(T @ se3.expmap(0.01 * rng.normal(size=(1, 6)))[0]) for name, T in of.truth.items()}
    X, Y = {name: T for name, T in about.items() if name != "sensor"}, {"sensor": about["sensor"]}
    (part,) = parts_about(of.problem, X, Y, of.scale)
    whole, answer = PartForm.of(part), given_answer(part, X, Y, of.scale)
    naive = 0.0
    for pair in part.directed:
        T = about[part.pairs[pair.e].target].matrix()
        S, w = about["sensor"].matrix(), pair.weighing
        E = pair.A[:, :3, :3] @ T[:3, :3] - S[:3, :3] @ pair.B[:, :3, :3]
        e = of.scale * (pair.A[:, :3, :3] @ T[:3, 3] + pair.A[:, :3, 3] - S[:3, 3]) - pair.B[:, :3, 3] @ S[:3, :3].T
        at_centre = e + np.einsum("nij,nj->ni", E, w.centre)
        naive += 0.5 * float(((E @ w.turns) ** 2 * w.of_turns[:, None]).sum())
        naive += 0.5 * float((np.einsum("nji,nj->ni", w.axes, at_centre) ** 2 * w.of_axes).sum())
    evaluation = whole.evaluated(answer)
    assert evaluation.cost == pytest.approx(naive, rel=1e-10)
    assert evaluation.cost_error <= 1e-12 * evaluation.cost
    x = np.r_[evaluation.point.numbers.ravel(), evaluation.point.alpha, 1.0]
    Qx = whole.full.times(x[:, None])[:, 0]
    assert x @ Qx == pytest.approx(naive, rel=1e-9)
    np.testing.assert_allclose(Qx[:-1], evaluation.gradient, rtol=0, atol=1e-9 * np.abs(evaluation.gradient).max())


def test_isotropic_noise_by_direction_is_that_of_sigma_and_kappa() -> None:
    rng = np.random.default_rng(0)
    A, X, Y = np.array([pose(rng) for _ in range(12)]), pose(rng), pose(rng)
    B = se3.inverse(Y)[None] @ A @ X @ se3.expmap(0.002 * rng.normal(size=(12, 6)))
    found = []
    for more in ({"sigma": 0.002, "kappa": 0.5 / 0.003**2}, {"directional": True}):
        if "directional" in more:
            more["covariances"] = np.diag(np.repeat([0.003**2, 0.002**2], 3))
        problem = rw.Problem()
        problem.add("target", "sensor", A, B, **more)
        found.append(rw.solve(problem))
    assert found[1].cost == pytest.approx(found[0].cost, rel=1e-10)
    assert found[1].Y["sensor"].equals(found[0].Y["sensor"], 1e-9)


@pytest.mark.parametrize("thing", ["point_0", "spread_0", "plane_0", "slide_0", "motions_0"])
def test_the_information_is_that_of_numeric_derivatives(thing: str) -> None:
    of = mixed_set(3, (thing,) if thing != "motions_0" else ("motions_0", "tag_1"), scale="shared", noise=0.0)
    if thing == "motions_0":
        raw = of.problem.measurements("sensor", "sensor")
        problem = rw.Problem("shared")
        problem.add_motion("sensor", raw.A, raw.B, covariances=np.diag([1, 4, 9, 2, 3, 5.0]) * 1e-6, directional=True)
    else:
        problem = of.problem
    poses = {name: gtsam.Pose3(T) for name, T in of.truth.items() if name == "sensor" or name in problem.targets}
    X, Y = {name: T for name, T in poses.items() if name != "sensor"}, {"sensor": poses["sensor"]}
    (part,) = parts_about(problem, X, Y, of.scale)
    pair, answer = part.directed[0], given_answer(part, X, Y, of.scale)
    at = PairPoses.of(part, answer)
    S, T = se3.pose(at.R_Y[0], at.t_Y[0]), se3.pose(at.R_X[0], at.t_X[0])
    predicted = pair.A.copy()
    a, c = part.centres(0)
    predicted[:, :3, 3] += pair.A[:, :3, :3] @ c - a
    B = se3.inverse(S)[None] @ predicted @ T
    B[:, :3, 3] *= of.scale
    w = pair.weighing

    def residuals(step: np.ndarray) -> np.ndarray:
        X_there, Y_there = T @ se3.expmap(step[None, :6])[0], S @ se3.expmap(step[None, 7:13])[0]
        alpha = of.scale * np.exp(step[14])
        there = se3.inverse(Y_there)[None] @ predicted @ X_there
        there[:, :3, 3] *= alpha
        off = np.linalg.inv(B[:, :3, :3]) @ there[:, :3, :3]
        turn = (
            np.stack([off[:, 2, 1] - off[:, 1, 2], off[:, 0, 2] - off[:, 2, 0], off[:, 1, 0] - off[:, 0, 1]], axis=1)
            / 2
        )
        of_turns, of_axes = pair.told
        told = of_turns.sum(axis=1, keepdims=True) - of_turns
        E = Y_there[:3, :3] @ (there[:, :3, :3] - B[:, :3, :3])
        e = (there[:, :3, 3] - B[:, :3, 3]) @ Y_there[:3, :3].T + np.einsum("nij,nj->ni", E, w.centre)
        rotation = np.einsum("nji,nj->ni", w.turns, turn) * np.sqrt(told)
        return np.concatenate([rotation, np.einsum("nji,nj->ni", w.axes, e) * np.sqrt(of_axes)], axis=1).ravel()

    J = np.array([(residuals(1e-6 * d) - residuals(-1e-6 * d)) / 2e-6 for d in np.eye(15)])
    rotation, translation = pair.information(a, c, T, S, of.scale)
    expected = J @ J.T
    keep = [i for i in range(15) if i not in (6, 13)]
    np.testing.assert_allclose(
        (rotation + translation)[np.ix_(keep, keep)],
        expected[np.ix_(keep, keep)],
        rtol=0,
        atol=1e-6 * np.abs(expected).max(),
    )


def test_planes_settle_at_the_maximum_of_their_likelihood() -> None:
    of = mixed_set(4, ("plane_0",), count=25, scale="known")
    found, raw = rw.solve(of.problem), of.problem.measurements("plane_0", "sensor")
    X, Y, n, p = found.X["plane_0"].matrix(), found.Y["sensor"].matrix(), raw.B[:, :3, 2], raw.B[:, :3, 3]

    def residuals(v: np.ndarray) -> np.ndarray:
        there = X @ se3.expmap(np.r_[v[:2], 0.0, 0.0, 0.0, v[2]][None])[0]
        sensor = Y @ se3.expmap(v[None, 3:])[0]
        N = there[:3, 2]
        q = np.einsum("nji,nj->ni", raw.A[:, :3, :3], p @ sensor[:3, :3].T + sensor[:3, 3] - raw.A[:, :3, 3])
        seen = np.einsum("nji,nj->ni", raw.A[:, :3, :3], n @ sensor[:3, :3].T)
        return np.r_[(np.cross(seen, N) / TURN_RAD).ravel(), (q @ N - N @ there[:3, 3]) / MOVE_M]

    best = least_squares(residuals, np.zeros(9), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert np.abs(best.x).max() < 1e-5  # a hundredth of a deviation: chords are not angles
    assert found.cost == pytest.approx(best.cost, rel=1e-4)


def fixed_board(things: str, planes: int) -> rw.Problem:
    """A sensor that stands still before boards at known places."""
    rng, problem = np.random.default_rng(1), rw.Problem()
    Y = pose(rng, 0.3)
    for k in range(planes):
        A = np.repeat(pose(rng)[None], 8, axis=0)
        B = se3.inverse(Y)[None] @ A
        n = B[:, :3, 2] + np.cross(TURN_RAD * rng.normal(size=(8, 3)), B[:, :3, 2])
        p = B[:, :3, 3] + MOVE_M * rng.normal(size=(8, 1)) * B[:, :3, 2]
        name = f"board_{k}"
        if things == "planes":
            problem.add_planes(name, "lidar", A, n / np.linalg.norm(n, axis=1, keepdims=True), p, TURN_RAD, MOVE_M)
        else:
            problem.add_points(name, "lidar", A, B[:, :3, 3] + MOVE_M * rng.normal(size=(8, 3)), MOVE_M)
        problem.fix(name, np.eye(4))
    return problem


@pytest.mark.parametrize(
    ("things", "number", "free"),
    [("planes", 1, 3), ("planes", 2, 1), ("planes", 3, 0), ("points", 1, 3), ("points", 3, 0)],
)
def test_what_known_planes_and_points_leave_free_is_named(things: str, number: int, free: int) -> None:
    found = solved(fixed_board(things, number))
    assert found.certificate.is_optimal
    assert len(found.identifiability.free_directions) == free
    assert all("lidar" in direction.frames for direction in found.identifiability.free_directions)


def test_what_means_nothing_is_not_free_and_has_its_convention() -> None:
    of = mixed_set(2, ("tag_0", "point_1", "plane_2"), scale="known")
    found = rw.solve(of.problem)
    assert found.identifiability.is_unique
    assert found.X["point_1"].rotation().equals(gtsam.Rot3(), 1e-6)
    T = found.X["plane_2"].matrix()
    assert np.cross(T[:3, 2], T[:3, 3]) == pytest.approx(np.zeros(3), abs=1e-7)  # nearest to the carrier's origin
    assert np.linalg.det(np.column_stack([T[:3, 0], T[:3, 2], [1, 0, 0] if abs(T[0, 2]) < 0.9 else [0, 1, 0]])) == (
        pytest.approx(0.0, abs=1e-7)
    )


def test_what_slides_alike_everywhere_is_free() -> None:
    found = solved(mixed_set(5, ("slide_0",), scale="known").problem)
    kinds = sorted(str(direction.kind) for direction in found.identifiability.free_directions)
    assert kinds == ["rotation", "translation"]
    assert all(set(direction.frames) == {"slide_0"} for direction in found.identifiability.free_directions)


def test_a_sphere_counts_whole_wherever_its_frame_is() -> None:
    """A sphere's registration is a centre that is known, and rotations about it that are not."""
    rng = np.random.default_rng(7)
    A, X, Y, centre = np.array([pose(rng) for _ in range(15)]), pose(rng), pose(rng, 0.3), np.array([0.2, -0.1, 0.4])
    B = se3.inverse(Y)[None] @ A @ X @ se3.expmap(np.c_[np.zeros((15, 3)), MOVE_M * rng.normal(size=(15, 3))])
    at_centre = se3.pose(np.eye(3), centre)
    moved = se3.adjoint(at_centre[None])[0]
    covariance = moved @ np.diag([900.0, 900, 900, *[MOVE_M**2] * 3]) @ moved.T
    registered, points = rw.Problem(), rw.Problem()
    registered.add("ball", "sensor", A, B, covariances=covariance, directional=True)
    points.add_points("ball", "sensor", A, (B @ at_centre)[:, :3, 3], MOVE_M)
    one, other = solved(registered), rw.solve(points)
    assert one.Y["sensor"].equals(other.Y["sensor"], 1e-5)
    assert one.certificate.is_optimal


def test_measurements_slide_without_a_change_of_the_cost() -> None:
    of = mixed_set(6, ("point_0", "plane_1", "spread_2"), scale="known")
    found = rw.solve(of.problem)
    again = rw.Problem()
    for pair in of.problem.pairs:
        raw = aligned(of.problem.measurements(*pair), found.X[pair.target].matrix(), found.Y["sensor"].matrix())
        assert raw.covariances is not None
        predicted = found.Y["sensor"].matrix() @ raw.B
        off = np.linalg.inv(predicted) @ raw.A @ found.X[pair.target].matrix()
        assert np.abs(se3.logmap(off)).max() < 0.05
    again = aligned_at(of.problem, found.X, found.Y)
    assert rw.solve(again).cost == pytest.approx(found.cost, rel=1e-7)


def test_all_kinds_join_in_one_pair_and_in_one_problem() -> None:
    of, rng = mixed_set(8, ("tag_0",), scale="known"), np.random.default_rng(8)
    A = np.array([pose(rng) for _ in range(10)])
    B = se3.inverse(of.truth["sensor"])[None] @ A @ of.truth["tag_0"]
    of.problem.add_points("tag_0", "sensor", A, B[:, :3, 3], MOVE_M)
    of.problem.add_planes("tag_0", "sensor", A, B[:, :3, 2], B[:, :3, 3], TURN_RAD, MOVE_M)
    assert of.problem.directed == {Pair("tag_0", "sensor")}
    assert not of.problem.unseen("tag_0").any()
    found = rw.solve(of.problem)
    assert found.certificate.relative_gap <= 1e-12
    joined = of.problem + mixed_set(8, ("tag_0",), scale="known").problem
    assert rw.solve(joined).certificate.relative_gap <= 1e-12


EYE = np.eye(4)[None]


@pytest.mark.parametrize(
    ("add", "error", "words"),
    [
        (lambda p: p.add_points("t", "s", EYE, np.zeros((1, 3))), NoiseError, "give sigma"),
        (lambda p: p.add_points("t", "s", EYE, np.zeros((1, 2)), 0.1), CountError, r"shape \(1, 2\)"),
        (lambda p: p.add_points("t", "s", EYE, np.full((1, 3), np.nan), 0.1), PoseError, "row 0 of points"),
        (lambda p: p.add_points("t", "s", EYE, np.zeros((1, 3)), -0.1), NoiseError, "positive"),
        (lambda p: p.add_points("t", "s", EYE, np.zeros((1, 3)), covariances=-np.eye(3)), NoiseError, "definite"),
        (lambda p: p.add_planes("t", "s", EYE, [[0, 0, 2.0]], np.zeros((1, 3)), 0.1, 0.1), PoseError, "length 2"),
        (lambda p: p.add_planes("t", "s", EYE, [[0, 0, 1.0]], np.zeros((2, 3)), 0.1, 0.1), CountError, "1 normals"),
        (lambda p: p.add_planes("t", "s", EYE, [[0, 0, 1.0]], np.zeros((1, 3)), 0.1, 0.0), NoiseError, "offset_m"),
        (lambda p: p.add("t", "s", EYE, EYE, directional=True), NoiseError, "give covariances"),
    ],
)
def test_bad_input_is_named(add: Callable[[rw.Problem], None], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        add(rw.Problem())


def test_what_the_certified_form_cannot_hold_is_refused() -> None:
    with pytest.raises(ScaleError, match="per_target"):
        rw.Problem("per_target").add_points("t", "s", EYE, np.zeros((1, 3)), 0.1)
    with pytest.raises(MeasurementsNotKeptError, match="keep_measurements"):
        rw.Problem(keep_measurements=False).add_points("t", "s", EYE, np.zeros((1, 3)), 0.1)
    of = mixed_set(1, ("point_0",), scale="shared")
    of.problem.add_prior("point_0", np.eye(4), sigma=0.1)
    with pytest.raises(ScaleError, match="weigh by direction"):
        rw.solve(of.problem)


def test_methods_of_whole_poses_refuse_them() -> None:
    of = mixed_set(1, ("point_0", "tag_1"), scale="known")
    with pytest.raises(OptionError, match="takes whole poses"):
        rw.methods.run("shah2013", of.problem)


#: What slides of things: twists [omega, v] of their axes, about a centre that is (1, 2, 3) cm from the origin.
CENTRE = np.array([0.01, 0.02, 0.03])
TURNS = np.vstack([np.eye(3), -np.array([np.cross(axis, CENTRE) for axis in np.eye(3)]).T])
ALONG_Z = np.eye(6)[:, 5:]
SLIDING = {
    "sphere": TURNS,
    "revolved": TURNS[:, 2:],
    "cylinder": np.hstack([TURNS[:, 2:], ALONG_Z]),
    "plane": np.hstack([TURNS[:, 2:], np.eye(6)[:, 3:5]]),
    "profile": ALONG_Z,
    "nothing": np.zeros((6, 0)),
}


def same_span(first: np.ndarray, second: np.ndarray) -> bool:
    first, second = (np.linalg.qr(each)[0] for each in (first, second))
    return first.shape == second.shape and np.allclose(first @ first.T, second @ second.T, atol=1e-4)


@pytest.mark.parametrize("thing", SLIDING)
def test_what_slides_in_all_views_is_one_motion(thing: str) -> None:
    rng, slides = np.random.default_rng(5), SLIDING[thing]
    turned = np.linalg.qr(slides)[0] @ np.linalg.qr(rng.normal(size=(slides.shape[1],) * 2))[0]
    found, centre = motions_of_slides(turned + 1e-6 * rng.normal(size=turned.shape))
    assert same_span(found, slides)
    if thing == "sphere":
        assert centre == pytest.approx(CENTRE, abs=1e-5)
    covariances = []
    for _ in range(5):  # each view tells the centre to 30 micrometres
        own = slides + 3e-5 * rng.normal(size=slides.shape)
        covariances.append(1e-10 * np.eye(6) + 4.0 * SLIDES * own @ np.linalg.inv(own.T @ own) @ own.T)
    for covariance in with_common_slides(np.array(covariances)):
        variances, along = np.linalg.eigh(covariance)
        assert same_span(along[:, variances > SLIDES], slides)
        assert np.allclose(variances[variances < SLIDES], 1e-10, rtol=0.2)


def test_a_slide_that_one_view_tells_to_a_metre_is_a_slide() -> None:
    covariances = np.tile(1e-8 * np.eye(6) + 4.0 * SLIDES * ALONG_Z @ ALONG_Z.T, (12, 1, 1))
    covariances[7] -= (4.0 * SLIDES - 0.9) * ALONG_Z @ ALONG_Z.T
    assert with_common_slides(covariances)[:, 5, 5] == pytest.approx(4.0 * SLIDES)


@given(seed=st.integers(0, 1000), turns=st.floats(0.01, 100.0), shifts=st.floats(0.01, 100.0))
@settings(max_examples=20, deadline=None)
def test_factors_leave_the_points_where_turns_and_shifts_tell_least_of_each_other(
    seed: int, turns: float, shifts: float
) -> None:
    part = np.random.default_rng(seed).normal(size=(3, 6, 6))
    covariances = part @ part.transpose(0, 2, 1)
    factors = scaled(covariances, np.zeros_like(covariances), np.repeat([turns, shifts], 3))
    assert centres_of(factors) == pytest.approx(centres_of(covariances), rel=1e-6, abs=1e-6)
    assert factors[:, :3, :3] == pytest.approx(turns**2 * covariances[:, :3, :3], rel=1e-9)


def test_who_agrees_as_registrations_state_is_no_outlier() -> None:
    # Views of a box with an exact arm: what faces tell is off by little, what edges tell by half of what they state.
    rng = np.random.default_rng(3)
    A, Y = random_poses(9, 0.5, rng), random_poses(1, 0.2, rng)[0]
    off = 1e-3 * rng.normal(size=(9, 6)) * np.r_[1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5]
    off[4, 3] = 0.5e-3
    problem = rw.Problem()
    covariances = np.tile(np.diag(np.r_[1e-3, 1e-3, 1e-3, 1e-3, 5e-5, 5e-5] ** 2), (9, 1, 1))
    problem.add("box", "camera", A, np.linalg.inv(Y) @ A @ se3.expmap(off), covariances=covariances, directional=True)
    (kept,) = robust_solution(problem, noise_scale="estimate").inliers.values()
    assert kept.all()


@pytest.mark.parametrize("thing", ["sphere", "cylinder", "plane"])
def test_factors_of_the_noise_leave_what_slides_alone(thing: str) -> None:
    slides = np.linalg.qr(SLIDING[thing])[0]
    covariance = 1e-10 * np.eye(6) + 4.0 * SLIDES * slides @ slides.T
    problem = rw.Problem()
    problem.add("thing", "camera", np.eye(4)[None], np.eye(4)[None], covariances=covariance[None], directional=True)
    (scaled,) = reweighted(problem, {}, VarianceFactors(0.01, 0.01)).measurements("thing", "camera").covariances
    variances, along = np.linalg.eigh(scaled)
    assert same_span(along[:, variances > SLIDES], slides)
    assert variances[variances < SLIDES] == pytest.approx(1e-12, rel=1e-2)
