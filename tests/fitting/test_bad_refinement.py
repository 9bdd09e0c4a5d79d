"""Errors of refine: each names the place, the value and the remedy."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from refinement_problems import KAPPA, SIGMA_M, refined, rig

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.geometry import Trajectory

PROBLEM = rig(seed=1).problem
SOLUTION = rw.solve(PROBLEM)
MOMENTS_ONLY = rig(seed=1, keep_measurements=False).problem


def unit_weights() -> rw.Problem:
    problem = rw.Problem()
    for pair in PROBLEM.pairs:
        raw = PROBLEM.measurements(*pair)
        problem.add(*pair, raw.A, raw.B)
    return problem


def few() -> rw.Problem:
    """As many equations as unknowns."""
    problem = rw.Problem()
    raw = PROBLEM.measurements("target0", "sensor0")
    problem.add("target0", "sensor0", raw.A[:2], raw.B[:2], SIGMA_M, KAPPA)
    return problem


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: rw.refine("no", SOLUTION), rw.errors.OptionError, "the problem is a str"),
        (lambda: rw.refine(PROBLEM, PROBLEM), rw.errors.OptionError, "the solution is a Problem; give what"),
        (lambda: rw.refine(PROBLEM, SOLUTION, {}), rw.errors.OptionError, "options is a dict"),
        (
            lambda: rw.refine(rig(3, 2, seed=1).problem, SOLUTION),
            rw.errors.FrameError,
            "another problem; solve this problem first .X has no pose of 'target2'; it has 'target0', 'target1'",
        ),
        (
            lambda: rw.refine(rig(1, 2, seed=1).problem, SOLUTION),
            rw.errors.FrameError,
            "X has 'target1', which the problem does not",
        ),
        (
            lambda: rw.refine(rig(seed=1, scale="shared").problem, SOLUTION),
            rw.errors.ScaleError,
            "scale='known', but this problem has scale='shared'",
        ),
        (
            lambda: rw.refine(MOMENTS_ONLY, SOLUTION),
            rw.errors.MeasurementsNotKeptError,
            r"residual='geodesic' \(unlike residual='chordal'\) needs the raw .*keep_measurements=True",
        ),
        (
            lambda: rw.refine(MOMENTS_ONLY, SOLUTION, RefineOptions(residual="chordal", robust="gnc")),
            rw.errors.MeasurementsNotKeptError,
            "robust='gnc' needs the raw measurements",
        ),
        (
            lambda: rw.refine(unit_weights(), SOLUTION, RefineOptions(noise="given")),
            rw.errors.OptionError,
            "without sigma or kappa.*noise='estimate'",
        ),
        (
            lambda: refined(few(), noise="estimate"),
            rw.errors.NoiseError,
            "noise of the measurements cannot be estimated: .*degrees of freedom",
        ),
        (lambda: RefineOptions(noise="guess"), rw.errors.OptionError, "noise='guess' is not one of 'auto'"),
        (lambda: RefineOptions(robust="l1"), rw.errors.OptionError, "robust='l1' is not one of"),
        (lambda: RefineOptions(residual="quaternion"), rw.errors.OptionError, "residual='quaternion'"),
        (lambda: RefineOptions(noise_groups="tag"), rw.errors.OptionError, "noise_groups='tag'"),
        (lambda: RefineOptions(carrier_model="exact"), rw.errors.OptionError, "carrier_model='exact'"),
        (lambda: RefineOptions(carrier_noise=0.1), rw.errors.OptionError, "carrier_noise is a float"),
        (lambda: RefineOptions(inlier_confidence=1.5), rw.errors.OptionError, "inlier_confidence=1.5"),
        (lambda: RefineOptions(time_offsets="cam_0"), rw.errors.OptionError, "time_offsets='cam_0'; give True, or a"),
        (lambda: rw.refine(rw.Problem(), SOLUTION), rw.errors.CountError, "the problem is empty"),
        (lambda: RefineOptions(max_iterations=0), rw.errors.OptionError, "max_iterations=0"),
        (
            lambda: RefineOptions(residual="chordal", robust="huber"),
            rw.errors.OptionError,
            "robust='huber' needs residual='geodesic'",
        ),
        (
            lambda: RefineOptions(residual="chordal", time_offsets=True),
            rw.errors.OptionError,
            "time_offsets=True needs residual='geodesic'",
        ),
        (
            lambda: RefineOptions(carrier_path=Trajectory.of([1, 2], np.tile(np.eye(4), (2, 1, 1)))),
            rw.errors.OptionError,
            "carrier_path has no use without time_offsets",
        ),
    ],
)
def test_refused(call: Callable[[], Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call()


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda r: r.covariance("cam"), "there is no 'cam'; there are target0"),
        (lambda r: r.covariance("scale"), "'scale' is not an unknown: it is known, 1"),
        (lambda r: r.standard_deviations("scale"), "'scale' is not a frame and has no axes"),
        (lambda r: r.information("cam"), "'cam' is not among the unknowns"),
        (lambda r: r.contains("cam", np.eye(4)), "there is no frame 'cam'"),
    ],
)
def test_unknown_names(ask: Callable[[rw.Refined], Any], words: str) -> None:
    with pytest.raises(rw.errors.FrameError, match=words):
        ask(rw.refine(PROBLEM, SOLUTION))


def test_bad_confidence() -> None:
    with pytest.raises(rw.errors.OptionError, match="confidence=95"):
        rw.refine(PROBLEM, SOLUTION).squared_radius(6, 95)


@pytest.mark.parametrize("name", ["scale", "scale:tag", "time_offset:cam"])
def test_frame_names_that_are_names_of_scales_or_offsets(name: str) -> None:
    raw = PROBLEM.measurements("target0", "sensor0")
    problem = rw.Problem(scale="shared")
    problem.add(name, "sensor0", raw.A, raw.B, SIGMA_M, KAPPA)
    with pytest.raises(rw.errors.FrameError, match=f"the frame name '{name}'"):
        rw.refine(problem, rw.solve(problem))


def test_information_of_one_name_twice() -> None:
    with pytest.raises(rw.errors.FrameError, match="give each name once"):
        rw.refine(PROBLEM, SOLUTION).information("target0", "target0")


def test_groups_of_pairs_are_not_confused_by_dashes() -> None:
    """a-b with c, and a with b-c, are two pairs."""
    problem = rw.Problem()
    for (target, sensor), (pair, sigma) in zip(
        (("a-b", "c"), ("a", "b-c")), ((PROBLEM.pairs[0], 0.005), (PROBLEM.pairs[3], 0.5)), strict=True
    ):
        raw = PROBLEM.measurements(*pair)
        B = raw.B.copy()
        B[:, :3, 3] += np.random.default_rng(0).normal(0.0, sigma, (len(B), 3))
        problem.add(target, sensor, raw.A, B, SIGMA_M, KAPPA)
    r = refined(problem, noise="estimate", noise_groups="pair")
    assert r.noise["a", "b-c"].translation_m > 10.0 * r.noise["a-b", "c"].translation_m


@pytest.mark.parametrize("copy_of", [pickle.dumps, copy.deepcopy])
def test_copies_are_refused(copy_of: Callable[[object], object]) -> None:
    with pytest.raises(TypeError, match="write_refined"):
        copy_of(rw.refine(PROBLEM, SOLUTION))
