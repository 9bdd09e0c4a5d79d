"""The search on the real dataset: the paper's optimum, and each of its 73 pairs alone."""

from __future__ import annotations

from collections import Counter
from functools import cache
from pathlib import Path

import pytest
from random_starts import assert_never_beaten
from small_problems import optimum, searched, solved

import gtsam_rwhec as rw
from gtsam_rwhec.solver.certificate import Cause, Multipliers, SearchPath, Start, Status


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
