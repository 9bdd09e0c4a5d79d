"""What is free: records, and their words."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from rwhec_factors.se3 import inverse, pose

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Motion, Noise, carrier_poses, perturb
from gtsam_rwhec.simulate.simulated_noise import rotations_of_vectors
from gtsam_rwhec.solver.free_directions import (
    FreeDirection,
    FreeKind,
    FreeReason,
    free_directions_of,
    reason_for,
    sparse_basis,
)

NOISE = Noise(0.005, 5000.0)


def direction(frame: int, frames: int, **entries: Any) -> np.ndarray:
    """A column of the basis: omega (rad), v (m), own scale of one of the frames; shared, of all."""
    column = np.zeros(7 * frames + 1)
    first = 7 * frame
    for name, at in (("omega", slice(first, first + 3)), ("v", slice(first + 3, first + 6)), ("own", first + 6)):
        if name in entries:
            column[at] = entries[name]
    column[-1] = entries.get("shared", 0.0)
    return column


def directions(*columns: np.ndarray, names: tuple[str, ...] = ("cam0",), length_m: float = 1.0) -> list[FreeDirection]:
    reasons = dict.fromkeys(names, FreeReason.ONE_AXIS)
    return list(free_directions_of(names, sparse_basis(np.array(columns).T, length_m), length_m, reasons))


@pytest.mark.parametrize(
    ("vector", "said"),
    [
        ([0, 0, 1], "its own z axis"),
        ([0, -2, 0], "its own y axis"),
        ([0.999, 0.03, 0.0], "its own x axis"),
        ([0.6, 0.8, 0.0], "(0.60, 0.80, 0.00) in its own frame"),
        ([-0.6, -0.8, 0.0], "(0.60, 0.80, 0.00) in its own frame"),
    ],
)
def test_one_axis_has_a_name_or_numbers(vector: list[float], said: str) -> None:
    because = "the motion turned about one axis only"
    for entries, kind, words in (
        ({"v": vector}, FreeKind.TRANSLATION, f"translation of cam0 along {said}: {because}"),
        ({"omega": vector}, FreeKind.ROTATION, f"rotation of cam0 about {said}: {because}"),
    ):
        (found,) = directions(direction(0, 1, **entries))
        assert found.kind is kind
        assert str(found) == words


def test_a_direction_has_length_one_in_its_own_units() -> None:
    """A radian counts as much as 0.5 m, and the components are rad and m all the same."""
    (found,) = directions(direction(0, 1, omega=[0.0, 0.0, 3.0], v=[2.0, 0.0, 0.0]), length_m=0.5)
    assert found.length_m == 0.5
    np.testing.assert_allclose(found.frames["cam0"], np.array([0, 0, 3, 2, 0, 0]) / 5.0)


@pytest.mark.parametrize(
    "basis",
    [
        [[1, 0, 0], [0, 1, 0]],
        [[1, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 1, 0], [1, -1, 0], [1, 0, 1]],
    ],
)
def test_as_many_records_as_directions_and_the_same_span(basis: list[list[float]]) -> None:
    found = directions(*(direction(0, 1, v=axis) for axis in basis))
    spanned = np.array([np.array(each.frames["cam0"])[3:] for each in found])
    assert np.linalg.matrix_rank(spanned) == np.linalg.matrix_rank(np.vstack([spanned, basis])) == len(basis)
    if len(basis) == 3:  # whatever the basis, each axis by its name
        assert {str(each).split(":")[0] for each in found} == {
            f"translation of cam0 along its own {axis} axis" for axis in "xyz"
        }


def test_turning_and_shifting_come_apart() -> None:
    """Two directions however mixed: a turn about z that takes the translation along, and a shift along x."""
    turn, shift = direction(0, 1, omega=[0, 0, 1], v=[0, 1, 0]), direction(0, 1, v=[1, 0, 0])
    expected = [
        "rotation of cam0 about its own z axis (its origin moves too): the motion turned about one axis only",
        "translation of cam0 along its own x axis: the motion turned about one axis only",
    ]
    assert [str(each) for each in directions(turn, shift)] == expected
    assert [str(each) for each in directions(turn + 3 * shift, 2 * turn - shift)] == expected


def test_frames_that_do_not_move_take_no_part() -> None:
    (found,) = directions(direction(1, 2, v=[0, 0, 1]), names=("tag0", "cam0"))
    assert list(found.frames) == ["cam0"]


def test_small_shares_are_left_out_of_the_record_but_not_of_the_basis() -> None:
    """The target turns, shifts and scales by less than a twentieth of the camera's shift."""
    dust = direction(0, 2, omega=[0, 0, 0.02], v=[0, 0.02, 0], own=0.02, shared=0.02)
    column = (dust + direction(1, 2, omega=[0.02, 0, 0], v=[0, 0, 1]))[:, None]
    basis = sparse_basis(column, 1.0)
    np.testing.assert_allclose(basis, column / np.linalg.norm(column))
    (found,) = free_directions_of(("tag0", "cam0"), basis, 1.0, dict.fromkeys(("tag0", "cam0"), FreeReason.ONE_AXIS))
    assert found == FreeDirection(FreeKind.TRANSLATION, FreeReason.ONE_AXIS, {"cam0": (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)})


