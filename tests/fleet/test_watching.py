"""The watch over a fleet's rows: one alarm with its date and frame, nights that lack something, and the stream."""

from __future__ import annotations

import json
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from robot_nights import DAY_NS, DEVIATIONS, day_ns, failed_night, robot_nights, with_constant_errors, with_free_height

from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.fleet.drift_events import FramesEvent, FreeEvent, NightEvent, NoAnswerEvent
from gtsam_rwhec.fleet.fleet_rows import RobotRow
from gtsam_rwhec.fleet.watching import Watched, stream, watch

ROBOTS = [f"arm_{i}" for i in range(6)]


@pytest.fixture(scope="module")
def rows() -> list[RobotRow]:
    moved = robot_nights("arm_moved", 20, moved_at=14)
    return [row for name in ROBOTS for row in robot_nights(name, 20)] + moved


@pytest.fixture(scope="module")
def watched(rows: list[RobotRow]) -> Watched:
    return watch(rows)


def test_the_robot_that_moved_is_named_with_its_date_and_its_frame(watched: Watched) -> None:
    assert watched.changed == ("arm_moved",)
    [alarm] = watched.alarms
    assert (alarm.last_unchanged_ns, alarm.first_changed_ns) == (day_ns(13), day_ns(14))
    assert alarm.when_ns == day_ns(14)
    [frame] = alarm.frames
    assert frame.name == "cam"
    assert frame.translation_mm == pytest.approx(1e3 * 8.0 * DEVIATIONS[3] / np.sqrt(2.0), rel=0.5)
    assert not alarm.is_back
    assert str(alarm).startswith("arm_moved: cam moved between 2024-10-17 and 2024-10-18 (cam 1.")


def test_nights_to_come_change_no_event(rows: list[RobotRow], watched: Watched) -> None:
    earlier = watch([row for row in rows if row.begin_ns < day_ns(16)])
    assert earlier.events == tuple(event for event in watched.events if event.when_ns < day_ns(16))


def test_the_order_of_the_rows_and_the_reference_frames_change_nothing(rows: list[RobotRow], watched: Watched) -> None:
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -1.0, 2.0), np.array([3.0, -2.0, 5.0])).matrix()
    turned = [replace(row, frames=tuple(replace(frame, T=T @ frame.T) for frame in row.frames)) for row in rows[::-1]]
    for first, second in zip(watched.events, watch(turned).events, strict=True):
        assert (first.robot, first.when_ns) == (second.robot, second.when_ns)
        if isinstance(first, NightEvent):
            assert second.chance == pytest.approx(first.chance, rel=1e-6)


def test_nights_that_lack_something_are_said_and_the_others_go_on() -> None:
    nights = robot_nights("arm", 18, moved_at=14)
    nights[3] = failed_night("arm", 3)
    nights[5] = replace(nights[5], verdict=Verdict.DO_NOT_USE, grounds=(Ground.MISREAD,), reason="B is inverted.")
    nights[6] = replace(nights[6], covariance=None)
    nights[8] = replace(nights[8], frames=nights[8].frames[:1], covariance=nights[8].covariance[:6, :6])
    nights[10] = with_free_height(nights[10])
    del nights[12]
    found = watch(nights)
    reasons = {event.when_ns: event.reason for event in found.events if isinstance(event, NoAnswerEvent)}
    assert reasons == {
        day_ns(3): "no log was read",
        day_ns(5): "its poses are not to be used: B is inverted.",
        day_ns(6): "its poses have no covariance, because it was not refined",
    }
    frames = [event for event in found.events if isinstance(event, FramesEvent)]
    assert [(event.when_ns, event.appeared, event.missing) for event in frames] == [
        (day_ns(8), (), ("board",)),
        (day_ns(9), ("board",), ()),
    ]
    free = [event for event in found.events if isinstance(event, FreeEvent)]
    assert [(event.when_ns, event.free) for event in free] == [(day_ns(10), {"cam": ("z",)}), (day_ns(11), {})]
    [alarm] = found.alarms
    assert (alarm.first_changed_ns, [frame.name for frame in alarm.frames]) == (day_ns(14), ["cam"])


def test_a_night_that_was_run_again_counts_once(rows: list[RobotRow]) -> None:
    own = rows[:20]
    wrong = [replace(row, frames=rows[-1].frames) for row in own[:5]]
    assert watch([*wrong, *own]).events == watch(own).events


def test_covariances_that_are_too_small_are_found(rows: list[RobotRow]) -> None:
    small = [replace(row, covariance=row.covariance / 4.0) for row in rows if row.robot != "arm_moved"]
    found = watch(small)
    assert found.spread.variance == pytest.approx(4.0, rel=0.25)
    assert found.alarms == ()


def test_what_all_nights_share_does_not_count(rows: list[RobotRow], watched: Watched) -> None:
    found = watch([with_constant_errors(row, 0.01) for row in rows])
    for first, second in zip(watched.events, found.events, strict=True):
        if isinstance(first, NightEvent):
            assert second.chance == pytest.approx(first.chance, rel=1e-6)


def test_the_stream_is_json_with_a_version(watched: Watched) -> None:
    lines = [json.loads(line) for line in stream(watched)]
    assert (lines[0]["event"], lines[0]["format"], lines[0]["version"]) == ("watch", "gtsam-rwhec watch", 1)
    assert (lines[0]["robots"], lines[0]["nights"], lines[0]["nights_between_false_alarms"]) == (7, 140, 1000.0)
    [alarm] = lines[1:-1]
    assert alarm["event"] == "alarm"
    assert (alarm["first_changed"], alarm["first_changed_ns"]) == ("2024-10-18T00:00:00Z", 20_014 * DAY_NS)
    assert [frame["name"] for frame in alarm["frames"]] == ["cam"]
    assert lines[-1] == {"event": "end", "alarms": 1, "robots_changed": ["arm_moved"]}
    every = [json.loads(line)["event"] for line in stream(watched, every_night=True)]
    assert every.count("night") == 140


def test_without_rows_there_is_nothing_to_say() -> None:
    found = watch([])
    assert (found.events, found.changed) == ((), ())
    assert [json.loads(line)["event"] for line in stream(found)] == ["watch", "end"]


@pytest.mark.parametrize("value", [np.nan, -1e-6])
def test_a_night_with_impossible_numbers_is_left_out(value: float) -> None:
    nights = robot_nights("arm", 18, moved_at=14)
    covariance = nights[3].covariance.copy()
    covariance[0, 0] = value
    found = watch([*nights[:3], replace(nights[3], covariance=covariance), *nights[4:]])
    [left_out] = [event for event in found.events if isinstance(event, NoAnswerEvent)]
    assert left_out.when_ns == day_ns(3)
    assert "run this night again" in left_out.reason
    assert found.alarms == watch([*nights[:3], *nights[4:]]).alarms != ()
