"""Tags that are alike are computed together: the sums are those of each alone, and no more is called for more tags."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import CAMERA

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.corner_graph import CornerGraph
from gtsam_rwhec.fitting.corner_model import Model
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced
from gtsam_rwhec.fitting.corner_residuals import stacks_of

SQUARE = 0.02 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
NOISE = Noise(0.1, 1e-3, 1e-3, 0.02)
IMAGES = 8


def wall(tags: int) -> tuple[rw.Observations, rw.CornersRefined]:
    """A wall of tags seen by two cameras, the last tag in few images and by one; and its refinement."""
    rng = np.random.default_rng(0)
    A = se3.expmap(rng.normal(size=(IMAGES, 6)) * np.repeat([0.08, 0.05], 3))
    X = se3.expmap(np.c_[rng.normal(0.0, 0.1, (tags, 3)), rng.uniform(-0.1, 0.1, (tags, 2)), np.full(tags, 2.0)])
    Y = {"left": np.eye(4), "right": se3.expmap(np.array([[0.05, 0.0, 0.2, 0.05, 0.0, 0.0]]))[0]}
    views = {}
    for t in range(tags):
        for name in Y if t < tags - 1 else ("right",):
            own = A if t < tags - 1 else A[:5]
            P = np.pad(SQUARE, ((0, 0), (0, 1)), constant_values=1.0) @ (se3.inverse(Y[name]) @ own @ X[t]).mT
            views[f"tag_{t}", name] = own, CAMERA.project(P[..., :3]) + rng.normal(0.0, 0.1, (len(own), 4, 2))
    found = rw.Observations.of(dict.fromkeys(Y, CAMERA), {name: SQUARE for name, _ in views}, views)
    return found, rw.refine_corners(found, {f"tag_{t}": T for t, T in enumerate(X)}, Y)


def one_by_one(model: Model, observations: rw.Observations) -> Model:
    """The model with a stack for each tag."""
    stacks, _ = stacks_of(observations, str)
    weights = {pair: of[at] for stack, of in zip(model.stacks, model.weights, strict=True) for pair, at in stack.pairs}
    return replace(model, stacks=stacks, weights=tuple(weights[s.targets[0], s.sensor] for s in stacks), common=())


@pytest.mark.parametrize("kept", [np.ones(IMAGES, dtype=bool), np.arange(IMAGES) > 4])
def test_sums_are_those_of_each_tag_alone(kept: np.ndarray) -> None:
    observations, refined = wall(5)
    whole = replace(refined.graph.model, common=())
    alone = one_by_one(whole, observations)
    assert [len(stack.targets) for stack in whole.stacks] == [4, 5]
    assert len(alone.stacks) == 9
    together, each = whole.of_instants(kept), alone.of_instants(kept)
    assert set(together.targets) == set(each.targets) == {f"tag_{t}" for t in range(4 + kept.all())}
    one, other = (Reduced.of(model, refined.point, refined.slots) for model in (together, each))
    for part in ("squares", "of_A", "M"):
        expected = getattr(other.sums, part)
        assert getattr(one.sums, part) == pytest.approx(expected, rel=1e-9, abs=1e-12 * np.abs(expected).max())
    (value, gradient), (value_of_each, of_each) = (of.minus_two_log_likelihood(NOISE) for of in (one, other))
    assert value == pytest.approx(value_of_each, rel=1e-9)
    assert gradient == pytest.approx(of_each, rel=1e-6, abs=1e-6)


def calls(tags: int) -> tuple[Counter[str], int]:
    """Calls in the modules of the corners for one round, by module; and the number of the graph's factors."""
    _, refined = wall(tags)
    model, point, counts = replace(refined.graph.model, common=()), refined.point, Counter[str]()
    graph = CornerGraph(model, point)
    values = graph.values(point)

    def count(frame: FrameType, event: str, argument: object) -> None:
        module = Path(frame.f_code.co_filename).stem
        if event == "call" and module in ("corner_residuals", "corner_noise", "common_errors", "se3", "distortion"):
            counts[module] += 1

    sys.setprofile(count)
    try:
        graph.graph.linearize(values)
        Reduced.of(model, point).minus_two_log_likelihood(NOISE)
    finally:
        sys.setprofile(None)
    return counts, graph.graph.size()


def test_no_more_is_called_for_more_tags() -> None:
    (few, factors), (many, more_factors) = calls(5), calls(15)
    assert few
    assert few == many
    assert factors == more_factors
