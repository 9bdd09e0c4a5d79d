"""alpha >= 0 as a constraint (Section 4.3): its bound is about that problem, its answers have positive scales."""

from __future__ import annotations

import re

import numpy as np
import pytest
from small_problems import GROSS_NOISE, flat, kkt_of, optimum, part_of, reduced, searched, simulated, whole

import gtsam_rwhec as rw
from gtsam_rwhec.errors import OptionError, ScaleError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Noise
from gtsam_rwhec.solver.answers import answer_of
from gtsam_rwhec.solver.bound import lower_bound
from gtsam_rwhec.solver.certificate import Multipliers, SearchPath, Start
from gtsam_rwhec.solver.descent import cost_of, descend
from gtsam_rwhec.solver.nonnegative import run_with_nonnegative_scale, scale_row, scale_spread, without_scale
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.rotations import random_rotations
from gtsam_rwhec.solver.search import Found
from gtsam_rwhec.solver.solve_options import SolveOptions

HELD = SolveOptions(nonnegative_scale=True)


def noisy(seed: int) -> rw.Problem:
    """Half of these have their optimum at a negative scale."""
    return simulated(1, 1, seed, noise=GROSS_NOISE, number_of_measurements=4, scale="shared").problem


def cost_on_positive_scales(problem: rw.Problem, R: Array) -> float:
    """The cost of rotations with the best scale >= 0, from the full form: a dense solve, the scale held at zero."""
    part = part_of(problem)
    forms = PartForm.of(part)
    if answer_of(part, forms.reduced, R).scale >= 0.0:
        return cost_of(forms.reduced, R)
    Q = forms.full.dense()
    fixed = np.zeros(len(Q))
    for i, each in enumerate(flat(R).reshape(-1, 9)):
        fixed[13 * i + 4 : 13 * i + 13] = each
    fixed[-1] = 1.0
    t = np.array([13 * i + j for i in range(len(R)) for j in range(3)])
    fixed[t] = -np.linalg.pinv(Q[np.ix_(t, t)], hermitian=True) @ (Q[t] @ fixed)
    return float(fixed @ Q @ fixed)


def outcome(seed: int) -> tuple[Found | None, float, float]:
    """What is found, its cost and the bound; with none found, those of scale zero, from the message."""
    search = searched(noisy(seed), nonnegative_scale=True)
    try:
        found = run_with_nonnegative_scale(search)
    except ScaleError as error:
        cost, lower = re.search(r"\(cost (\S+), no answer below (\S+);", str(error)).groups()
        return None, float(cost), float(lower)
    return found, found.cost, found.bound.lower_bound


@pytest.mark.parametrize("seed", range(6))
def test_the_scale_comes_apart_from_the_rest_as_a_square(seed: int) -> None:
    """Full form at any scale = Q' + (alpha - row . r)^2 / spread; without_scale is that at zero."""
    problem = noisy(seed)
    form = reduced(problem)
    R = random_rotations(2, np.random.default_rng(seed))
    best_scale = scale_row(form) @ flat(R)
    assert best_scale == pytest.approx(answer_of(part_of(problem), form, R).scale)
    at_zero = cost_of(form, R) + best_scale**2 / scale_spread(form)
    assert cost_of(without_scale(form), R) == pytest.approx(at_zero)
    if best_scale < 0.0:
        assert cost_on_positive_scales(problem, R) == pytest.approx(at_zero)


@pytest.mark.parametrize("seed", range(4))
def test_any_multiplier_of_the_scale_gives_a_bound_on_positive_scales(seed: int) -> None:
    problem = noisy(seed)
    form, end = whole(problem), optimum(problem)
    _, evaluation = form.answer_near(end.R)
    multipliers = kkt_of(evaluation)
    generator = np.random.default_rng(seed)
    costs = [cost_on_positive_scales(problem, random_rotations(2, generator)) for _ in range(30)]
    costs.append(cost_on_positive_scales(problem, end.R))
    for nu in (0.0, 1e-2, 1.0, 30.0):
        bound = lower_bound(form, evaluation, multipliers, of_scale=nu)
        assert bound.lower_bound <= min(costs)


class TestSolving:
    def test_a_positive_optimum_is_left_alone(self) -> None:
        for seed in range(3):
            problem = simulated(2, 1, seed, scale="shared").problem
            held, free = rw.solve(problem, options=HELD), rw.solve(problem)
            assert held.cost == pytest.approx(free.cost, rel=1e-12)
            assert held.certificate.is_certified
            assert held.certificate.path == SearchPath(Start.SPECTRAL, Multipliers.KKT)

    def test_outcomes_where_the_noise_is_too_large_to_find_the_scale(self) -> None:
        """Against random starts on each side: no positive scale, and no scale zero, costs less than what is found."""
        outcomes: dict[bool, int] = {True: 0, False: 0}
        proven = 0
        for seed in (2, 3, 4, 11, 25, 27, 28, 34):
            problem = noisy(seed)
            search = searched(problem)
            free = search.run("auto", None)
            assert answer_of(search.part, search.form, free.R).scale < 0.0
            found, cost, lower = outcome(seed)
            outcomes[found is not None] += 1
            proven += cost - lower < 1e-4 * cost
            assert free.bound.lower_bound - 1e-9 <= lower <= cost * (1.0 + 1e-4)
            if found is not None:
                assert answer_of(search.part, search.form, found.R).scale > 0.0
                assert found.path.start is Start.NONNEGATIVE_SCALE
            generator = np.random.default_rng(seed)
            for _ in range(8):
                start = random_rotations(2, generator)
                for form in (search.form, without_scale(search.form)):
                    R = descend(form, start, 200).R
                    reached = cost_on_positive_scales(problem, R)
                    assert reached >= lower - 1e-5 * abs(lower)  # the message has six digits
                    assert reached >= cost - 1e-4 * abs(cost)
        assert outcomes[True] >= 3
        assert outcomes[False] >= 3
        assert proven >= 3

    def test_solve_raises_where_no_positive_scale_is_best(self) -> None:
        with pytest.raises(ScaleError, match=r"optimum is at scale zero.*the noise is too large to find the scale"):
            rw.solve(noisy(4), options=HELD)


class TestRefusals:
    def test_priors_on_translations_take_the_other_form(self) -> None:
        simulation = simulated(1, 1, 0, scale="shared")
        simulation.problem.add_prior("target0", simulation.X["target0"], sigma=0.1)
        with pytest.raises(OptionError, match="priors on translations"):
            rw.solve(simulation.problem, options=HELD)

    def test_many_frames(self) -> None:
        """Refused only where the constraint is needed."""
        refused = 0
        for seed in range(6, 12):  # 0 to 5 do not need it
            problem = simulated(5, 4, seed, noise=Noise(3.0, 0.3), number_of_measurements=2, scale="shared").problem
            search = searched(problem, random_starts=1, max_dense_frames=1)
            found = search.run("auto", None)
            if answer_of(search.part, search.form, found.R).scale > 0.0:
                continue
            with pytest.raises(OptionError, match="up to 8 frames; there are 9"):
                run_with_nonnegative_scale(searched(problem, random_starts=1, max_dense_frames=1))
            refused += 1
            break
        assert refused

    @pytest.mark.parametrize("scale", ["known", "per_target"])
    def test_other_scales(self, scale: str) -> None:
        with pytest.raises(OptionError, match="constrains a shared scale"):
            rw.solve(simulated(1, 1, scale=scale).problem, options=HELD)
