"""What a person gives is checked in words."""

from __future__ import annotations

import pytest

from gtsam_rwhec.errors import FrameError, NoiseError, OptionError
from gtsam_rwhec.odometry import Given, Ground, KnownDirection, OdometryOptions

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
