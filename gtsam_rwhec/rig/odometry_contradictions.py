"""Contradictions in a rig file between its odometries, its reference and what a person gave."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.rig.given_section import GivenSection
from gtsam_rwhec.rig.odometry_section import OdometrySensor
from gtsam_rwhec.rig.reference_carrier import carriers_of, nearest
from gtsam_rwhec.rig.sections import Carriers

Fault = tuple[KeyPath, str]
#: Two statements of one length contradict one another from this many standard deviations on.
SURELY = 6.0


def odometry_contradictions(
    carriers: Carriers,
    odometries: Mapping[str, OdometrySensor],
    others: int,
    reference: str | None,
    given: GivenSection,
) -> Iterator[Fault]:
    """Yield every fault, as the path of the value and what is wrong with it; `others` counts sensors that see."""
    yield from _sources(odometries)
    if reference is not None:
        yield from _reference(carriers, odometries, others, reference)
    for path, name in _named(given):
        if name not in odometries:
            yield path, f"there is no sensor {name} with odometry; {nearest(name, list(odometries))}"
    if reference is None and given != GivenSection():
        words = "is used with reference: NAME, where only the sensors' own motions are known; leave it out"
        yield ("given",), words
    yield from _ground(given, reference)
    yield from _distances(given)


def _sources(odometries: Mapping[str, OdometrySensor]) -> Iterator[Fault]:
    first: dict[str, str] = {}
    for name, sensor in odometries.items():
        place = sensor.odometry.place
        if first.setdefault(place, name) != name:
            words = f"{place} is also the odometry of sensor {first[place]}; each sensor needs its own"
            yield ("sensors", name, "odometry"), words


def _reference(
    carriers: Carriers, odometries: Mapping[str, OdometrySensor], others: int, reference: str
) -> Iterator[Fault]:
    sensor = odometries[reference]
    if carriers != carriers_of(reference, sensor):
        yield (
            ("reference",),
            f"{reference} carries the sensors, and so does {carriers.sensors} of carriers; give one of both: "
            "carriers where other poses are known, reference where only the sensors' own motions are",
        )
    if len(odometries) + others < 2:
        yield ("sensors",), f"only {reference}, the reference; give at least one sensor that is calibrated to it"
    if sensor.odometry.scale == "estimate":
        yield (
            ("reference",),
            f"lengths of {reference} are not known (scale: estimate), and no length would be; name a sensor whose "
            "scale is known",
        )
    if sensor.time_offset != 0.0:
        yield (
            ("sensors", reference, "time_offset"),
            f"{sensor.time_offset}, and its clock is the one that all others are compared with; leave it out",
        )


def _named(given: GivenSection) -> Iterator[tuple[KeyPath, str]]:
    """The sensors that are named, and where."""
    yield from ((("given", "heights_m", name), name) for name in given.heights_m)
    yield from ((("given", "directions", i, "sensor"), one.sensor) for i, one in enumerate(given.directions))
    for i, one in enumerate(given.distances):
        yield from ((("given", "distances", i, "between", end), name) for end, name in enumerate(one.between))


def _ground(given: GivenSection, reference: str | None) -> Iterator[Fault]:
    ground = given.ground
    if ground is not None and reference in given.heights_m:
        height = given.heights_m[reference]
        if abs(height - ground.below_m) > SURELY * 1e-3 * np.hypot(given.height_sigma_mm, ground.sigma_mm):
            yield (
                ("given", "heights_m", reference),
                f"{height:g} m above the ground, and given.ground says that the ground is {ground.below_m:g} m below "
                f"{reference}; correct one of the two",
            )
    others = [name for name in given.heights_m if name != reference]
    if others and reference is not None and reference not in given.heights_m and ground is None:
        yield (
            ("given", "heights_m", others[0]),
            f"heights are compared with that of the reference; give the height of {reference} too, or ground",
        )
    if reference in given.heights_m and not others and ground is None:
        yield (
            ("given", "heights_m", reference),
            f"the height of {reference} alone, the reference, says nothing of another sensor; give theirs too",
        )
    for i, one in enumerate(given.directions):
        if one.sensor == reference:
            words = f"{reference} is the reference, in whose axes directions are given; name another sensor"
            yield ("given", "directions", i, "sensor"), words


def _distances(given: GivenSection) -> Iterator[Fault]:
    first: dict[tuple[str, ...], int] = {}
    for i, one in enumerate(given.distances):
        path: KeyPath = ("given", "distances", i)
        ends = tuple(sorted(one.between))
        if ends[0] == ends[1]:
            yield (*path, "between"), f"{ends[0]} twice; name two sensors"
            continue
        before = given.distances[first.setdefault(ends, i)]
        sigma_m = 1e-3 * float(np.hypot(one.sigma_mm, before.sigma_mm))
        if abs(one.distance_m - before.distance_m) > SURELY * sigma_m:
            words = f"{one.distance_m:g} m, and given.distances[{first[ends]}] says {before.distance_m:g} m"
            yield (*path, "distance_m"), f"{words} for {ends[0]} and {ends[1]}; correct one of the two"
        apart_m = [given.heights_m[name] for name in ends if name in given.heights_m]
        if len(apart_m) == 2 and abs(apart_m[0] - apart_m[1]) > one.distance_m + SURELY * 1e-3 * (
            one.sigma_mm + given.height_sigma_mm
        ):
            words = f"{one.distance_m:g} m, and the heights of {ends[0]} and {ends[1]} differ by"
            yield (*path, "distance_m"), f"{words} {abs(apart_m[0] - apart_m[1]):g} m; correct one of them"
