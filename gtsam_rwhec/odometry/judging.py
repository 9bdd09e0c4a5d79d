"""The verdict on a calibration of odometries, and what is free in the words of vehicles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.identifiability.free_directions import FreeDirection, FreeReason
from gtsam_rwhec.odometry.calibrated import OdometryCalibration

#: What is given is contradicted by the data from so many standard deviations on.
CONTRADICTED = 4.0
#: A sensor takes part in a free direction from this part of the direction's largest shift or turn on.
TAKES_PART = 0.05
#: An axis of the reference is named where the direction is within 8 degrees of it.
NEAR_AXIS = float(np.cos(np.radians(8.0)))
PRAISE = "the motions of all sensors agree, their joint cost is certified, and they determine every pose"


def judgement_of(found: OdometryCalibration) -> Judgement:
    """The verdict with its grounds: never "use" where something is free, or where another answer fits as well."""
    findings = []
    if not found.certificate.is_optimal:
        findings.append(Finding(Ground.NOT_CERTIFIED, f"the joint cost is not proven optimal ({found.certificate})"))
    findings += [Finding(Ground.NOT_UNIQUE, words) for words in free_in_words(found)]
    findings += [Finding(Ground.NOT_UNIQUE, f"another answer fits as well: {other.why}") for other in found.others]
    findings += [
        Finding(
            Ground.POSE_DOUBTED,
            f"what is given contradicts the motions: {one.what} = {one.value:g} {one.unit} is {one.off_by:.1f} "
            "standard deviations away",
        )
        for one in found.influences
        if one.off_by > CONTRADICTED
    ]
    findings += [Finding(Ground.COVARIANCE_DOUBTED, words) for words in found.findings]
    return Judgement.of(findings, PRAISE)


def free_in_words(found: OdometryCalibration) -> tuple[str, ...]:
    """A sentence for each sensor whose pose, or scale, is not determined: what, why, and what to state."""
    said = []
    for direction in found.free_directions:
        if not direction.frames and not direction.own_scales:
            said.append(str(direction))
            continue
        said += _of_frames(direction, found)
        said += [
            f"the scale of {name} is not determined: {_why(direction)}. Where its lengths are "
            "metres leave scale: estimate out, or drive a way that another sensor measures"
            for name in direction.own_scales
        ]
    return tuple(dict.fromkeys(said))


def _of_frames(direction: FreeDirection, found: OdometryCalibration) -> list[str]:
    turns, shifts = (
        {
            name: _in_reference(found.T_reference_sensor, name, np.array(twist)[part])
            for name, twist in direction.frames.items()
        }
        for part in (slice(0, 3), slice(3, 6))
    )
    said = []
    largest_turn = max((float(np.linalg.norm(v)) for v in turns.values()), default=0.0)
    largest_shift = max((float(np.linalg.norm(v)) for v in shifts.values()), default=0.0)
    for name in direction.frames:
        if largest_turn > TAKES_PART and np.linalg.norm(turns[name]) > TAKES_PART * largest_turn:
            said.append(
                f"the turn of {name} about {_axis(turns[name])} of {found.reference} is not determined: "
                f"{_why(direction)}. Drive other turns, or state given: directions for {name}"
            )
        elif largest_turn <= TAKES_PART and np.linalg.norm(shifts[name]) > TAKES_PART * largest_shift:
            said.append(_shift(name, shifts[name], direction, found.reference))
    return said


def _shift(name: str, v: Array, direction: FreeDirection, reference: str) -> str:
    """A vehicle in a plane turns about one axis, along which nothing tells where a sensor is: its height."""
    if direction.reason is FreeReason.ONE_AXIS:
        return (
            f"the height of {name} over {reference} (along {_axis(v)} of {reference}) is not determined: the vehicle "
            f"moved in a plane. Drive over a ramp, or state given: heights_m for {reference} and {name}"
        )
    return (
        f"the place of {name} along {_axis(v)} of {reference} is not determined: {_why(direction)}. Drive other turns, "
        f"or state given: distances or heights_m for {name}"
    )


def _why(direction: FreeDirection) -> str:
    return "unknown why" if direction.reason is None else direction.reason.words


def _in_reference(T_reference_sensor: Mapping[str, Array], name: str, v: Array) -> Array:
    turned: Array = T_reference_sensor[name][:3, :3] @ v
    return turned


def _axis(v: Array) -> str:
    """``the z axis``, or a direction in numbers."""
    unit = v / np.linalg.norm(v)
    i = int(np.argmax(np.abs(unit)))
    if abs(unit[i]) > NEAR_AXIS:
        return f"the {'xyz'[i]} axis"
    unit = unit * np.sign(unit[i])
    return f"({', '.join(f'{x:.2f}' for x in unit)})"
