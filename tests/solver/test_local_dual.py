"""The dense methods of a few among many frames: Schur complements, what they prove, and what they do not."""

from __future__ import annotations

import numpy as np
import pytest
from large_problems import loop, optimum_of_star
from small_problems import GROSS_NOISE, flat, kkt_of, optimum, simulated, whole

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import Evaluation
from gtsam_rwhec.solver.bound import lower_bound
from gtsam_rwhec.solver.certificate import Cause, Multipliers
from gtsam_rwhec.solver.descent import descend, spectral_start
from gtsam_rwhec.solver.local_dual import (
    OF_Q,
    OF_Z,
    LocalForm,
    helpful_frames,
    improve_locally,
    local_form,
    own_curvature,
    relax_locally,
    rotation_rows,
)
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.relaxation import solve_relaxation
from gtsam_rwhec.solver.rotations import random_rotations
from gtsam_rwhec.solver.solve_options import SolveOptions


def form_of(form: PartForm, R: Array, frames: list[int]) -> tuple[LocalForm, Evaluation, Array]:
    """The local form of some frames at the answer near R, with the multipliers of R'R = I."""
    _, evaluation = form.answer_near(R)
    kkt = kkt_of(evaluation)
    diagonal = np.abs(form.curvature.diagonal)
    Q, Z = form.curvature.plus(OF_Q * diagonal), form.curvature.less(kkt).plus(OF_Z * diagonal)
    found = local_form(Q, Z, evaluation, kkt, np.array(frames))
    assert found is not None
    return found, evaluation, kkt


def at_optimum_of_star() -> tuple[PartForm, Evaluation, Array]:
    """The star's form, the cost where its search ends, and the multipliers of R'R = I there."""
    search, found = optimum_of_star(1)
    _, evaluation = search.whole.answer_near(found.R)
    return search.whole, evaluation, kkt_of(evaluation)


@pytest.mark.parametrize("frames", [[1], [0, 3], [0, 1, 2, 3, 4]])
def test_the_local_form_is_the_schur_complement(frames: list[int]) -> None:
    simulation = simulated(3, 2, 1)
    form = whole(simulation.problem)
    local, evaluation, kkt = form_of(form, optimum(simulation.problem).R, frames)
    dense = form.curvature.less(kkt).matrix.dense()
    rows = rotation_rows(np.array(frames))
    rest = np.setdiff1d(np.arange(len(dense)), rows)
    expected = dense[np.ix_(rows, rows)] - dense[np.ix_(rows, rest)] @ np.linalg.solve(
        dense[np.ix_(rest, rest)], dense[np.ix_(rest, rows)]
    )
    scale = np.abs(np.diagonal(dense)).max()
    np.testing.assert_allclose(local.Z[:-1, :-1], expected, atol=1e-9 * scale)
    x = np.append(flat(local.R), 1.0)
    np.testing.assert_allclose(local.Z @ x, 0.0, atol=1e-9 * scale)
    # Everything follows to where it is at the point itself.
    followed = local.follow @ x
    here = np.append(evaluation.point.numbers.ravel(), evaluation.point.alpha)
    np.testing.assert_allclose(followed[:-1], here[:-1], atol=1e-6)


