"""Arguments of `solve`, `certify` and the other calls: what cannot be used is refused in words, without a TypeError."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec import errors
from gtsam_rwhec.methods import opencv
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver.solve_options import SolveOptions


class Thing:
    """Neither a number nor a pose; with the same name in every process."""

    def __repr__(self) -> str:
        return "a thing"


NOISE = Noise(sigma_m=0.005, kappa=6000.0)
#: Problems and their solutions, by the kind of scale.
KINDS: dict[Any, tuple[Problem, rw.Solution]] = {}
for kind in ("known", "shared", "per_target"):
    sizes = {"known_sizes": ["target0"]} if kind == "per_target" else {}
    made = general(3, 2, seed=1, noise=NOISE, scale=kind, number_of_measurements=12, **sizes).problem
    KINDS[kind] = (made, rw.solve(made))
KNOWN, SOLVED = KINDS["known"]
RAW = KNOWN.measurements("target0", "sensor0")

NO_SCALES: list[Any] = [
    None,
    "1",
    b"1",
    [1.0],
    (),
    1 + 0j,
    True,
    np.array(1.0),
    np.array([1.0]),
    np.ones(2),
    float("nan"),
    float("inf"),
    float("-inf"),
    -1.0,
    0.0,
    1e200,
    1e-200,
    1e16,
    1e-16,
    10**400,
    np.timedelta64(3, "s"),
    np.datetime64("2020"),
    {"target1": "1", "target2": 1.0},
    {"target1": 1.0},
    {"target1": 1.0, "target2": 1.0, "moon": 1.0},
    {"target1": 1.0, "target2": 1.0, 3: 1.0},
    {},
    Thing(),
]


@pytest.mark.parametrize("scale", NO_SCALES, ids=lambda value: repr(value)[:30])
@pytest.mark.parametrize("kind", KINDS)
def test_no_scale(kind: str, scale: Any) -> None:
    problem, solution = KINDS[kind]
    for call in (
        lambda: rw.certify(problem, solution.X, solution.Y, scale),
        lambda: rw.solve(problem, "local", initial=(solution.X, solution.Y, scale)),
        lambda: rw.methods.cost_of_answer(problem, solution.X, solution.Y, scale),
    ):
        with pytest.raises(errors.ScaleError, match=r"the answer's scale .*; (give|leave it out|it has)") as caught:
            call()
        assert len(str(caught.value)) < 400


@pytest.mark.parametrize("value", [v for v in NO_SCALES if not isinstance(v, dict)], ids=lambda value: repr(value)[:30])
@pytest.mark.parametrize("name", ["target0", "target1"])
def test_no_scale_of_one_target(name: str, value: Any) -> None:
    problem, solution = KINDS["per_target"]
    assert isinstance(solution.scale, dict)
    with pytest.raises(errors.ScaleError, match=f"the answer's scale of {name} is"):
        rw.certify(problem, solution.X, solution.Y, solution.scale | {name: value})


def test_a_scale_without_the_fixed_ones_is_enough() -> None:
    problem, solution = KINDS["per_target"]
    assert isinstance(solution.scale, dict)
    free = {name: scale for name, scale in solution.scale.items() if name != "target0"}
    whole = rw.certify(problem, solution.X, solution.Y, solution.scale)
    assert rw.certify(problem, solution.X, solution.Y, free).cost == whole.cost


@pytest.mark.parametrize("scale", [1e-15, 1e15, 1, np.float32(1.0)])
def test_the_largest_scales_have_finite_costs(scale: Any) -> None:
    """Squares of a scale outside these limits overflow: 1e200 was certified with an infinite cost."""
    for kind in ("shared", "per_target"):
        problem, solution = KINDS[kind]
        given = {name: scale for name in ("target1", "target2")} if kind == "per_target" else scale
        certificate = rw.certify(problem, solution.X, solution.Y, given)
        assert np.isfinite(certificate.cost)
        assert not certificate.is_optimal


NO_POSES: list[Any] = [
    None,
    "pose",
    [["1.0"] * 4] * 4,
    [[1, 2], [3]],
    [[1.0, 2], [3, "x"]],
    3.0,
    10**400,
    1j * np.eye(4),
    np.eye(3),
    np.full((4, 4), np.nan),
    np.ma.masked_array(np.eye(4), np.eye(4)),
    np.zeros((2, 4, 4)),
    {},
    [None],
    np.array([None]),
    [gtsam.Pose3(), 3],
    np.datetime64("2020"),
    Thing(),
]


@pytest.mark.parametrize("pose", NO_POSES, ids=lambda value: repr(value)[:30].replace("\n", ""))
def test_no_pose(pose: Any) -> None:
    for call in (
        lambda: rw.certify(KNOWN, SOLVED.X | {"target0": pose}, SOLVED.Y),
        lambda: rw.solve(KNOWN, "local", initial=(SOLVED.X, SOLVED.Y | {"sensor0": pose}, 1.0)),
        lambda: rw.Problem().fix("cam", pose),
        lambda: rw.Problem().add_prior("cam", pose, 0.1),
        lambda: rw.methods.DualQuaternionPrior(pose, 1.0, 1.0),
    ):
        with pytest.raises(errors.PoseError, match=r"give|leave|check"):
            call()


#: Of the wrong type, or of the right type and senseless, for one argument or another.
ODD: list[Any] = [
    "no",
    b"no",
    3.5,
    -1,
    10**400,
    1j,
    True,
    float("nan"),
    [],
    [1.0],
    ["a"],
    [[1, 2], [3]],
    {"a": "b"},
    {1: 2},
    np.ones(2),
    np.array("x"),
    np.full((4, 4), np.nan),
    np.ma.masked_array([1.0], [True]),
    np.timedelta64(3, "s"),
    Thing(),
    gtsam.Pose3(),
]
REFINED = rw.refine(KNOWN, SOLVED)
ROTATIONS = RAW.A[:, :3, :3], RAW.A[:, :3, 3], RAW.B[:, :3, :3], RAW.B[:, :3, 3]


def add(**given: Any) -> None:
    arguments = {"target": "t", "sensor": "s", "A": RAW.A, "B": RAW.B, "sigma": 0.1, "kappa": 10.0} | given
    if "covariances" in given:
        del arguments["sigma"], arguments["kappa"]
    rw.Problem().add(**arguments)


#: Each takes one argument, which is odd.
CALLS: dict[str, Callable[[Any], Any]] = {
    "certify problem": lambda odd: rw.certify(odd, SOLVED.X, SOLVED.Y),
    "certify X": lambda odd: rw.certify(KNOWN, odd, SOLVED.Y),
    "certify Y": lambda odd: rw.certify(KNOWN, SOLVED.X, odd),
    "certify options": lambda odd: rw.certify(KNOWN, SOLVED.X, SOLVED.Y, options=odd),
    "certify progress": lambda odd: rw.certify(KNOWN, SOLVED.X, SOLVED.Y, progress=odd),
    "solve problem": lambda odd: rw.solve(odd),
    "solve method": lambda odd: rw.solve(KNOWN, odd),
    "solve initial": lambda odd: rw.solve(KNOWN, "local", initial=odd),
    "solve progress": lambda odd: rw.solve(KNOWN, progress=odd),
    "refine problem": lambda odd: rw.refine(odd, SOLVED),
    "refine solution": lambda odd: rw.refine(KNOWN, odd),
    "refine options": lambda odd: rw.refine(KNOWN, SOLVED, odd),
    "refine progress": lambda odd: rw.refine(KNOWN, SOLVED, progress=odd),
    "judge": lambda odd: rw.judge(odd),
    "write_solution": lambda odd: rw.write_solution(odd, "/nowhere/at/all.json"),
    "write_refined": lambda odd: rw.write_refined(odd, "/nowhere/at/all.json"),
    "covariance": lambda odd: REFINED.covariance(odd),
    "information": lambda odd: REFINED.information(odd),
    "relative": lambda odd: REFINED.relative("target0", odd),
    "standard deviations": lambda odd: REFINED.standard_deviations(odd),
    "contains name": lambda odd: REFINED.contains(odd, np.eye(4)),
    "contains confidence": lambda odd: REFINED.contains("target0", np.eye(4), odd),
    "squared radius": lambda odd: REFINED.squared_radius(6, odd),
    "squared radius dimension": lambda odd: REFINED.squared_radius(odd),
    "fix scale": lambda odd: KINDS["per_target"][0].fix_scale("target1", odd),
    "problem scale": lambda odd: rw.Problem(odd),
    "add order": lambda odd: add(order=odd),
    "add covariances": lambda odd: add(covariances=odd),
    "add stamps": lambda odd: add(stamps_ns=odd),
    "add A": lambda odd: add(A=odd),
    "measurements": lambda odd: KNOWN.measurements(odd, "sensor0"),
    "moments": lambda odd: KNOWN.moments("target0", odd),
    "with measurements": lambda odd: KNOWN.with_measurements(odd),
    "cross validate problem": lambda odd: rw.cross_validate(odd),
    "cross validate folds": lambda odd: rw.cross_validate(KNOWN, odd),
    "cross validate by": lambda odd: rw.cross_validate(KNOWN, by=odd),
    "cross validate progress": lambda odd: rw.cross_validate(KNOWN, progress=odd),
    "handeye C": lambda odd: rw.methods.solve_hand_eye(odd, RAW.B),
    "handeye method": lambda odd: rw.methods.solve_hand_eye(RAW.A, RAW.B, odd),
    "handeye order": lambda odd: rw.methods.solve_hand_eye(RAW.A, RAW.B, order=odd),
    "handeye weights": lambda odd: rw.methods.solve_hand_eye(RAW.A, RAW.B, weights=odd),
    "handeye covariances": lambda odd: rw.methods.solve_hand_eye(RAW.A, RAW.B, covariances=odd),
    "handeye prior": lambda odd: rw.methods.solve_hand_eye(RAW.A, RAW.B, prior=odd),
    "handeye scale": lambda odd: rw.methods.solve_hand_eye(RAW.A, RAW.B, scale=odd),
    "a prior's form": lambda odd: rw.methods.DualQuaternionPrior(np.eye(4), 1.0, 1.0, odd),
    "run name": lambda odd: rw.methods.run(odd, KNOWN),
    "run problem": lambda odd: rw.methods.run("certified", odd),
    "run options": lambda odd: rw.methods.run("certified", KNOWN, odd),
    "compare methods": lambda odd: rw.methods.compare(KNOWN, methods=odd),
    "compare problem": lambda odd: rw.methods.compare(odd),
    "compare options": lambda odd: rw.methods.compare(KNOWN, odd),
    "compare progress": lambda odd: rw.methods.compare(KNOWN, methods=["certified"], progress=odd),
    "refusal method": lambda odd: rw.methods.refusal(odd, KNOWN),
    "refusal problem": lambda odd: rw.methods.refusal(rw.methods.METHODS["certified"], odd),
    "cost of answer": lambda odd: rw.methods.cost_of_answer(odd, SOLVED.X, SOLVED.Y),
    "start": lambda odd: rw.methods.MethodOptions(start=odd),
    "start's scale": lambda odd: run_from((SOLVED.X, SOLVED.Y, odd)),
    "hand-eye rotations": lambda odd: opencv.calibrateHandEye(odd, *ROTATIONS[1:]),
    "hand-eye translations": lambda odd: opencv.calibrateHandEye(*ROTATIONS[:3], odd),
    "hand-eye method": lambda odd: opencv.calibrateHandEye(*ROTATIONS, method=odd),
    "robot-world rotations": lambda odd: opencv.calibrateRobotWorldHandEye(odd, *ROTATIONS[1:]),
    **{
        f"{options.__name__}.{name}": lambda odd, options=options, name=name: options(**{name: odd})
        for options, names in (
            (SolveOptions, ["random_starts", "seed", "max_descent_iterations", "max_relaxation_iterations"]),
            (rw.RefineOptions, ["noise", "noise_groups", "residual", "robust", "inlier_confidence", "carrier_noise"]),
            (rw.RefineOptions, ["carrier_model", "carrier_path", "max_iterations"]),
            (rw.methods.MethodOptions, ["seed", "max_iterations"]),
        )
        for name in names
    },
    **{
        f"{how} a frame named": lambda odd, how=how, rest=rest: getattr(rw.Problem("per_target"), how)(odd, *rest)
        for how, rest in (("fix", [np.eye(4)]), ("add_prior", [np.eye(4), 0.1]), ("fix_scale", []))
    },
}
#: What some calls take although it is odd elsewhere, as Python writes it.
TAKEN: dict[str, list[str]] = {
    "fix scale": ["3.5"],
    "compare methods": ["[]"],
    "hand-eye method": ["True"],
    "start's scale": ["3.5"],
    **{f"{how} a frame named": ["'no'"] for how in ("fix", "add_prior", "fix_scale")},
}


def run_from(start: Any) -> None:
    rw.methods.run("lom", KINDS["shared"][0], rw.methods.MethodOptions(start=start))


@pytest.mark.parametrize("name", CALLS)
def test_odd_arguments(name: str) -> None:
    """Each is refused by an error of this library, with a short message; what is taken is listed."""
    for odd in ODD:
        if repr(odd) in TAKEN.get(name, ()):
            CALLS[name](odd)
            continue
        with pytest.raises(errors.RwhecError) as caught:
            CALLS[name](odd)
        assert 10 < len(str(caught.value)) < 1200  # some name all methods
