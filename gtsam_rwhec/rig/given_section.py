"""The section ``given``: what a person measured where the motion of a vehicle does not tell."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

import numpy as np
from pydantic import AfterValidator, Field

from gtsam_rwhec.rig.field_types import Name, Positive, list_of
from gtsam_rwhec.rig.section import Section


def _unit(given: tuple[float, float, float]) -> tuple[float, float, float]:
    length = float(np.linalg.norm(given))
    if not 1e-9 < length < 1e9:
        raise ValueError(f"{list(given)} has the length {length:.3g}, and no direction; give three numbers, not all 0")
    x, y, z = (np.array(given) / length).tolist()
    return given if abs(length - 1.0) < 1e-12 else (x, y, z)


#: A direction, of any length; it is stored with the length 1.
Direction: TypeAlias = Annotated[
    tuple[float, float, float], list_of(3, "a direction, [x, y, z]"), AfterValidator(_unit)
]
SensorPair: TypeAlias = Annotated[tuple[Name, Name], list_of(2, "two sensors, [one, other]")]


class GivenGround(Section):
    """The plane that the vehicle drives on, in the axes of the reference."""

    up: Direction = Field(description="the direction away from the ground, of any length", examples=[[0.0, 0.0, 1.0]])
    below_m: float = Field(description="how far the plane is below the reference's origin", examples=[0.52])
    sigma_deg: Positive = Field(default=0.5, description="standard deviation of the direction", examples=[0.2])
    sigma_mm: Positive = Field(default=5.0, description="standard deviation of below_m", examples=[2.0])


class GivenDirection(Section):
    """A direction that is known in the axes of the reference: of an axis of a sensor, or of the line to its origin."""

    sensor: Name = Field(description="the sensor", examples=["camera_left"])
    of: Literal["x", "y", "z", "lever_arm"] = Field(
        description="what has the direction: an axis of the sensor, or (lever_arm) the line from the reference's "
        "origin to the sensor's",
        examples=["z"],
    )
    in_reference: Direction = Field(
        description="its direction in the axes of the reference, of any length", examples=[[1.0, 0.0, 0.0]]
    )
    sigma_deg: Positive = Field(default=0.5, description="standard deviation of the direction", examples=[0.2])


class GivenDistance(Section):
    """A distance between the origins of two sensors, as a tape measure says it."""

    between: SensorPair = Field(description="the two sensors", examples=[["lidar_front", "lidar_rear"]])
    distance_m: Annotated[float, Field(gt=0.0, lt=1000.0)] = Field(description="the distance", examples=[2.41])
    sigma_mm: Positive = Field(default=5.0, description="standard deviation of the distance", examples=[3.0])


class GivenSection(Section):
    """What a person measured, where the motion does not tell: a vehicle in a plane does not tell heights."""

    heights_m: dict[Name, float] = Field(
        default={},
        description="heights of sensors' origins above the ground; the reference needs one too, or ground",
        examples=[{"lidar_front": 0.52, "lidar_rear": 0.71}],
    )
    height_sigma_mm: Positive = Field(default=5.0, description="standard deviation of each height", examples=[2.0])
    ground: GivenGround | None = Field(
        default=None,
        description="the ground's plane; without it heights are along the axis that the vehicle turned about",
        examples=[{"up": [0, 0, 1], "below_m": 0.52}],
    )
    directions: Annotated[tuple[GivenDirection, ...], Field(max_length=1000)] = Field(
        default=(),
        description="directions that are known in the axes of the reference",
        examples=[[{"sensor": "camera_left", "of": "z", "in_reference": [1, 0, 0]}]],
    )
    distances: Annotated[tuple[GivenDistance, ...], Field(max_length=1000)] = Field(
        default=(),
        description="measured distances between sensors, used in the refinement",
        examples=[[{"between": ["lidar_front", "lidar_rear"], "distance_m": 2.41}]],
    )