class TestManyFrames:
    def test_a_few_frames_prove_what_all_multipliers_of_orthogonality_do_not(self) -> None:
        search, found = optimum_of_star(1)
        assert found.is_closed
        assert found.cause is Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS
        assert found.path.multipliers is Multipliers.ALL_CONSTRAINTS
        _, evaluation = search.whole.answer_near(found.R)
        kkt = kkt_of(evaluation)
        assert lower_bound(search.whole, evaluation, kkt).lower_bound < 0.9 * found.cost
        local = improve_locally(search.whole, evaluation, kkt, 120)
        assert local.t > 0.0
        changed = np.flatnonzero((local.multipliers != kkt).any(axis=1))
        assert local.form is not None
        np.testing.assert_array_equal(changed, local.form.frames)
        assert 0 < len(changed) <= 20

    def test_fewer_frames_than_it_takes_are_too_large(self) -> None:
        form, evaluation, kkt = at_optimum_of_star()
        local = improve_locally(form, evaluation, kkt, 1)
        assert local.t <= 0.0
        assert local.needed > 1

    def test_the_frames_that_help_are_others(self) -> None:
        form, evaluation, kkt = at_optimum_of_star()
        local = improve_locally(form, evaluation, kkt, 120).form
        assert local is not None
        more = helpful_frames(form, evaluation, local, local.kkt, -1e-3)
        assert len(more) > 0
        assert not np.isin(more, local.frames).any()

    def test_what_is_not_tight_is_not_proven(self) -> None:
        """Of nine frames hardly anything is known of three: all constraints of these prove less than the cost."""
        search = loop(32, targets=5, max_dense_frames=8)
        found = search.run("auto", None)
        assert not found.is_closed
        assert found.cause is Cause.PART_NOT_TIGHT
        assert found.bound.lower_bound < found.cost * (1.0 - 1e-3)
        assert found.figures["frames"] == 9
        assert found.figures["relaxed"] <= 8
        assert "all 9 unknown frames" in found.cause.sentence(found.figures | {"cost": found.cost})

    def test_a_local_minimum_of_many_frames_is_left(self) -> None:
        """The spectral start leads to a local minimum, which "local" does not prove; "auto" finds what is proven."""
        search = loop(7, targets=120)
        stuck, best = search.run("local", None), search.run("auto", None)
        assert not stuck.is_closed
        assert best.is_closed
        assert best.cause is Cause.PROVEN_AFTER_LOCAL_MINIMUM
        assert stuck.bound.lower_bound <= best.cost < stuck.cost * (1.0 - 1e-3)


def test_own_curvature_is_one_without_multipliers_and_negative_at_a_wrong_point() -> None:
    form = whole(simulated(3, 2, 1).problem)
    np.testing.assert_allclose(own_curvature(form, np.zeros((5, 20))), 1.0)
    _, evaluation = form.answer_near(random_rotations(5, np.random.default_rng(0)))
    assert own_curvature(form, kkt_of(evaluation)).min() < 0.0


class TestLocalRelaxation:
    def test_it_leaves_a_local_minimum(self) -> None:
        search = loop(7, targets=120)
        end = min(
            (descend(search.form, R, 200) for R in spectral_start(search.part, search.whole.rotation)),
            key=lambda end: end.cost,
        )
        _, evaluation = search.whole.answer_near(end.R)
        kkt = kkt_of(evaluation)
        form = improve_locally(search.whole, evaluation, kkt, 120).form
        assert form is not None
        relaxed = relax_locally(evaluation, kkt, form, SolveOptions())
        assert min(descend(search.form, R, 200).cost for R in relaxed.starts) < end.cost * (1.0 - 1e-3)

    @pytest.mark.parametrize("seed", range(2))
    def test_of_all_frames_it_is_the_relaxation(self, seed: int) -> None:
        problem = simulated(2, 1, seed, noise=GROSS_NOISE, number_of_measurements=4).problem
        form = whole(problem)
        local, evaluation, kkt = form_of(form, optimum(problem).R, [0, 1, 2])
        relaxed = relax_locally(evaluation, kkt, local, SolveOptions())
        expected = solve_relaxation(form.reduced.Q, 1e-9, 100)
        assert relaxed.dual == pytest.approx(expected.dual, rel=1e-5)
        assert all(R.shape == (3, 3, 3) for R in relaxed.starts)

    def test_of_a_few_it_is_a_lower_bound(self) -> None:
        _, found = optimum_of_star(1)
        form, evaluation, kkt = at_optimum_of_star()
        local = improve_locally(form, evaluation, kkt, 120).form
        assert local is not None
        relaxed = relax_locally(evaluation, kkt, local, SolveOptions())
        assert relaxed.dual == pytest.approx(found.cost, rel=1e-6)
        bound = lower_bound(form, evaluation, relaxed.multipliers)
        assert found.cost * (1.0 - 1e-5) <= bound.lower_bound <= found.cost
        np.testing.assert_allclose(relaxed.starts[0], found.R, atol=1e-3)
