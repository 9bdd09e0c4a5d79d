"""The search takes every path, and its claims hold: against random starts, Clarabel, exact data and small noise."""

from __future__ import annotations

import tracemalloc
import warnings
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from random_starts import assert_never_beaten
from small_problems import (
    GROSS_NOISE,
    SCALES,
    SMALL_NOISE,
    flat,
    optimum,
    reduced,
    searched,
    simulated,
    solved,
    true_rotations,
)

import gtsam_rwhec as rw
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Motion, Noise
from gtsam_rwhec.solver.certificate import Cause, Multipliers, SearchPath, Start, Status
from gtsam_rwhec.solver.relaxation import solve_by_clarabel
from gtsam_rwhec.solver.search import Found, Search
from gtsam_rwhec.solver.solve_options import SolveOptions


class TestEasyProblems:
    @pytest.mark.parametrize("scale", SCALES)
    @pytest.mark.parametrize("sides", [(1, 1), (3, 2), (2, 5), (1, 8)])
    def test_the_first_multipliers_suffice(self, sides: tuple[int, int], scale: ScaleMode) -> None:
        certificate = solved(simulated(*sides, 1, scale=scale).problem).certificate
        assert certificate.path == SearchPath(Start.SPECTRAL, Multipliers.KKT)
        assert certificate.status is Status.CERTIFIED
        assert certificate.relative_gap < 1e-9
        assert "small dual" not in certificate.seconds
        assert "semidefinite relaxation" not in certificate.seconds

    @pytest.mark.parametrize("noise", [Noise(1e-3, 1e5), Noise(0.01, 6500.0), Noise(0.03, 500.0)])
    @pytest.mark.parametrize("sides", [(1, 1), (2, 1), (2, 2), (3, 3)])
    def test_proposition_7_tight_near_exact_identifiable_data(self, sides: tuple[int, int], noise: Noise) -> None:
        """Every one of many draws is certified, up to two degrees and three centimetres."""
        for seed in range(12):
            certificate = solved(simulated(*sides, seed, noise=noise).problem).certificate
            assert certificate.status is Status.CERTIFIED
            assert certificate.relative_gap < 1e-7

    @pytest.mark.parametrize("scale", SCALES)
    def test_proposition_7_the_relaxation_itself_has_rank_one(self, scale: ScaleMode) -> None:
        for seed in range(3):
            problem = simulated(2, 1, seed, scale=scale).problem
            form, best = reduced(problem), optimum(problem)
            relaxation = solve_by_clarabel(form.Q, 1e-9, 100)
            assert relaxation.dual == pytest.approx(best.cost, abs=1e-7 * form.magnitude)
            np.testing.assert_allclose(relaxation.X[:-1, -1], flat(best.R), atol=1e-3)

    @pytest.mark.parametrize("scale", SCALES)
    @pytest.mark.parametrize("method", ["auto", "sdp"])
    def test_exact_data_give_the_truth_and_a_certificate(self, method: str, scale: ScaleMode) -> None:
        simulation = simulated(2, 2, 4, noise=None, scale=scale)
        solution = solved(simulation.problem, method)
        assert solution.certificate.is_certified
        assert solution.certificate.gap < 1e-9
        errors = simulation.errors(solution)
        assert max(e.rotation_rad for e in (errors.X | errors.Y).values()) < 1e-8
        assert max(e.translation_m for e in (errors.X | errors.Y).values()) < 1e-8


@cache
def gross(scale: ScaleMode) -> list[tuple[Search, Found]]:
    """Sixty degrees about each axis and half a metre, four measurements a pair: every path is needed somewhere."""
    results = []
    for sides, seeds in (((1, 1), 45), ((2, 1), 12)):
        for seed in range(seeds):
            noise = {"noise": GROSS_NOISE, "number_of_measurements": 4}
            search = searched(simulated(*sides, seed, scale=scale, **noise).problem)
            results.append((search, search.run("auto", None)))
    return results


