"""The search by its methods, and the options that it takes."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from small_problems import GROSS_NOISE, SCALES, searched, simulated, solved

import gtsam_rwhec as rw
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.solver.certificate import Cause, Start, Status
from gtsam_rwhec.solver.rotations import random_rotations
from gtsam_rwhec.solver.solve_options import SolveOptions


class TestMethods:
    @pytest.mark.parametrize("scale", SCALES)
    @pytest.mark.parametrize("sides", [(1, 1), (3, 2), (4, 3)])
    def test_sdp_agrees_with_auto(self, sides: tuple[int, int], scale: ScaleMode) -> None:
        problem = simulated(*sides, 2, scale=scale).problem
        auto, sdp = solved(problem), solved(problem, "sdp")
        assert sdp.certificate.path.start is (Start.CLARABEL if sum(sides) <= 5 else Start.INTERIOR_POINT)
        assert "semidefinite relaxation" in sdp.certificate.seconds
        assert sdp.certificate.is_certified
        assert sdp.cost == pytest.approx(auto.cost, rel=1e-10)

    def test_local_descends_from_where_it_is_told(self) -> None:
        simulation = simulated(2, 2, 5)
        for method_of_start in (simulation, solved(simulation.problem)):
            initial = (method_of_start.X, method_of_start.Y, 1.0)
            solution = rw.solve(simulation.problem, method="local", initial=initial)
            assert solution.certificate.path.start is Start.GIVEN
            assert solution.certificate.is_certified
            assert "spectral start" not in solution.certificate.seconds

    def test_local_stays_in_a_local_minimum_and_does_not_certify_it(self) -> None:
        """A valley that is not the lowest, found with random starts, given to "local"."""
        problem = simulated(1, 1, 2, noise=GROSS_NOISE, number_of_measurements=4).problem
        best = searched(problem).run("auto", None)
        search = searched(problem)
        generator = np.random.default_rng(0)
        stuck = max(
            (search.run("local", random_rotations(2, generator)) for _ in range(20)), key=lambda found: found.cost
        )
        assert stuck.cost > best.cost + 1e-3
        assert stuck.bound.lower_bound <= best.cost
        assert not stuck.is_closed
        assert stuck.cause is Cause.LOCAL_MINIMUM_POSSIBLE

    @pytest.mark.parametrize("scale", SCALES)
    def test_certify_proves_the_optimum_and_finds_worse_answers_out(self, scale: ScaleMode) -> None:
        simulation = simulated(2, 2, 6, scale=scale)
        solution = solved(simulation.problem)
        optimal = rw.certify(simulation.problem, solution.X, solution.Y, solution.scale)
        assert optimal.is_certified
        assert optimal.cause is Cause.PROVEN
        assert optimal.cost == pytest.approx(solution.cost, rel=1e-9)
        truth = rw.certify(simulation.problem, simulation.X, simulation.Y, simulation.scale)
        assert truth.status is Status.GAP
        assert truth.cost > solution.cost
        assert truth.cause is Cause.BETTER_ANSWER
        assert truth.figures["better_cost"] == pytest.approx(solution.cost)
        assert truth.lower_bound <= solution.cost

    def test_more_frames_than_the_dense_methods_take_are_said(self) -> None:
        """Three frames that all need one another, where the dense methods may have two."""
        seen = Counter[str]()
        for seed in range(8):
            problem = simulated(2, 1, seed, noise=GROSS_NOISE, number_of_measurements=4).problem
            certificate = solved(problem, max_dense_frames=2).certificate
            if not certificate.is_optimal:
                assert certificate.cause in (Cause.TOO_LARGE, Cause.PART_NOT_TIGHT)
                assert "3 unknown frames" in certificate.reason
                assert "max_dense_frames = 2" in certificate.reason
            seen[certificate.cause] += 1
            allowed = solved(problem, max_dense_frames=3).certificate
            assert allowed.lower_bound >= certificate.lower_bound - 1e-6 * certificate.cost
        assert seen[Cause.TOO_LARGE] >= 2

    def test_stages_are_told_and_timed(self) -> None:
        told: list[str] = []
        certificate = rw.solve(simulated(2, 1).problem, progress=told.append).certificate
        assert told[:4] == ["quadratic form", "spectral start", "descent", "dual certificate"]
        assert set(told) == set(certificate.seconds)
        assert all(duration >= 0.0 for duration in certificate.seconds.values())


class TestOptions:
    @pytest.mark.parametrize("name", [name for name in vars(SolveOptions()) if name != "nonnegative_scale"])
    @pytest.mark.parametrize("value", [-1, np.nan, np.inf])
    def test_every_number_is_checked(self, name: str, value: float) -> None:
        with pytest.raises(rw.errors.OptionError, match=f"SolveOptions.{name}="):
            SolveOptions(**{name: value})

    def test_zero_is_allowed_where_it_means_something(self) -> None:
        SolveOptions(random_starts=0, seed=0)
        with pytest.raises(rw.errors.OptionError, match="relative_tolerance"):
            SolveOptions(relative_tolerance=0.0)

    def test_methods_and_what_goes_with_them(self) -> None:
        simulation = simulated(1, 1)
        with pytest.raises(rw.errors.OptionError, match="'fast'"):
            rw.solve(simulation.problem, method="fast")
        with pytest.raises(rw.errors.OptionError, match="needs initial"):
            rw.solve(simulation.problem, method="local")
        with pytest.raises(rw.errors.OptionError, match="is for method='local'"):
            rw.solve(simulation.problem, initial=(simulation.X, simulation.Y, 1.0))
        with pytest.raises(rw.errors.OptionError, match="shared scale"):
            rw.solve(simulation.problem, options=SolveOptions(nonnegative_scale=True))
        with pytest.raises(rw.errors.FrameError, match="has no pose of 'sensor0'"):
            rw.solve(simulation.problem, method="local", initial=(simulation.X, {}, 1.0))

    def test_a_looser_tolerance_calls_more_certified(self) -> None:
        problem = next(
            problem
            for problem in (
                simulated(1, 1, seed, noise=GROSS_NOISE, number_of_measurements=4).problem for seed in range(60)
            )
            if solved(problem).certificate.status is Status.GAP
        )
        gap = solved(problem).certificate.relative_gap
        assert solved(problem, relative_tolerance=2.0 * gap).certificate.is_optimal
        assert not solved(problem, relative_tolerance=0.5 * gap).certificate.is_optimal