def test_only_a_scale_that_moves_frames_is_compensated_by_them() -> None:
    alone, shifted = (
        free_directions_of(("tag0",), column[:, None], 1.0, {"tag0": FreeReason.NOISE})[0]
        for column in (direction(0, 1, v=[1e-7, 0, 0], own=1.0), direction(0, 1, v=[0, 0, 1], own=1.0))
    )
    assert (alone.kind, alone.reason, alone.frames) == (FreeKind.SCALE, FreeReason.NOISE, {})
    assert (shifted.kind, shifted.reason, [*shifted.frames]) == (FreeKind.SCALE, FreeReason.COMPENSATED, ["tag0"])


def test_equal_records_have_equal_hashes() -> None:
    one, same = directions(direction(0, 1, v=[0, 0, 1])) + directions(direction(0, 1, v=[0, 0, 2]))
    (other,) = directions(direction(0, 1, v=[1, 0, 0]))
    assert len({one, same, other}) == 2


def test_frames_that_move_together_are_one_direction() -> None:
    together = direction(0, 2, v=[0, 0, 1]) + direction(1, 2, v=[1, 0, 0])
    (found,) = directions(together, names=("tag0", "cam0"))
    said = "translation of tag0 along its own z axis, together with cam0 along its own x axis"
    assert str(found).startswith(said)


def test_scales_are_named() -> None:
    (own,) = directions(direction(0, 1, own=1.0), names=("tag0",))
    assert (own.kind, own.own_scales) == (FreeKind.SCALE, {"tag0": 1.0})
    assert str(own).startswith("change of the scale of tag0: ")
    (shared,) = directions(direction(0, 1, v=[0, 0, 1], shared=1.0), names=("tag0",))
    assert shared.kind is FreeKind.SCALE
    assert shared.scale == pytest.approx(np.sqrt(0.5))
    assert str(shared).startswith("change of the scale, together with tag0 along its own z axis: ")


def test_a_direction_is_never_left_unsaid() -> None:
    """Spread thinly over six hundred frames, which all move as much: some are named, and the others counted."""
    names = tuple(f"tag{i}" for i in range(600))
    basis = np.tile(np.r_[0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0], 600)
    (found,) = directions(np.r_[basis, 0.0], names=names)
    assert set(found.frames) == set(names)
    assert str(found).startswith("translation of tag0 along its own z axis, together with tag1 along ")
    assert "and 596 more: " in str(found)


def test_many_directions_of_one_frame() -> None:
    """All that a frame has: rotations, translations, its scale and the shared one."""
    found = directions(*np.eye(8))
    assert [each.kind for each in found] == [FreeKind.ROTATION] * 3 + [FreeKind.SCALE] * 2 + [FreeKind.TRANSLATION] * 3