class TestGrossNoise:
    @pytest.mark.parametrize("scale", ["known", "shared"])
    def test_every_path_is_taken(self, scale: ScaleMode) -> None:
        paths = Counter(str(found.path) for _, found in gross(scale))
        for path in ("spectral start, small dual", "better start, small dual"):
            assert paths[path] >= 2
        assert paths["spectral start, dual"]
        assert any(not found.is_closed for _, found in gross(scale))

    @pytest.mark.parametrize("scale", ["known", "shared"])
    def test_no_answer_is_beaten_by_random_starts(self, scale: ScaleMode) -> None:
        for search, found in gross(scale):
            assert_never_beaten(search, found, 60)

    @pytest.mark.parametrize("scale", ["known", "shared"])
    def test_what_is_not_tight_has_the_relaxations_own_bound(self, scale: ScaleMode) -> None:
        """By Clarabel, apart from the search: the gap is the relaxation's, no lack of effort."""
        for search, found in gross(scale):
            if found.is_closed:
                continue
            bound = solve_by_clarabel(search.whole.reduced.Q, 1e-9, 200).dual
            assert found.cause is Cause.NOT_TIGHT
            assert found.figures["relaxation_cost"] == pytest.approx(bound, abs=1e-3 * max(found.cost, 1.0))
            assert found.bound.lower_bound == pytest.approx(bound, abs=1e-3 * max(found.cost, 1.0))
            assert found.bound.lower_bound < found.cost - found.tolerance

    def test_a_gap_is_said_to_be_one(self) -> None:
        """Known from the draws above: rotation noise of sixty degrees about each axis and four measurements."""
        gaps = 0
        for seed in range(28, 46):
            problem = simulated(1, 1, seed, noise=GROSS_NOISE, number_of_measurements=4).problem
            with warnings.catch_warnings(record=True, action="always") as caught:
                solution = rw.solve(problem)
            certificate = solution.certificate
            said = any(issubclass(w.category, rw.errors.NotCertifiedWarning) for w in caught)
            assert said == (not certificate.is_optimal)
            if certificate.status is not Status.GAP:
                continue
            gaps += 1
            assert certificate.lower_bound < certificate.cost
            assert certificate.relative_gap > 1e-6
            assert certificate.cause is Cause.NOT_TIGHT
            assert "the relaxation is not tight: its own optimum is" in certificate.reason
            assert certificate.min_eigenvalue < 0.0
        assert gaps >= 1

    def test_without_random_starts_the_relaxation_leads_to_the_optimum(self) -> None:
        """Both ways to leave a local minimum end at the same cost."""
        led = 0
        for seed in range(22, 40):
            problem = simulated(1, 1, seed, noise=GROSS_NOISE, number_of_measurements=4).problem
            search = searched(problem, random_starts=0)
            found = search.run("auto", None)
            if found.path.start is Start.CLARABEL and found.is_closed:
                led += found.cause is Cause.PROVEN_AFTER_LOCAL_MINIMUM
                assert_never_beaten(search, found, 60)
        assert led >= 1

    @pytest.mark.parametrize("method", ["auto", "sdp"])
    def test_the_same_problem_gives_the_same_answer(self, method: str) -> None:
        problem = simulated(2, 1, 3, noise=GROSS_NOISE, number_of_measurements=4).problem
        first, second = (searched(problem).run(method, None) for _ in range(2))
        np.testing.assert_array_equal(first.R, second.R)
        assert (first.cost, first.bound.lower_bound, first.path) == (second.cost, second.bound.lower_bound, second.path)


