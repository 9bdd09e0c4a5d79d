"""What a person gives is checked in words."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3

from gtsam_rwhec.errors import FrameError, NoiseError, OptionError
from gtsam_rwhec.odometry import Given, Ground, KnownDirection, KnownPose, OdometryOptions
from gtsam_rwhec.odometry.prior_knowledge import GivenRows
from gtsam_rwhec.odometry.window_likelihood import Layout, State

SENSORS = ("lidar", "camera")
GROUND = Ground((0.0, 0.0, 1.0), 1.5, 0.01, 0.01)


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (Given(heights_m={"radar": (1.0, 0.1)}), FrameError, "no track is of that sensor"),
        (Given(heights_m={"camera": (1.0, 0.1)}), FrameError, "give its height too"),
        (Given(heights_m={"camera": (1.0, 0.0)}, ground=GROUND), NoiseError, "positive number"),
        (Given(heights_m={"camera": (float("nan"), 0.1)}, ground=GROUND), OptionError, "finite"),
        (Given(distances_m={("camera", "camera"): (1.0, 0.1)}), FrameError, "to itself"),
        (Given(distances_m={("camera", "lidar"): (-1.0, 0.1)}), OptionError, "positive"),
        (Given(distances_m={("camera", "lidar"): (3315.0, 5.0)}), OptionError, "3315 mm would be 3.315"),
        (Given(heights_m={"camera": (900.0, 0.1)}, ground=GROUND), OptionError, "give metres"),
        (Given(heights_m={"camera": 1.8}, ground=GROUND), OptionError, "with its standard deviation"),  # type: ignore[dict-item]
        (Given(directions=(KnownDirection("lidar", "x", (1.0, 0.0, 0.0), 0.1),)), FrameError, "is the reference"),
        (Given(directions=(KnownDirection("camera", "x", (0.0, 0.0, 0.0), 0.1),)), OptionError, "not all zero"),
        (Given(directions=(KnownDirection("camera", "w", (1.0, 0.0, 0.0), 0.1),)), OptionError, "choose one"),  # type: ignore[arg-type]
        (Given(ground=Ground((0.0, 0.0, 1.0), 1.5, 0.01, -1.0)), NoiseError, "ground's distance"),
        (Given(poses=(KnownPose("lidar", "radar", np.eye(4), np.eye(6)),)), FrameError, "a pose is of 'radar'"),
        (Given(poses=(KnownPose("lidar", "camera", np.eye(3), np.eye(6)),)), OptionError, "is no pose"),
        (Given(poses=(KnownPose("lidar", "camera", np.eye(4), np.zeros((6, 6))),)), NoiseError, "its information is"),
    ],
)
def test_what_cannot_be_is_refused(given: Given, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        given.checked(SENSORS, "lidar")


def test_what_can_be_is_taken() -> None:
    given = Given(
        heights_m={"camera": (1.0, 0.1)},
        ground=GROUND,
        directions=(KnownDirection("camera", "lever_arm", (0.0, 3.0, 4.0), 0.1),),
        distances_m={("lidar", "camera"): (0.5, 0.01)},
    )
    given.checked(SENSORS, "lidar")


def test_options_are_positive() -> None:
    with pytest.raises(OptionError, match="window_s"):
        OdometryOptions(window_s=0.0)


def test_a_known_pose_is_the_same_in_the_certified_form_and_in_the_likelihood() -> None:
    rng = np.random.default_rng(0)
    T = np.concatenate([np.eye(4)[None], se3.expmap(rng.normal(0.0, 1.0, (3, 6)))])
    scale = np.array([1.0, 1.0, 1.0, 0.4])
    L = rng.normal(size=(6, 6))
    pairs = {"ab": (0, 1), "cb": (2, 1), "bd": (1, 3)}
    poses = tuple(
        KnownPose(one, other, se3.inverse(T[j][None])[0] @ T[k], L @ L.T + np.eye(6))
        for (one, other), (j, k) in pairs.items()
    )
    rows = GivenRows(Given(poses=poses), {name: k for k, name in enumerate("abcd")}, np.eye(3)[2], 0.1, 0.05)
    layout = Layout.of(scale != 1.0, clocks=True, has_ground=False)
    still = np.zeros(4), np.tile(np.eye(4), (5, 1, 1)), np.zeros(2), 0.0
    state = State(T, scale, *still)
    step = np.zeros(layout.size)
    step[layout.poses.ravel()] = 1e-4 * rng.normal(size=18)
    moved = state.moved(layout, step, np.zeros((5, 6)))
    known = rows.rows(moved, layout)
    at = [i for i, number in enumerate(known.numbers) if not number.unit]
    assert known.r[at] == pytest.approx(known.J[at] @ step, abs=1e-6)
    R = moved.T[1:, :3, :3].transpose(0, 2, 1).ravel()
    y = np.r_[R, (moved.T[1:, :3, 3] * scale[1:, None]).ravel(), scale[3], 1.0]
    form = (rows.form_rows(state, scale != 1.0) @ y).reshape(3, 15)
    assert form[:, :6].ravel() == pytest.approx(known.r[at], abs=1e-6)
    assert np.abs(form[:, 6:]).max() < 1e-3
