"""Splitting a problem: who is connected, who is a leaf, about which gauge, and what only the whole can show."""

from __future__ import annotations

import numpy as np
import pytest
from small_problems import part_of, simulated

import gtsam_rwhec as rw
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.solver.parts import connected_components, parts_of

SCALES: tuple[ScaleMode, ...] = ("known", "shared", "per_target")


@pytest.mark.parametrize("scale", ["known", "per_target"])
def test_unconnected_parts_come_apart(scale: ScaleMode) -> None:
    parts = parts_of(simulated(3, 3, graph=[(0, 0), (1, 0), (1, 1), (2, 2)], scale=scale).problem)
    assert [part.names for part in parts] == [("target0", "target1", "sensor0", "sensor1"), ("target2", "sensor2")]
    assert [part.pairs for part in parts] == [
        (("target0", "sensor0"), ("target1", "sensor0"), ("target1", "sensor1")),
        (("target2", "sensor2"),),
    ]


def test_one_scale_for_all_joins_them() -> None:
    (part,) = parts_of(simulated(2, 2, graph=[(0, 0), (1, 1)], scale="shared").problem)
    assert part.names == ("target0", "target1", "sensor0", "sensor1")
    assert part.number_of_unknowns == 6 * 4 + 1


def test_several_odometries_are_as_many_parts() -> None:
    parts = parts_of(simulated(0, 3, odometry=5).problem)
    assert [part.names for part in parts] == [("sensor0",), ("sensor1",), ("sensor2",)]
    assert [part.free for part in parts] == [("sensor0",), ("sensor1",), ("sensor2",)]


def test_components_in_order_of_appearance() -> None:
    pairs = (("b", "y"), ("a", "x"), ("c", "y"), ("c", "z"))
    assert [sorted(component) for component in connected_components(pairs)] == [["b", "c", "y", "z"], ["a", "x"]]
    assert connected_components((("s", "s"),)) == [["s"]]


def test_known_frames_are_not_free_and_do_not_count() -> None:
    simulation = simulated(3, 3)
    for name in ("target0", "target1"):
        simulation.problem.fix(name, simulation.X[name])
    part = part_of(simulation.problem)
    assert part.free == ("target2", "sensor0", "sensor1", "sensor2")
    assert set(part.fixed) == {"target0", "target1"}
    assert part.number_of_unknowns == 24


@pytest.mark.parametrize("scale", SCALES)
def test_translations_are_about_the_gauge(scale: ScaleMode) -> None:
    """Fixed frames and priors move with it, by what frame_shift says."""
    simulation = simulated(2, 2, scale=scale, known_sizes=("target0",) if scale == "per_target" else ())
    simulation.problem.fix("target0", simulation.X["target0"])
    simulation.problem.add_prior("sensor1", simulation.Y["sensor1"], sigma=0.1, kappa=10.0)
    part = part_of(simulation.problem)
    for name, moved, given in (
        ("target0", part.fixed["target0"], simulation.X["target0"]),
        ("sensor1", part.priors["sensor1"][0].transform, simulation.Y["sensor1"]),
    ):
        np.testing.assert_allclose(moved[:3, 3] + part.frame_shift(name), given[:3, 3], atol=1e-12)
        np.testing.assert_array_equal(moved[:3, :3], given[:3, :3])


@pytest.mark.parametrize(
    ("scale", "prior", "kind"),
    [
        ("known", None, "direct"),
        ("known", 0.1, "direct"),
        ("shared", None, "direct"),
        ("shared", 0.1, "inverse"),
        ("per_target", None, "inverse"),
    ],
)
def test_which_form_is_solved(scale: ScaleMode, prior: float | None, kind: str) -> None:
    simulation = simulated(2, 1, scale=scale)
    if prior is not None:
        simulation.problem.add_prior("target0", simulation.X["target0"], sigma=prior)
    assert part_of(simulation.problem).kind == kind


def test_scales_have_owners() -> None:
    simulation = simulated(2, 1, scale="per_target", odometry=4, known_sizes=("target1",))
    part = part_of(simulation.problem)
    assert part.scale_owners == ("target0", "sensor0")
    assert part.fixed_scales == {"target1": pytest.approx(1.0)}
    assert part.number_of_unknowns == 6 * 3 + 2
    assert part_of(simulated(2, 1).problem).scale_owners == ()


class TestRefusals:
    def test_nothing_measured(self) -> None:
        with pytest.raises(rw.errors.CountError, match="the problem is empty"):
            parts_of(rw.Problem())

    def test_fewer_equations_than_unknowns(self) -> None:
        problem = simulated(2, 1, number_of_measurements=1).problem
        with pytest.raises(rw.errors.UnderdeterminedError, match="12 equations for 18 unknowns"):
            parts_of(problem)

    def test_priors_count_as_equations(self) -> None:
        simulation = simulated(2, 1, number_of_measurements=1)
        simulation.problem.add_prior("target0", simulation.X["target0"], sigma=0.1, kappa=1.0)
        assert len(parts_of(simulation.problem)) == 1

    @pytest.mark.parametrize("what", ["fixed", "given a prior"])
    def test_frames_that_nothing_measures(self, what: str) -> None:
        simulation = simulated(1, 1)
        if what == "fixed":
            simulation.problem.fix("nowhere", np.eye(4))
        else:
            simulation.problem.add_prior("nowhere", np.eye(4), sigma=1.0)
        with pytest.raises(rw.errors.FrameError, match=f"'nowhere' is {what}, but no measurement mentions it"):
            parts_of(simulation.problem)

    def test_a_known_pose_of_unknown_size(self) -> None:
        simulation = simulated(2, 1, scale="per_target")
        simulation.problem.fix("target0", simulation.X["target0"])
        with pytest.raises(rw.errors.PriorError, match="target0 is fixed and its scale is unknown"):
            parts_of(simulation.problem)

    def test_a_known_size_of_what_nothing_measures(self) -> None:
        simulation = simulated(2, 1, scale="per_target")
        simulation.problem.fix_scale("sensor0", 1.0)
        with pytest.raises(rw.errors.ScaleError, match="nothing measures sensor0's size"):
            parts_of(simulation.problem)
