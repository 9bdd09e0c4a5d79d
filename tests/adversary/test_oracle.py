"""The oracle itself: it encloses what is exact, and it finds claims that are false by the last digits."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import quaternion_pairs as quaternions
from double_double import Pairs
from exact_cost import RationalPoses, exact_cost
from given_rows import given_rows
from naive_cost import naive_cost
from oracle import STEPS, centres, judged
from pair_descent import PairDescent, Region
from seeded_case import Case
from seeded_problems import KINDS, seeded
from stated_cost import Poses, Rows, StatedCost

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.problem.moments import Gauge


@dataclass
class Solved:
    case: Case
    problem: rw.Problem
    rows: Rows
    solution: rw.Solution

    @property
    def matrices(self) -> dict[str, np.ndarray]:
        return {name: pose.matrix() for name, pose in {**self.solution.X, **self.solution.Y}.items()}

    @property
    def parts(self) -> list[tuple[tuple[str, ...], Any]]:
        return [(part.names, part.certificate) for part in self.solution.parts]

    def judged(self, **changes: Any) -> set[str]:
        """The kinds of violations where the certificate is changed; any gap is within the tolerance."""
        certificate = replace(self.solution.certificate, **({"tolerance": np.inf} | changes))
        verdict = judged(
            self.case, self.problem, self.rows, certificate, self.matrices, self.solution.scale, self.parts
        )
        return {violation.kind for violation in verdict.violations}


def solved(seeds: range, *, sane: bool, kind: str = "", most: int = 1000) -> Iterator[Solved]:
    """Problems of seeds that can be solved, of one kind if it is named, with at most so many measurements."""
    for seed in seeds:
        case = seeded(seed, sane=sane)
        size = sum(len(batch.A) for batch in case.batches)
        if not case.is_exact or not case.keep_measurements or size > most or (kind and case.kind != kind):
            continue
        with warnings.catch_warnings(action="ignore"):
            try:
                problem = case.problem()
                solution = case.solution(problem)
            except RwhecError:
                continue
        yield Solved(case, problem, given_rows(case, problem), solution)


def stated(one: Solved, form: str | None = None, gauge: Gauge | None = None) -> tuple[StatedCost, Poses]:
    rows = one.rows
    poses = Poses.of(rows, one.matrices, one.solution.scale)
    form = form or one.solution.certificate.objective.form
    centre = np.full((len(rows.frames), 3), np.nan)
    if gauge is not None:
        for x, y in zip(rows.X, rows.Y, strict=True):
            centre[x] = gauge.sensor_carrier if x == y else gauge.target_carrier
    elif form == "inverse":
        centre = centres(one.problem, rows, one.parts)
    return StatedCost(rows, form, poses.t, centre), poses


def test_the_enclosure_holds_the_exact_cost_and_is_narrow() -> None:
    rng = np.random.default_rng(3)
    seen = set()
    for one in solved(range(40), sane=False, most=16):
        mode = one.case.scale
        for form in ["direct"] * (mode != "per_target") + ["inverse"] * (mode != "known"):
            gauge = Gauge(rng.standard_normal(3), rng.standard_normal(3))
            cost, poses = stated(one, form, gauge)
            enclosure = cost.of_poses(poses)
            exact = exact_cost(cost.rows, form, cost.centre, RationalPoses.of(poses))
            value = Fraction(float(enclosure.value.hi[0])) + Fraction(float(enclosure.value.lo[0]))
            assert abs(value - exact) <= Fraction(float(enclosure.error[0]))
            assert enclosure.error[0] <= 1e-12 * float(exact) + 1e-20
            seen.add(form)
    assert seen == {"direct", "inverse"}


def test_the_exact_cost_is_the_papers() -> None:
    for one in solved(range(30), sane=True, most=12):
        gauge = Gauge(np.array([0.3, -0.2, 0.1]), np.array([-0.1, 0.4, 0.2]))
        form = "direct" if one.case.scale != "per_target" else "inverse"
        cost, poses = stated(one, form, gauge)
        if one.solution.cost < 1e-3:
            continue
        exact = float(exact_cost(cost.rows, form, cost.centre, RationalPoses.of(poses)))
        X = {name: T for name, T in one.matrices.items() if name in one.problem.targets}
        Y = {name: T for name, T in one.matrices.items() if name in one.problem.sensors}
        assert naive_cost(one.problem, X, Y, one.solution.scale, form, gauge) == pytest.approx(exact, rel=1e-5)


def test_rotations_of_pairs_are_rotations_exactly() -> None:
    q = np.random.default_rng(0).standard_normal(4)
    R = quaternions.exactly([Fraction(v) for v in q.tolist()])
    for i in range(3):
        for j in range(3):
            assert sum(R[k][i] * R[k][j] for k in range(3)) == (i == j)
    near = quaternions.rotations(Pairs.of(q[None]))
    for i in range(3):
        for j in range(3):
            value = Fraction(float(near.hi[0, i, j])) + Fraction(float(near.lo[0, i, j]))
            assert abs(value - R[i][j]) < Fraction(1, 2**98)


def test_answers_in_pairs_cost_what_their_fractions_cost() -> None:
    forms = set()
    for one in solved(range(60), sane=True, most=6):
        cost, poses = stated(one)
        if not cost.rows.free:
            continue
        descent = PairDescent(cost, poses, None)
        answers, value = descent.descend(descent.answers([poses]), 2)
        exact = exact_cost(cost.rows, cost.form, cost.centre, descent.rational(answers, 0))
        found = Fraction(float(value.value.hi[0])) + Fraction(float(value.value.lo[0]))
        assert abs(found - exact) <= Fraction(float(value.error[0]))
        forms.add(cost.form)
    assert forms == {"direct", "inverse"}


def test_descent_ends_at_a_minimum_to_the_last_digit() -> None:
    for one in solved(range(10), sane=True):
        cost, poses = stated(one)
        if not cost.rows.free:
            continue
        descent = PairDescent(cost, poses, None)
        start = descent.answers([poses])
        _, few = descent.descend(start, STEPS)
        _, many = descent.descend(start, 25)
        assert few.value.long()[0] - many.value.long()[0] <= 1e-16 * many.value.hi[0]


def test_a_bound_above_the_least_cost_by_one_part_in_ten_to_the_thirteen_is_found() -> None:
    found = 0
    for one in solved(range(10), sane=True):
        cost, poses = stated(one)
        if not cost.rows.free or one.solution.cost < 1e-3:
            continue
        descent = PairDescent(cost, poses, None)
        _, value = descent.descend(descent.answers([poses]), 6)
        least = float(value.value.hi[0])
        kinds = one.judged(lower_bound=least * (1.0 + 1e-13), cost=2.0 * least)
        assert "bound above an answer" in kinds
        # Answers whose rotations are rounded to doubles, the returned one too, may cost a little less than this.
        assert "bound above an answer" not in one.judged(lower_bound=least * (1.0 - 1e-13), cost=2.0 * least)
        found += 1
    assert found > 5


def test_a_cost_below_the_answers_by_two_ulps_is_found() -> None:
    for one in solved(range(12), sane=True):
        cost, poses = stated(one)
        here = float(cost.of_poses(poses).value.hi[0])
        low = np.nextafter(np.nextafter(here, 0.0), 0.0)
        high = np.nextafter(here, np.inf)
        assert "cost below its answer's" in one.judged(cost=float(low), lower_bound=0.0)
        assert not one.judged(cost=float(high), lower_bound=0.0)


def test_a_local_minimum_that_claims_to_be_the_least_is_found_out() -> None:
    """A bound at the cost of another valley: the search from random starts finds the lower one."""
    found = 0
    for one in solved(range(12), sane=True):
        rng = np.random.default_rng(one.case.seed)
        q = rng.standard_normal(4)
        turn = quaternions.rotations(Pairs.of(q[None])).hi[0]
        matrices = one.matrices
        for name, T in matrices.items():
            if name not in one.problem.fixed:
                T[:3, :3] = T[:3, :3] @ turn
        rows = one.rows
        certificate = one.solution.certificate
        poses = Poses.of(rows, matrices, one.solution.scale)
        form = certificate.objective.form
        centre = centres(one.problem, rows, one.parts)
        here = float(StatedCost(rows, form, poses.t, centre).of_poses(poses).value.hi[0])
        wrong = replace(certificate, cost=here * 1.01, lower_bound=here * 0.99)
        verdict = judged(one.case, one.problem, rows, wrong, matrices, one.solution.scale, one.parts)
        if rows.free and here > 1.1 * one.solution.cost + 1e-6:
            assert "bound above an answer" in {violation.kind for violation in verdict.violations}
            assert verdict.best <= stated(one)[0].of_poses(stated(one)[1]).value.hi[0] * (1.0 + 1e-12) + 1e-12
            found += 1
    assert found > 7


def test_a_region_keeps_answers_outside_it_out_of_the_verdict() -> None:
    """One axis: answers far along it cost less, by the rounding of the measurements; not within a metre."""
    tried = 0
    for one in solved(range(100, 160), sane=False, kind="one axis"):
        if one.case.scale != "known" or not one.rows.free:
            continue
        cost, poses = stated(one)
        descent = PairDescent(cost, poses, None)
        answers, value = descent.descend(descent.answers([poses]), 12)
        gone = np.abs(descent.z_and_t(answers)[1].hi[0] - poses.t).max()
        fall = float((cost.of_poses(poses).value.long() - value.value.long())[0])
        least = float(value.value.hi[0])
        if gone < 1e3 or fall < 1e-9 * least:
            continue
        tried += 1
        small = PairDescent(cost, poses, Region(poses.t, 1.0, np.zeros(0), np.inf))
        answers, within = small.descend(small.answers([poses]), 12)
        assert np.sqrt(((small.z_and_t(answers)[1].hi[0] - poses.t) ** 2).sum(axis=1)).max() <= 1.0
        assert float(within.value.hi[0]) >= least
    assert tried


def test_the_generator_is_reproducible_and_has_every_kind() -> None:
    kinds = set()
    for seed in range(250):
        one, again = seeded(seed), seeded(seed)
        assert len(one.batches) == len(again.batches)
        for first, second in zip(one.batches, again.batches, strict=True):
            np.testing.assert_array_equal(first.A, second.A)
            np.testing.assert_array_equal(first.B, second.B)
        kinds.add(one.kind)
        if one.is_exact:
            for batch in one.batches:
                for T in (batch.A, batch.B):
                    R = T[:, :3, :3]
                    assert np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max() < 3e-15
    assert kinds == set(KINDS) | {"quarter turns", "mirror twins"}


def test_a_proof_has_finite_numbers_and_a_gap_within_its_tolerance() -> None:
    """The judge's own rules: a wide gap proves nothing, and a certificate with an infinite cost must have failed."""
    one = next(solved(range(10), sane=True))
    assert one.solution.certificate.status == "certified"
    assert "certified with a gap above the tolerance" in one.judged(lower_bound=0.0, tolerance=0.0)
    assert "not finite, and not failed" in one.judged(cost=float("inf"), lower_bound=float("inf"))
