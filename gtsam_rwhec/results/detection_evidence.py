"""What was seen: detections over time, what was removed and why, corners in the images, and the worst images."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np
from pydantic import ConfigDict

from gtsam_rwhec.errors import CountError
from gtsam_rwhec.fitting.pair_data import local_paths
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.file_record import Count, FileRecord, PositiveCount
from gtsam_rwhec.results.image_errors import (
    SeenCamera,
    SeenView,
    WorstImage,
    board_of,
    rated_views,
    seen_cameras,
    worst_image,
    worst_views,
)
from gtsam_rwhec.results.linear_model import MeasuredRows

#: Time is divided into this many pieces: a figure cannot show more.
PIECES = 400
#: So many rows of detections over time; with more pairs there is one row a sensor.
MOST_ROWS = 24
#: So many removed measurements are listed.
MOST_LISTED = 200


class SeenTrack(FileRecord):
    """Measurements of a pair, or of all targets by a sensor, over time."""

    sensor: str
    target: str | None  #: The target's name; null: all targets together
    used: Count  #: Measurements in the answer
    removed: Count  #: Measurements that are not
    used_at: tuple[tuple[int, int], ...]  #: Pieces of time with measurements in the answer, and how many
    removed_at: dict[str, tuple[tuple[int, int], ...]]  #: The same of removed measurements, by stage


class RemovedCount(FileRecord):
    """How many measurements of a pair were removed for a reason."""

    target: str
    sensor: str
    stage: str  #: Which stage removed them
    reason: str  #: Why
    count: PositiveCount  #: How many


class RemovedMeasurement(FileRecord):
    """A measurement that was removed."""

    target: str
    sensor: str
    reason: str  #: Why
    image: str  #: Name of the image's file; else its stamp in nanoseconds, or its place in the pair
    time_s: float | None  #: Since the first measurement; null without stamps


class SeenEvidence(FileRecord):
    """What was seen."""

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    span_s: float | None  #: From the first measurement to the last; null: no stamps
    pieces: PositiveCount  #: Pieces that the time, or without stamps the order, is divided into
    tracks: tuple[SeenTrack, ...]  #: A row each of the figure over time
    used: Count  #: Measurements in the answer
    removed: Count  #: Measurements that are not
    removed_counts: tuple[RemovedCount, ...]  #: All that was removed, by pair, stage and reason
    removed_list: tuple[RemovedMeasurement, ...]  #: The first that were removed
    cameras: tuple[SeenCamera, ...] = ()  #: Cameras with corners
    worst: tuple[WorstImage, ...] = ()  #: Images whose corners are farthest off, worst first
    sheet: bytes | None = None  #: Contact sheet, JPEG, base64
    no_pictures: str = ""  #: Why there are no images; empty where there are some


class Marked(Protocol):
    """Measurements of a pair, each with the reason why it is not used, empty where it is."""

    @property
    def stamps_ns(self) -> np.ndarray | None:
        """(N,) integers, or None."""

    @property
    def reasons(self) -> tuple[str, ...]:
        """The reason of each measurement."""


def span_of(pairs: Iterable[Marked]) -> tuple[int, float | None]:
    """The first stamp, and seconds to the last one; None where measurements have no stamps."""
    stamps = [measured.stamps_ns for measured in pairs if len(measured.reasons)]
    known = [each for each in stamps if each is not None]
    if not known or len(known) < len(stamps):
        return 0, None
    first = min(int(each.min()) for each in known)
    return first, 1e-9 * (max(int(each.max()) for each in known) - first)


def tracks_of(pairs: Mapping[Pair, Marked], stage_of: Callable[[str], str]) -> tuple[SeenTrack, ...]:
    """A row for each pair, sensor by sensor; with many pairs one for each sensor, those with the most removed first."""
    first, span = span_of(pairs.values())
    are_many = len(pairs) > MOST_ROWS
    counts: dict[tuple[str, str | None], Counter[tuple[str, int]]] = defaultdict(Counter)
    for pair, measured in sorted(pairs.items(), key=lambda item: item[0].sensor):
        stages = {reason: stage_of(reason) if reason else "" for reason in set(measured.reasons)}
        places = zip(measured.reasons, _pieces(measured, first, span), strict=True)
        counts[pair.sensor, None if are_many else pair.target].update((stages[why], piece) for why, piece in places)
    tracks = [_track(sensor, target, count) for (sensor, target), count in counts.items()]
    if are_many:
        tracks.sort(key=lambda track: -track.removed)
    return tuple(tracks[:MOST_ROWS])


def _pieces(measured: Marked, first: int, span: float | None) -> list[int]:
    """The piece of time of each measurement."""
    if span is None or measured.stamps_ns is None:
        share = np.arange(len(measured.reasons)) / max(len(measured.reasons), 1)
    else:
        share = 1e-9 * (measured.stamps_ns - first) / (span or 1.0)
    pieces: list[int] = np.minimum((PIECES * share).astype(int), PIECES - 1).tolist()
    return pieces


def _track(sensor: str, target: str | None, count: Counter[tuple[str, int]]) -> SeenTrack:
    """A row of the figure, of how many measurements each stage removed in each piece; no stage: they are used."""
    at: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for (stage, piece), number in sorted(count.items()):
        at[stage].append((piece, number))
    used_at = at.pop("", [])
    used = sum(number for _, number in used_at)
    removed_at = {stage: tuple(pieces) for stage, pieces in at.items()}
    return SeenTrack(
        sensor=sensor,
        target=target,
        used=used,
        removed=count.total() - used,
        used_at=tuple(used_at),
        removed_at=removed_at,
    )


def counts_of(
    removed: Iterable[tuple[Pair, Mapping[str, int]]], stage_of: Callable[[str], str]
) -> tuple[RemovedCount, ...]:
    """Counts by pair and reason as records; measurements without a reason are used, and not counted."""
    return tuple(
        RemovedCount(target=pair.target, sensor=pair.sensor, stage=stage_of(reason), reason=reason, count=count)
        for pair, reasons in removed
        for reason, count in reasons.items()
        if reason and count
    )


def removed_list(pairs: Mapping[Pair, Marked], name_of: Callable[[str, int], str]) -> tuple[RemovedMeasurement, ...]:
    """The first removed measurements in order of time; `name_of` has an image's name by sensor and stamp."""
    first, span = span_of(pairs.values())
    found = sorted(_removed(pairs), key=lambda one: (one[0], one[1].sensor, one[1].target))
    return tuple(
        RemovedMeasurement(
            target=pair.target,
            sensor=pair.sensor,
            reason=reason,
            image=f"measurement {stamp + 1}" if span is None else name_of(pair.sensor, stamp),
            time_s=None if span is None else round(1e-9 * (stamp - first), 6),
        )
        for stamp, pair, reason in found[:MOST_LISTED]
    )