class TestWhatCertifiedMeans:
    @pytest.mark.parametrize("kappa", [1e6, 1e10, 1e14])
    def test_a_tight_prior_does_not_loosen_it(self, kappa: float) -> None:
        """The form's entries grow with a prior's weight; the gap that counts as none must not grow with them."""
        simulation = simulated(2, 2, 3)
        simulation.problem.add_prior("sensor0", simulation.Y["sensor0"], sigma=kappa**-0.5, kappa=kappa)
        certificate = solved(simulation.problem).certificate
        assert certificate.is_certified
        rounding = 1e-14 * reduced(simulation.problem).magnitude * 37  # of a form of this size, 37 x 37
        assert certificate.tolerance <= max(1e-6 * certificate.cost, rounding)
        assert certificate.gap <= max(1e-6 * certificate.cost, 1e-2 * rounding)

    @pytest.mark.parametrize("count", [10, 1000])
    def test_a_million_times_the_information_neither(self, count: int) -> None:
        problem = simulated(2, 1, 0, noise=Noise(1e-4, 1e6), number_of_measurements=count).problem
        certificate = solved(problem).certificate
        assert certificate.is_certified
        assert certificate.gap <= 1e-6 * certificate.cost

    @pytest.mark.parametrize("scale", ["known", "shared"])
    @pytest.mark.parametrize("noise", [None, Noise(0.01, 6500.0), Noise(1e-3, 1e5)])
    def test_planar_rigs_of_many_frames_are_certified_not_unique(self, noise: Noise | None, scale: ScaleMode) -> None:
        """Free directions make Z singular; the proof of semidefiniteness must not give the certificate away."""
        problem = simulated(12, 6, 1, motion="planar", noise=noise, scale=scale).problem
        certificate = solved(problem).certificate
        assert certificate.status is Status.CERTIFIED_NOT_UNIQUE
        assert certificate.cause is Cause.FREE_DIRECTIONS

    def test_a_certificate_is_about_the_optimum_not_about_the_truth(self) -> None:
        simulation = simulated(2, 1, 8, noise=Noise(0.05, 300.0))
        search = searched(simulation.problem)
        found = search.run("auto", None)
        x = np.append(flat(true_rotations(simulation)), 1.0)
        assert found.bound.lower_bound <= x @ search.form.apply(x)


def peak_memory(problem: rw.Problem) -> int:
    search = searched(problem)
    tracemalloc.start()
    found = search.run("auto", None)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.is_closed
    return peak


@pytest.mark.parametrize("targets_are_leaves", [True, False])
@pytest.mark.parametrize("scale", ["known", "shared"])
def test_a_star_takes_memory_in_proportion_to_its_leaves(scale: ScaleMode, targets_are_leaves: bool) -> None:
    """Four times the leaves take four times the memory, so nothing is stored, or worked on, for pairs of leaves.

    Time is examples/sparsity.py's and the benchmarks'.
    """

    def star(leaves: int) -> rw.Problem:
        sides = (leaves, 1) if targets_are_leaves else (1, leaves)
        return simulated(*sides, 0, number_of_measurements=5, scale=scale, keep_measurements=False).problem

    assert peak_memory(star(400)) < 4.5 * peak_memory(star(100))


def test_one_turn_axis_and_motion_without_turns_are_never_called_unique() -> None:
    for motion in (Motion("single_axis"), Motion("planar"), Motion("none")):
        certificate = solved(simulated(2, 1, 0, motion=motion).problem).certificate
        assert certificate.status is Status.CERTIFIED_NOT_UNIQUE


def test_a_known_sensor_with_motions_of_its_own_tells_the_scale() -> None:
    """An edge both of whose ends are known: nothing but the scale hangs on it."""
    simulation = simulated(2, 1, odometry=5, odometry_noise=Noise(0.01, 1e4), scale="shared")
    simulation.problem.fix("sensor0", simulation.Y["sensor0"])
    solution = solved(simulation.problem)
    assert solution.certificate.is_certified
    assert solution.scale == pytest.approx(0.5, rel=0.05)


def test_a_mirror_image_is_never_called_proven_with_an_open_gap() -> None:
    """Whatever the cause, a gap that is open is said to be one: seeds at which noise decides the sign of the scale."""
    for seed in range(12):
        problem = simulated(2, 2, seed, motion="planar", scale="shared", noise=Noise(0.05, 50.0)).problem
        search = searched(problem)
        found = search.with_positive_scale(search.run("auto", None))
        assert found.is_closed == (found.cause.status is not rw.Status.GAP)


