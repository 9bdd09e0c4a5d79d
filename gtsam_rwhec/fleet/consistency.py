"""Whether the logs of a unit may be solved together: rig files and cameras that contradict each other are refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gtsam_rwhec.errors import RigError
from gtsam_rwhec.fleet.merging import MergedLog
from gtsam_rwhec.fleet.without_secrets import shown
from gtsam_rwhec.rig import Rig

#: A message names at most this many contradictions.
MOST_NAMED = 10


def check_rigs(rigs: Mapping[str, Sequence[tuple[str, Rig]]]) -> None:
    """Refuse rig files that say different things of one thing.

    Parameters
    ----------
    rigs : dict of str to sequence of (URL, Rig)
        By robot, each rig file once.

    Raises
    ------
    RigError
        A target has another type or size in one than in the other, a sensor of a robot other intrinsics, the carriers
        other frames, or sizes and noise are treated otherwise; all are named.
    """
    found: list[str] = []
    everyone = [(robot, url, rig) for robot, several in rigs.items() for url, rig in several]
    first_robot, first_url, first = everyone[0]
    for robot, url, rig in everyone[1:]:
        places = f"{shown(first_url)} and {shown(url)}"
        for name in sorted(first.targets.keys() & rig.targets.keys()):
            one, other = first.targets[name], rig.targets[name]
            if one != other:
                found.append(f"target {name} differs between {places} ({_difference(one, other)})")
        if first.carriers.targets != rig.carriers.targets:
            found.append(
                f"the carrier of the targets is {first.carriers.targets} in {shown(first_url)} and "
                f"{rig.carriers.targets} in {shown(url)}"
            )
        found += [
            f"{key}: is {getattr(first, key)} in {shown(first_url)} and {getattr(rig, key)} in {shown(url)}"
            for key in ("sizes", "noise")
            if getattr(first, key) != getattr(rig, key)
        ]
        if robot != first_robot:
            continue
        for name in sorted(first.sensors.keys() & rig.sensors.keys()):
            one_camera, other_camera = first.sensors[name].intrinsics, rig.sensors[name].intrinsics
            if one_camera != other_camera:
                found.append(
                    f"sensor {name} has other intrinsics in {shown(url)} than in {shown(first_url)}"
                    + (f" ({_difference(one_camera, other_camera)})" if one_camera and other_camera else "")
                )
        if first.carriers.sensors != rig.carriers.sensors:
            found.append(f"the carrier of the sensors has another name in {shown(url)} than in {shown(first_url)}")
    _refuse(found)


def check_logs(logs: Sequence[MergedLog]) -> None:
    """Refuse logs whose cameras differ, or whose noise is told in different ways.

    Raises
    ------
    RigError
        A camera has other intrinsics in one log than in the other, or only some logs have corners.
    """
    found: list[str] = []
    cameras: dict[str, MergedLog] = {}
    for log in logs:
        for name in log.facts.cameras:
            first = cameras.setdefault(name, log)
            one, other = first.facts.camera(name), log.facts.camera(name)
            same = (one.model, one.width, one.height) == (other.model, other.width, other.height)
            if not (same and np.array_equal(one.K, other.K) and np.array_equal(one.D, other.D)):
                said = f"{_focal(one.K)} and {_focal(other.K)}"
                found.append(f"{name} has other intrinsics in {log.facts.url} than in {first.facts.url} ({said})")
        if log.facts.weighting != logs[0].facts.weighting:
            found.append(
                f"the noise of {log.facts.url} is known otherwise ({_WORDS[log.facts.weighting]}) than that of "
                f"{logs[0].facts.url} ({_WORDS[logs[0].facts.weighting]}): state it in the rig file (noise: "
                "{rotation_deg: ..., translation_mm: ...})"
            )
    _refuse(found)


_WORDS = {"stated": "stated", "covariances": "from corners", "none": "detections without corners or covariances"}


def _refuse(found: list[str]) -> None:
    if found:
        more = f"; and {len(found) - MOST_NAMED} more" if len(found) > MOST_NAMED else ""
        raise RigError(
            f"rig files or logs that are to be solved together contradict each other: {'; '.join(found[:MOST_NAMED])}"
            f"{more}. Correct the wrong one, or solve them apart (robots of their own, --each log)"
        )


def _difference(one: object, other: object) -> str:
    before, now = (dict(each) for each in (one, other))  # type: ignore[call-overload]
    keys = [key for key in before.keys() | now.keys() if before.get(key) != now.get(key)]
    return ", ".join(f"{key}: {before.get(key)} and {now.get(key)}" for key in sorted(keys)[:3])


def _focal(K: np.ndarray) -> str:
    return f"fx {K[0, 0]:g}"
