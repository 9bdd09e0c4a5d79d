"""The verdict on a calibration of odometries, and what is free in the words of vehicles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.calibrated import OdometryCalibration
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeReason

#: So many of them are named.
NAMED = 4
#: A sensor takes part in a free direction from this part of the direction's largest shift or turn on.
TAKES_PART = 0.05
#: An axis of the reference is named where the direction is within 8 degrees of it.
NEAR_AXIS = float(np.cos(np.radians(8.0)))
#: What to do where something is free.
WHAT_TO_DO = (
    "state the missing heights in the rig file (given: {heights_m: {SENSOR: 0.5, ...}}, with that of the reference), "
    "or the ground, directions or distances; or drive other turns and a ramp, and calibrate again"
)
#: What to do where what was given is contradicted.
MEASURE_AGAIN = "measure again what is given, in metres and in the axes of the reference, and correct the rig file"
#: What to do where a track is wrong as a whole.
CHECK_TRACKS = (
    "check the named tracks (poses T_start_sensor, quaternions x y z w, lengths in metres or scale: estimate, one "
    "vehicle and one drive) and what is given, and calibrate again"
)
PRAISE = "the motions of all sensors agree, their joint cost is certified, and they determine every pose"
PRAISE_WITH_GIVEN = (
    "the motions of all sensors agree, their joint cost is certified, and with what was given they determine every "
    "pose. The motions do not check all that was given: an error in it is an error of the poses"
)


def judgement_of(found: OdometryCalibration) -> Judgement:
    """The verdict with its grounds: never "use" where something is free, or where another answer fits as well."""
    findings = []
    if not found.certificate.is_optimal:
        findings.append(Finding(Ground.NOT_CERTIFIED, f"the joint cost is not proven optimal ({found.certificate})"))
    findings += [Finding(Ground.NOT_UNIQUE, words) for words in free_in_words(found)]
    findings += [Finding(Ground.NOT_UNIQUE, f"another answer fits as well: {other.why}") for other in found.others]
    findings += _contradicted(found)
    findings += [Finding(Ground.CONTRADICTED, words) for words in found.contradictions]
    findings += [Finding(Ground.COVARIANCE_DOUBTED, words) for words in found.findings]
    is_unchecked = any(one.off_by == 0.0 for one in found.influences)
    judgement = Judgement.of(findings, PRAISE_WITH_GIVEN if is_unchecked else PRAISE)
    reason = judgement.reason.replace(Ground.NOT_UNIQUE.advice, WHAT_TO_DO)
    reason = reason.replace(Ground.CONTRADICTED.advice, CHECK_TRACKS)
    return replace(judgement, reason=reason.replace(Ground.POSE_DOUBTED.advice, MEASURE_AGAIN))


def _contradicted(found: OdometryCalibration) -> list[Finding]:
    """The given numbers that are farthest from the motions, if they contradict them; one that is wrong pulls others."""
    wrong = sorted((one for one in found.influences if one.is_contradicted), key=lambda one: -one.off_by)
    if not wrong:
        return []
    named = ", ".join(f"{one.what} = {one.value:g} {one.unit} ({one.off_by:.1f})" for one in wrong[:NAMED])
    words = f"what is given contradicts the motions (by so many standard deviations): {named}"
    if len(wrong) > NAMED:
        words += f" and {len(wrong) - NAMED} more"
    return [Finding(Ground.POSE_DOUBTED, words)]


def free_in_words(found: OdometryCalibration) -> tuple[str, ...]:
    """What is not determined of which sensors, and why: a sentence for the heights, and for each other direction."""
    said: list[str] = []
    heights: dict[str, list[str]] = {}
    for direction in found.free_directions:
        if not direction.frames and not direction.own_scales:
            said.append(str(direction))
            continue
        said += _of_frames(direction, found, heights)
        said += [f"the scale of {name} is not determined: {_why(direction)}" for name in direction.own_scales]
    of_heights = [_of_heights(axis, list(dict.fromkeys(names)), found.reference) for axis, names in heights.items()]
    return tuple(dict.fromkeys((*of_heights, *said)))


def _of_frames(direction: FreeDirection, found: OdometryCalibration, heights: dict[str, list[str]]) -> list[str]:
    """The sentences of a direction; heights, which a plane leaves free, go by their axis into `heights`."""
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
                f"{_why(direction)}"
            )
        elif largest_turn <= TAKES_PART and np.linalg.norm(shifts[name]) > TAKES_PART * largest_shift:
            axis = _axis(shifts[name])
            # A vehicle in a plane turns about one axis, along which nothing tells where a sensor is: its height.
            if direction.reason is FreeReason.ONE_AXIS:
                heights.setdefault(axis, []).append(name)
            else:
                place = f"the place of {name} along {axis} of {found.reference}"
                said.append(f"{place} is not determined: {_why(direction)}")
    return said


def _of_heights(axis: str, names: list[str], reference: str) -> str:
    many = len(names) > 1
    listed = f"{', '.join(names[:-1])} and {names[-1]}" if many else names[0]
    heights = f"the height{'s' * many} of {listed} over {reference} (along {axis} of {reference})"
    return f"{heights} {'are' if many else 'is'} not determined: the vehicle moved in a plane"


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
