"""What is free, said in words."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.identifiability.free_directions import describe, reason_for
from gtsam_rwhec.simulate import Motion, Noise, carrier_poses, perturb
from gtsam_rwhec.simulate.transforms import inverse, pose, rotations_of_vectors

NOISE = Noise(0.005, 5000.0)
WHY = {"cam0": "because", "tag0": "because"}


def direction(frame: int, frames: int, **entries: Any) -> np.ndarray:
    """A column of the basis: omega (rad), v (m), own scale of one of the frames; shared, of all."""
    column = np.zeros(7 * frames + 1)
    first = 7 * frame
    for name, at in (("omega", slice(first, first + 3)), ("v", slice(first + 3, first + 6)), ("own", first + 6)):
        if name in entries:
            column[at] = entries[name]
    column[-1] = entries.get("shared", 0.0)
    return column


@pytest.mark.parametrize(
    ("vector", "said"),
    [
        ([0, 0, 1], "z"),
        ([0, -2, 0], "y"),
        ([0.999, 0.03, 0.0], "x"),
        ([0.6, 0.8, 0.0], "(0.60, 0.80, 0.00)"),
        ([-0.6, -0.8, 0.0], "(0.60, 0.80, 0.00)"),
    ],
)
def test_one_axis_has_a_name_or_numbers(vector: list[float], said: str) -> None:
    for entries, words in (
        ({"v": vector}, f"cam0: translation along {said} of its own frame; because"),
        ({"omega": vector}, f"cam0: rotation about {said} of its own frame; because"),
    ):
        assert describe(("cam0",), direction(0, 1, **entries)[:, None], 1.0, WHY, "known") == [words]


def test_two_axes_and_three() -> None:
    x, y, z = (direction(0, 1, v=axis) for axis in np.eye(3))
    for basis, said in (
        ([x, y], "x and y"),
        (
            [
                y + x,
                z,
            ],
            "every axis but (0.71, -0.71, 0.00)",
        ),
        ([x, y, z], "every axis"),
        ([x + y, x - y, x + z], "every axis"),
    ):
        (sentence,) = describe(("cam0",), np.array(basis).T, 1.0, WHY, "known")
        assert sentence.removeprefix("cam0: translation along ").split(" of its own")[0] in (
            said,
            said.replace("0.71, -0.71", "-0.71, 0.71"),
        )


def test_turning_and_shifting_come_apart() -> None:
    """Two directions however mixed: a turn about z that takes the translation along, and a shift along x."""
    turn, shift = direction(0, 1, omega=[0, 0, 1], v=[0, 1, 0]), direction(0, 1, v=[1, 0, 0])
    expected = [
        "cam0: rotation about z (its translation moves along) and translation along x of its own frame; because"
    ]
    assert describe(("cam0",), np.array([turn, shift]).T, 1.0, WHY, "known") == expected
    assert describe(("cam0",), np.array([turn + 3 * shift, 2 * turn - shift]).T, 1.0, WHY, "known") == expected


def test_frames_that_do_not_move_are_not_named() -> None:
    basis = direction(1, 2, v=[0, 0, 1])[:, None]
    assert describe(("tag0", "cam0"), basis, 1.0, WHY, "known") == [
        "cam0: translation along z of its own frame; because"
    ]


def test_scales_are_named() -> None:
    own = describe(("tag0",), direction(0, 1, own=1.0)[:, None], 1.0, WHY, "per_target")
    assert len(own) == 1
    assert own[0].startswith("tag0: ")
    assert "scale" in own[0]
    assert "of its own frame" not in own[0]
    shared = describe(("tag0",), direction(0, 1, v=[0, 0, 1], shared=1.0)[:, None], 1.0, WHY, "shared")
    assert len(shared) == 2
    assert shared[0].startswith("tag0: translation along z")
    assert shared[1].startswith("scale: ")


def test_a_direction_is_never_left_unsaid() -> None:
    """Spread thinly over sixty frames, no frame has a share that says much; something is said all the same."""
    names = tuple(f"tag{i}" for i in range(600))
    basis = np.tile(np.r_[0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0], 600)
    sentences = describe(names, np.r_[basis, 0.0][:, None], 1.0, dict.fromkeys(names, "because"), "known")
    assert sentences


def test_many_directions_of_one_frame() -> None:
    """All that a frame has: rotations, translations, its scale and the shared one."""
    (sentence, *_) = describe(("cam0",), np.eye(8), 1.0, WHY, "shared")
    assert sentence.startswith("cam0: rotation about every axis")


@pytest.mark.parametrize(
    ("axes", "turned_deg", "residual_deg", "said"),
    [
        (0, 0.1, 0.1, "the motion did not turn"),
        (1, 40.0, 1.0, "the motion turned about one axis only"),
        (2, 40.0, 1.0, "the measurements say no more about it than their noise would"),
        (0, 40.0, 60.0, "is A or B inverted"),
        (1, 40.0, 60.0, "is A or B inverted"),
    ],
)
def test_reasons(axes: int, turned_deg: float, residual_deg: float, said: str) -> None:
    assert said in reason_for(axes, np.radians(turned_deg), np.radians(residual_deg))


# -- from motion to words ---------------------------------------------------------------------------

QUARTER_ABOUT_Y = rotations_of_vectors([0.0, np.pi / 2, 0.0])  # its z axis is the carrier's x axis


def sentences_of(motion: Motion, R_cam: np.ndarray, noise: Noise | None, scale: Any = "known") -> list[str]:
    X, Y = pose(np.eye(3), [0.3, 0.2, 1.5]), pose(R_cam, [0.1, -0.1, 0.2])
    A = inverse(carrier_poses(motion, 20, 5))
    B = perturb(inverse(Y) @ A @ X, noise, 6)
    problem = rw.Problem(scale)
    weights = {} if noise is None else {"sigma": noise.sigma_m, "kappa": noise.kappa}
    problem.add("tag0", "cam0", A, B, **weights)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rw.errors.RwhecWarning)
        solution = rw.solve(problem)
    # The pair alone and the whole are the same here.
    assert solution.identifiability.pairs["tag0", "cam0"].free_directions == solution.identifiability.free_directions
    return solution.identifiability.free_directions


@pytest.mark.parametrize("noise", [None, NOISE], ids=["exact", "noise"])
@pytest.mark.parametrize("kind", ["planar", "single_axis"])
def test_one_axis_leaves_the_translation_along_it(kind: Any, noise: Any) -> None:
    said = sentences_of(Motion(kind, (1.0, 0.0, 0.0)), QUARTER_ABOUT_Y, noise)
    assert said == [
        "tag0: translation along x of its own frame; the motion turned about one axis only",
        "cam0: translation along z of its own frame; the motion turned about one axis only",
    ]


@pytest.mark.parametrize("noise", [None, NOISE], ids=["exact", "noise"])
def test_without_turning_every_translation_is_free(noise: Any) -> None:
    said = sentences_of(Motion("none"), QUARTER_ABOUT_Y, noise)
    assert said == [
        "tag0: translation along every axis of its own frame; the motion did not turn",
        "cam0: translation along every axis of its own frame; the motion did not turn",
    ]


@pytest.mark.parametrize("noise", [None, NOISE], ids=["exact", "noise"])
def test_turning_on_the_spot_leaves_the_rotation_about_the_axis_too(noise: Any) -> None:
    """Nothing shifts A, so that both frames may turn about its axis together."""
    said = sentences_of(Motion("single_axis", (0.0, 0.0, 1.0), extent_m=0.0), np.eye(3), noise)
    assert len(said) == 2
    for name, sentence in zip(("tag0", "cam0"), said, strict=True):
        assert sentence.startswith(f"{name}: rotation about z")
        assert "translation along z" in sentence
        assert sentence.endswith("the motion turned about one axis only")


def test_excited_motion_leaves_nothing_to_say() -> None:
    assert sentences_of(Motion(), QUARTER_ABOUT_Y, NOISE) == []