def _removed(pairs: Mapping[Pair, Marked]) -> Iterator[tuple[int, Pair, str]]:
    """Stamps, or without them places in the pair, of all that was removed."""
    is_stamped = span_of(pairs.values())[1] is not None
    for pair, measured in pairs.items():
        stamps: Sequence[int] = range(len(measured.reasons))
        if is_stamped and measured.stamps_ns is not None:
            stamps = measured.stamps_ns.tolist()
        yield from ((stamp, pair, why) for stamp, why in zip(stamps, measured.reasons, strict=True) if why)


#: The stage that removes measurements of a problem.
ROBUST = "robust estimation"


def seen_in_problem(
    problem: Problem, refined: Refined | None, rows: Mapping[Pair, MeasuredRows], carrier_path: Trajectory | None = None
) -> SeenEvidence:
    """What was seen, of a problem and its measurements; corners are there where there is a refined calibration."""
    used = sum(int(measured.used.sum()) for measured in rows.values())
    views = {} if refined is None else _views(problem, refined, rows, carrier_path)
    found = None if refined is None else refined.reprojection
    cameras = dict(problem.cameras)
    if refined is not None:
        cameras |= {sensor: one.camera for sensor, one in refined.intrinsics.items()}
    noise = (problem.corner_px or 0.1) if found is None else found.corner_px
    rated = rated_views(views, cameras, found, lambda target, sensor: noise)
    is_stamped = span_of(rows.values())[1] is not None
    return SeenEvidence(
        span_s=span_of(rows.values())[1],
        pieces=PIECES,
        tracks=tracks_of(rows, lambda reason: ROBUST),
        used=used,
        removed=sum(len(measured.reasons) for measured in rows.values()) - used,
        removed_counts=counts_of(
            ((pair, Counter(measured.reasons)) for pair, measured in rows.items()), lambda reason: ROBUST
        ),
        removed_list=removed_list(rows, lambda sensor, stamp: str(stamp)),
        cameras=seen_cameras(rated, cameras, found),
        worst=tuple(
            worst_image(one, str(one.view.stamp_ns) if is_stamped else f"measurement {one.view.stamp_ns + 1}")
            for one in worst_views(rated)
        ),
        no_pictures="the measurements were given without images.",
    )


def _views(
    problem: Problem, refined: Refined, rows: Mapping[Pair, MeasuredRows], path: Trajectory | None
) -> dict[str, list[SeenView]]:
    """The corners of a problem's images, by sensor, with A at the final time offsets."""
    late = dict(refined.time_offsets_s)
    try:
        paths = local_paths(problem, tuple(late), path)
    except CountError:  # the motion that gave the offsets is not known here: A as it was measured is what is left
        paths = {}
    views: dict[str, list[SeenView]] = {}
    for pair, measured in rows.items():
        pixels = problem.measurements(*pair).pixels
        if pixels is None or pair.target not in refined.X or pair.sensor not in refined.Y:
            continue
        A = measured.A @ paths[pair].motion(late[pair.sensor]) if pair in paths else measured.A
        T = np.linalg.inv(refined.Y[pair.sensor].matrix()) @ A
        X, board = refined.X[pair.target].matrix(), board_of(refined, pair.target, problem.boards[pair.target])
        seen: np.ndarray = np.asarray(np.isfinite(pixels).all(axis=2))
        for i in np.flatnonzero(seen.any(axis=1)).tolist():
            stamp = i if measured.stamps_ns is None else int(measured.stamps_ns[i])
            views.setdefault(pair.sensor, []).append(
                SeenView.of(
                    pixels[i, seen[i]], board[seen[i]], T[i], X, stamp, pair.target, is_used=not measured.reasons[i]
                )
            )
    return views