def test_with_every_frame_fixed_the_cost_is_its_own_bound() -> None:
    simulation = simulated(1, 1, odometry=4, odometry_noise=SMALL_NOISE)
    problem = rw.Problem()
    raw = simulation.problem.measurements("sensor0", "sensor0")
    problem.add_motion("sensor0", raw.A, raw.B, raw.sigma, raw.kappa)
    problem.fix("sensor0", simulation.Y["sensor0"])
    certificate = rw.solve(problem).certificate
    assert certificate.is_certified
    assert certificate.relative_gap < 1e-12


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


class TestOptions:
    def test_zero_is_allowed_where_it_means_something(self) -> None:
        SolveOptions(random_starts=0, seed=0)
        with pytest.raises(rw.errors.OptionError, match="relative_tolerance"):
            SolveOptions(relative_tolerance=0.0)

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


def pair_alone(problem: rw.Problem, target: str, sensor: str) -> rw.Problem:
    data = problem.measurements(target, sensor)
    alone = rw.Problem(scale="known")
    alone.add(target, sensor, data.A, data.B, sigma=1.0, kappa=1.0)
    return alone


@cache
def real_dataset(folder: Path) -> rw.Problem:
    return rw.read_csv(folder, scale="known", sigma=1.0, kappa=1.0)


class TestRealDataset:
    def test_auto_certifies_the_papers_optimum(self, utias_folder: Path) -> None:
        certificate = solved(real_dataset(utias_folder)).certificate
        assert certificate.status is Status.CERTIFIED
        assert certificate.cost == pytest.approx(8.2812454, abs=5e-8)
        assert certificate.relative_gap < 1e-10
        assert certificate.float_gap < 1e-12
        assert certificate.path == SearchPath(Start.SPECTRAL, Multipliers.KKT)

    def test_sdp_finds_the_same(self, utias_folder: Path) -> None:
        certificate = solved(real_dataset(utias_folder), "sdp").certificate
        assert certificate.status is Status.CERTIFIED
        assert certificate.cost == pytest.approx(8.2812454, abs=5e-8)
        assert certificate.path.start is Start.INTERIOR_POINT

    @pytest.mark.parametrize("share", range(4))
    def test_each_pair_alone_is_proven_and_none_is_beaten(self, utias_folder: Path, share: int) -> None:
        """A quarter of the 73 pairs each time, a hundred random starts a pair."""
        for target, sensor in real_dataset(utias_folder).pairs[share::4]:
            alone = pair_alone(real_dataset(utias_folder), target, sensor)
            search = searched(alone)
            found = search.run("auto", None)
            assert_never_beaten(search, found, 100)
            solution = solved(alone)
            assert solution.certificate.is_certified or not solution.identifiability.is_unique
            assert solution.certificate.is_optimal

    def test_nine_pairs_need_more_than_the_first_multipliers(self, utias_folder: Path) -> None:
        causes = Counter[Cause]()
        problem = real_dataset(utias_folder)
        for target, sensor in problem.pairs:
            causes[searched(pair_alone(problem, target, sensor)).run("auto", None).cause] += 1
        assert causes[Cause.PROVEN] == 64
        assert causes[Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS] == 8
        assert causes[Cause.PROVEN_AFTER_LOCAL_MINIMUM] == 1
        assert causes.total() == 73

    def test_one_pair_has_a_local_minimum(self, utias_folder: Path) -> None:
        alone = pair_alone(real_dataset(utias_folder), "tag_22", "cam_6")
        certificate = solved(alone).certificate
        assert certificate.path.start is Start.BETTER
        assert certificate.is_optimal
        assert searched(alone).run("auto", None).cause is Cause.PROVEN_AFTER_LOCAL_MINIMUM
        from_spectral = optimum(alone)
        assert from_spectral.converged
        assert from_spectral.cost > certificate.cost * 1.001
        # certify() says of that local minimum what it is.
        stuck = searched(alone).run("local", from_spectral.R)
        assert stuck.cost == pytest.approx(from_spectral.cost)
        assert stuck.bound.lower_bound < stuck.cost