@pytest.mark.parametrize(
    ("axes", "turned_deg", "residual_deg", "said"),
    [
        (0, 0.1, 0.1, FreeReason.NO_ROTATION),
        (1, 40.0, 1.0, FreeReason.ONE_AXIS),
        (2, 40.0, 1.0, FreeReason.NOISE),
        (0, 40.0, 60.0, FreeReason.CONTRADICTION),
        (1, 40.0, 60.0, FreeReason.CONTRADICTION),
    ],
)
def test_reasons(axes: int, turned_deg: float, residual_deg: float, said: FreeReason) -> None:
    assert reason_for(axes, np.radians(turned_deg), np.radians(residual_deg), 3) is said


# -- from motion to words ---------------------------------------------------------------------------

QUARTER_ABOUT_Y = rotations_of_vectors([0.0, np.pi / 2, 0.0])  # its z axis is the carrier's x axis


def free_of(motion: Motion, R_cam: np.ndarray, noise: Noise | None, scale: Any = "known") -> tuple[FreeDirection, ...]:
    X, Y = pose(np.eye(3), [0.3, 0.2, 1.5]), pose(R_cam, [0.1, -0.1, 0.2])
    A = inverse(carrier_poses(motion, 20, 5))
    B = perturb(inverse(Y) @ A @ X, noise, 6)
    problem = rw.Problem(scale)
    weights = {} if noise is None else {"sigma": noise.sigma_m, "kappa": noise.kappa}
    problem.add("tag0", "cam0", A, B, **weights)
    with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
        solution = rw.solve(problem)
    # The pair alone and the whole are the same here.
    alone, whole = (
        solution.identifiability.pairs["tag0", "cam0"].free_directions,
        solution.identifiability.free_directions,
    )
    assert list(map(str, alone)) == list(map(str, whole))
    return whole


@pytest.mark.parametrize("noise", [None, NOISE], ids=["exact", "noise"])
@pytest.mark.parametrize("kind", ["planar", "single_axis"])
def test_one_axis_leaves_the_translation_along_it(kind: Any, noise: Any) -> None:
    (found,) = free_of(Motion(kind, (1.0, 0.0, 0.0)), QUARTER_ABOUT_Y, noise)
    assert str(found) == (
        "translation of tag0 along its own x axis, together with cam0 along its own z axis: "
        "the motion turned about one axis only"
    )
    tag, cam = (np.array(found.frames[name]) for name in ("tag0", "cam0"))
    assert np.linalg.norm(tag[3:]) == pytest.approx(np.linalg.norm(cam[3:]), rel=1e-2)


@pytest.mark.parametrize("noise", [None, NOISE], ids=["exact", "noise"])
def test_without_turning_every_translation_is_free(noise: Any) -> None:
    found = free_of(Motion("none"), QUARTER_ABOUT_Y, noise)
    assert [(each.kind, each.reason) for each in found] == [(FreeKind.TRANSLATION, FreeReason.NO_ROTATION)] * 3
    for each in found:  # both frames move as far: the target in its own frame, the camera in its
        shifts = [np.linalg.norm(np.array(each.frames[name])[3:]) for name in ("tag0", "cam0")]
        assert shifts[0] == pytest.approx(shifts[1], rel=0.05)


@pytest.mark.parametrize("noise", [None, NOISE], ids=["exact", "noise"])
def test_turning_on_the_spot_leaves_the_rotation_about_the_axis_too(noise: Any) -> None:
    """Nothing shifts A, so that both frames may turn about its axis together."""
    turn, shift = free_of(Motion("single_axis", (0.0, 0.0, 1.0), extent_m=0.0), np.eye(3), noise)
    assert str(turn).startswith("rotation of tag0 about its own z axis")
    assert "cam0 about its own z axis" in str(turn)
    assert str(shift).startswith("translation of tag0 along its own z axis, together with cam0 along its own z axis")
    assert turn.reason is shift.reason is FreeReason.ONE_AXIS


def test_excited_motion_leaves_nothing_to_say() -> None:
    assert free_of(Motion(), QUARTER_ABOUT_Y, NOISE) == ()
