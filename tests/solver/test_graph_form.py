"""What follows the graph gives the same answers, and bounds that are as good, as what writes Q' down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rwhec_factors import se3
from small_problems import SCALES, part_of, simulated, solved, true_rotations, whole

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import part_form
from gtsam_rwhec.solver.answers import answer_of
from gtsam_rwhec.solver.descent import descend, homogeneous, spectral_start, unconstrained_start
from gtsam_rwhec.solver.elimination import Elimination
from gtsam_rwhec.solver.graph_form import GraphForm
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.rotations import CONSTRAINTS_FLAT, kkt_multipliers, random_rotations, tangent_basis


@pytest.fixture
def by_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """The graph is followed in parts of any size."""
    monkeypatch.setattr(part_form, "DENSE_FRAMES", 0)


def form_by_graph(forms: PartForm) -> GraphForm:
    """With every frame eliminated in its order, as in a large part."""
    full = forms.full
    order = Elimination.of(len(full.frames), *full.ends, few=0)
    found = GraphForm.of(replace(full, order=order))
    assert found is not None
    return found


def on_random_graph(seed: int, scale: ScaleMode, *, anchored: bool = False) -> PartForm:
    """Five targets and four sensors with few pairs."""
    simulation = simulated(5, 4, seed, graph="random", edge_probability=0.2, scale=scale)
    if anchored:
        simulation.problem.fix("target0", simulation.X["target0"])
        simulation.problem.add_prior("sensor1", simulation.Y["sensor1"], sigma=None, kappa=50.0)
    return whole(simulation.problem)


@given(seed=st.integers(0, 10**6), scale=st.sampled_from(SCALES), anchored=st.booleans())
@settings(max_examples=8, deadline=None)
def test_products_scales_and_newtons_steps_are_those_of_the_matrix(seed: int, scale: ScaleMode, anchored: bool) -> None:
    forms = on_random_graph(seed, scale, anchored=anchored and scale != "per_target")
    dense, graph = forms.reduced, form_by_graph(forms)
    assert (graph.rotations, graph.size) == (dense.rotations, dense.size)
    generator = np.random.default_rng(seed)
    x = generator.standard_normal(dense.size)
    np.testing.assert_allclose(graph.apply(x), dense.apply(x), atol=1e-10 * dense.magnitude)
    x[-1] = 1.0
    for mine, theirs in zip(graph.recover(x), dense.recover(x), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-7, atol=1e-7)
    R = random_rotations(dense.rotations, generator)
    q, basis = dense.apply(homogeneous(R)), tangent_basis(R)
    gradient = np.einsum("nij,ni->nj", basis, q[:-1].reshape(-1, 9))
    for damping in (0.0, 2.0 * dense.magnitude):
        steps = [form.newton(R, basis, q)(gradient, damping) for form in (graph, dense)]
        assert (steps[0] is None) == (steps[1] is None)
        if steps[0] is not None and steps[1] is not None:
            np.testing.assert_allclose(*steps, atol=1e-7)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("anchored", [False, True], ids=["free", "anchored"])
def test_starts_lead_to_the_optimum(scale: ScaleMode, anchored: bool) -> None:
    if anchored and scale == "per_target":
        return  # a fixed pose asks for a fixed scale
    forms = on_random_graph(3, scale, anchored=anchored)
    graph = form_by_graph(forms)

    def lowest(starts: list[Array]) -> float:
        return min(descend(graph, start, 200).cost for start in starts)

    best = min(descend(forms.reduced, start, 200).cost for start in spectral_start(forms.part, forms.rotation))
    assert lowest(spectral_start(forms.part, replace(forms.rotation, order=graph.full.order))) == pytest.approx(best)
    # The smallest eigenvector of Q' as a whole is no better a start where only some have priors: both are the same.
    mine, theirs = unconstrained_start(graph), unconstrained_start(forms.reduced)
    assert lowest(mine) == pytest.approx(lowest(theirs), rel=1e-9)


def test_parts_that_only_the_scale_joins_have_a_sign_each() -> None:
    problem = general(4, 4, seed=5, graph=[(0, 0), (1, 0), (2, 1), (3, 2), (3, 3)], noise=None, scale="shared").problem
    forms = PartForm.of(parts_of(problem)[0])
    (start,) = spectral_start(forms.part, forms.rotation)
    assert descend(form_by_graph(forms), start, 5).cost < 1e-15 * forms.reduced.magnitude


def test_the_smallest_eigenvalue_is_found() -> None:
    forms = on_random_graph(1, "known")
    graph = form_by_graph(forms)
    multipliers = np.random.default_rng(0).standard_normal((graph.rotations, 20)) * graph.magnitude / 10.0
    Lambda = (multipliers @ CONSTRAINTS_FLAT).reshape(-1, 10, 10)[:, :9, :9]
    value, vector = graph.smallest_eigenpair(Lambda)
    expected, direction = forms.reduced.smallest_eigenpair(Lambda)
    assert value == pytest.approx(expected, rel=1e-9)
    assert abs(float(vector @ direction)) == pytest.approx(1.0, abs=1e-6)


@given(seed=st.integers(0, 10**6), scale=st.sampled_from(SCALES), kept=st.booleans())
@settings(max_examples=4, deadline=None)
def test_the_answer_and_the_bound_are_those_of_the_matrix(seed: int, scale: ScaleMode, kept: bool) -> None:
    """In whatever way the answer is found, no bound is above the cost of another answer."""
    problem = simulated(
        5, 4, seed, graph="random", edge_probability=0.2, scale=scale, keep_measurements=kept, noise=Noise(0.02, 800.0)
    ).problem
    with pytest.MonkeyPatch.context() as patch:
        dense = solved(problem)
        patch.setattr(part_form, "DENSE_FRAMES", 0)
        assert isinstance(PartForm.of(part_of(problem)).form, GraphForm)
        graph = solved(problem)
    assert graph.certificate.status == dense.certificate.status
    assert graph.cost == pytest.approx(dense.cost, rel=1e-9)
    assert graph.certificate.lower_bound <= dense.cost
    assert graph.certificate.relative_gap <= max(4.0 * dense.certificate.relative_gap, 1e-8)
    for name, X in dense.X.items():
        np.testing.assert_allclose(graph.X[name].matrix(), X.matrix(), atol=1e-6)


@pytest.mark.usefixtures("by_graph")
def test_gross_noise_is_bounded_and_proves_nothing_wrong() -> None:
    """Sixty degrees: some are not tight, or local minima. No bound is above the cost of any answer that is found."""
    for seed in range(2):
        problem = simulated(4, 3, seed, graph="random", noise=Noise(0.5, 0.4), number_of_measurements=5).problem
        forms = whole(problem)
        certificate = solved(problem, random_starts=2, max_dense_frames=1).certificate
        generator = np.random.default_rng(seed)
        ends = [descend(forms.reduced, random_rotations(7, generator), 100) for _ in range(8)]
        lowest = min(end.cost for end in ends)
        assert certificate.lower_bound <= lowest * (1.0 + 1e-9)
        assert not (certificate.is_optimal and certificate.cost > lowest * (1.0 + 1e-5))


@pytest.mark.usefixtures("by_graph")
def test_a_local_minimum_is_not_certified() -> None:
    """Critical points of a descent that cost more than the optimum: their own multipliers give no tight bound."""
    problem = simulated(4, 3, 0, graph="random", noise=Noise(0.05, 20.0), number_of_measurements=5).problem
    best, forms = solved(problem), whole(problem)
    assert best.certificate.is_optimal
    generator = np.random.default_rng(1)
    found = 0
    for _ in range(30):
        end = descend(forms.form, random_rotations(7, generator), 200)
        if end.converged and end.cost > 1.01 * best.cost:
            answer, _ = forms.answer_near(end.R)
            X = {name: (answer.R[i], answer.t[i]) for i, name in enumerate(forms.part.free)}
            poses = {name: _pose(R, t + forms.part.frame_shift(name)) for name, (R, t) in X.items()}
            local = rw.certify(
                problem,
                {name: poses[name] for name in problem.targets},
                {name: poses[name] for name in problem.sensors},
            )
            assert not local.is_optimal
            assert local.lower_bound <= best.cost
            found += 1
        if found == 1:
            break
    assert found


def _pose(R: Array, t: Array) -> Array:
    return se3.pose(R, t)


@pytest.mark.usefixtures("by_graph")
@pytest.mark.parametrize("kept", [False, True], ids=["of moments", "of measurements"])
def test_what_is_not_determined_is_optimal_at_most(kept: bool) -> None:
    problem = simulated(4, 3, 0, graph="random", motion="planar", keep_measurements=kept).problem
    solution = solved(problem)
    assert not solution.identifiability.is_unique
    assert not solution.certificate.is_certified
    assert solution.certificate.lower_bound <= solution.cost


@pytest.mark.usefixtures("by_graph")
@pytest.mark.parametrize("scale", ["shared", "per_target"])
def test_free_directions_beside_an_unknown_scale_leave_it_as_it_is(scale: ScaleMode) -> None:
    """Planar motion leaves heights free, and tells the scale; a carrier at rest leaves it free: a shared one is 1."""
    simulation = simulated(3, 2, 0, scale=scale, motion="planar", noise=None)
    forms = whole(simulation.problem)
    assert isinstance(forms.form, GraphForm)
    x = homogeneous(true_rotations(simulation))
    scales = [np.append(numbers[:, 3], alpha) for numbers, alpha in (forms.form.recover(x), forms.reduced.recover(x))]
    np.testing.assert_allclose(*scales, rtol=1e-6)
    at_rest = rw.Problem(scale=scale)
    for target, sensor in simulation.problem.pairs:
        data = simulation.problem.measurements(target, sensor)
        at_rest.add(target, sensor, np.repeat(data.A[:1], 5, axis=0), np.repeat(data.B[:1], 5, axis=0))
    forms = whole(at_rest)
    answer = answer_of(forms.part, forms.form, true_rotations(simulation))
    if scale == "shared":
        assert answer.scale == pytest.approx(1.0)
    assert answer.has_positive_scales


def test_multipliers_at_the_answer_are_those_of_the_matrix() -> None:
    forms = on_random_graph(7, "known")
    graph = form_by_graph(forms)
    R = random_rotations(graph.rotations, np.random.default_rng(0))
    mine, theirs = (
        kkt_multipliers(R, form.apply(homogeneous(R))[:-1].reshape(-1, 9)) for form in (graph, forms.reduced)
    )
    np.testing.assert_allclose(mine, theirs, atol=1e-10 * forms.reduced.magnitude)
