"""The tables of the neutral benchmark: leaderboard, ratios to the best baseline, coverage, what is not unique."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable

import numpy as np
from bars import Row, Share
from kinhec_answers import Answer, Error, Offsets
from kinhec_sequences import TRACKS
from rich.table import Table

OURS = "rw.calibrate"
#: Of the hand-eye pose's median error over the best baseline's; robot_error cannot be won for sure: errors of the last
#: link are part of X.
MOST_RATIO = dict.fromkeys(TRACKS, 1.0) | {"robot_error": 1.05}
#: Shares of ellipsoids of 95 %.
BAND = dict.fromkeys(TRACKS, (0.93, 0.98)) | {"robot_error": (0.90, 0.99)}
FIRST_BY_MEAN, MOST_OUTSIDE, OFFSET_RATIO = 7, 1e-3, 0.5
Statistic = dict[str, tuple[Error, Error]]


def compared(answers: Iterable[Answer]) -> dict[str, list[Answer]]:
    """By track, the sequences over which errors are compared: those whose answer we call unique and proven.

    And those for which we have no answer although the baselines do: our error is infinite there.
    """
    found: dict[str, list[Answer]] = {track: [] for track in TRACKS}
    for answer in answers:
        if answer.ours.status == "unique" or (answer.ours.status == "no answer" and answer.keyframes):
            found[answer.track].append(answer)
    return {track: of_track for track, of_track in found.items() if of_track}


def statistics(answers: list[Answer]) -> Statistic:
    """By method, the median and the mean error (degrees, millimetres).

    As KinHEC counts, a baseline's are over the sequences for which it has an answer; ours are over all.
    """
    errors = {name: np.array([a.baselines[name] for a in answers]) for name in answers[0].baselines}
    errors = {name: of[np.isfinite(of).all(axis=1)] for name, of in errors.items()}
    errors = {name: of for name, of in errors.items() if len(of)}
    errors[OURS] = np.array([a.ours.error for a in answers])
    return {
        name: (_pair(np.median(of, axis=0)), _pair(np.mean(of, axis=0)))  # type: ignore[arg-type]
        for name, of in errors.items()
    }


def ratio(of: Statistic, which: int) -> tuple[float, float, float]:
    """Our error over the best baseline's: of rotation, of translation, and their geometric mean.

    ``which`` is 0 for medians and 1 for means. Rotation and translation are each compared with the baseline that is
    best there: no single one need be as good.
    """
    best = [min(both[which][k] for name, both in of.items() if name != OURS) for k in (0, 1)]
    rotation, translation = (of[OURS][which][k] / best[k] for k in (0, 1))
    return rotation, translation, math.sqrt(rotation * translation)


def leaderboard(answers: Iterable[Answer]) -> list[Table]:
    """One table for each track, as KinHEC prints it, with ours among the baselines."""
    tables = []
    for track, of_track in compared(answers).items():
        table = Table(title=f"{track}: {len(of_track)} sequences", title_justify="left")
        for column in ("method", "mm, median", "mean", "degrees, median", "mean"):
            table.add_column(column, justify="left" if column == "method" else "right", no_wrap=True)
        found = statistics(of_track)
        for name, (median, mean) in sorted(found.items(), key=lambda item: item[1][0][1]):
            style = "bold" if name == OURS else None
            table.add_row(name, *(f"{x:.3g}" for x in (median[1], mean[1], median[0], mean[0])), style=style)
        tables.append(table)
    return tables


def rows(answers: list[Answer], offsets: Offsets) -> list[Row]:
    """The figures against the bars."""
    found = {track: statistics(of_track) for track, of_track in compared(answers).items()}
    result = []
    for track, of in found.items():
        rotation, translation, both = ratio(of, 0)
        bar = MOST_RATIO[track]
        result.append(
            Row(
                f"{track}: median error of X over the best baseline's",
                f"{both:.2f}x (degrees {rotation:.2f}, mm {translation:.2f})",
                f"<= {bar:g}x" if bar > 1.0 else "< 1x",
                both <= bar if bar > 1.0 else both < bar,
            )
        )
    by_mean = {track: ratio(of, 1)[2] for track, of in found.items()}
    first = [track for track, value in by_mean.items() if value < 1.0]
    is_all = len(by_mean) == len(TRACKS)
    if offsets == "true":
        result.append(
            Row(
                "mean error: tracks in which it is the smallest",
                f"{len(first)} of {len(by_mean)} ({', '.join(f'{t} {v:.2f}' for t, v in by_mean.items())})",
                f">= {FIRST_BY_MEAN}" if is_all else "",
                len(first) >= FIRST_BY_MEAN if is_all else None,
            )
        )
    else:
        result += _offset_rows(answers)
    return result + _coverage_rows(answers)


def _offset_rows(answers: list[Answer]) -> list[Row]:
    result = []
    for track in TRACKS:
        of_track = [a for a in answers if a.track == track and math.isfinite(a.ours.offset_error_ms)]
        if not of_track:
            continue
        ours = float(np.median([a.ours.offset_error_ms for a in of_track]))
        theirs = float(np.median([a.baseline_offset_error_ms for a in of_track]))
        result.append(
            Row(
                f"{track}: median error of the clock's offset over the baseline's",
                f"{ours / theirs:.2f}x ({ours:.2f} ms against {theirs:.2f} ms, {len(of_track)} sequences)",
                f"<= {OFFSET_RATIO:g}x",
                ours <= OFFSET_RATIO * theirs,
            )
        )
    return result


def _coverage_rows(answers: list[Answer]) -> list[Row]:
    result = []
    for track in TRACKS:
        of_track = [a.ours for a in answers if a.track == track and a.ours.status == "unique"]
        share = Share.of([a.held for a in of_track if a.held is not None])
        if not share.runs:
            continue
        other = Share.of([a.other_held for a in of_track if a.other_held is not None])
        least, most = BAND[track]
        result.append(
            Row(
                f"{track}: 95 % ellipsoids of X that hold the truth [99 % interval]",
                f"{share}; of the other frame {100 * other.value:.1f} %",
                f"meets {100 * least:g} to {100 * most:g} %",
                share.meets(least, most),
            )
        )
    outside = Share.of(
        [not a.ours.held_far for a in answers if a.ours.status == "unique" and a.ours.held_far is not None]
    )
    if outside.runs:
        result.append(
            Row(
                "called unique, and outside its own 99.99 % ellipsoid",
                f"{outside.held} of {outside.runs}",
                "<= 1 in 1,000",
                outside.value <= MOST_OUTSIDE,
            )
        )
    return result


def not_compared(answers: Iterable[Answer]) -> Table:
    """The sequences that are left out of the comparison, with everybody's errors on them."""
    table = Table(title="Sequences that we do not call unique, with everybody's errors on them", title_justify="left")
    for column in (
        "sequence",
        "status",
        "verdict",
        "ours: deg, mm",
        "best baseline",
        "median baseline",
        "worst baseline",
    ):
        table.add_column(column, overflow="fold")
    for answer in answers:
        if answer.ours.status == "unique":
            continue
        errors = sorted(answer.baselines.values(), key=lambda error: error[1])
        shown = (errors[0], errors[len(errors) // 2], errors[-1])
        table.add_row(
            answer.name, answer.ours.status, answer.ours.verdict, _words(answer.ours.error), *map(_words, shown)
        )
    return table


def verdicts(answers: Iterable[Answer]) -> Table:
    """By track, how many of each verdict, how many 95 % ellipsoids held under it, and the grounds."""
    counted: dict[tuple[str, str, str], list[Answer]] = defaultdict(list)
    for answer in answers:
        counted[answer.track, answer.ours.verdict, answer.ours.status].append(answer)
    table = Table(title="What was said", title_justify="left")
    for column in (
        "track",
        "verdict",
        "status",
        "sequences",
        "95 % held",
        "99.99 % held",
        "median mm",
        "seconds, median, most",
    ):
        table.add_column(column, overflow="fold")
    for (track, verdict, status), of in sorted(counted.items(), key=lambda item: (TRACKS.index(item[0][0]), item[0])):
        held, far = (
            Share.of([getattr(a.ours, name) for a in of if getattr(a.ours, name) is not None])
            for name in ("held", "held_far")
        )
        seconds = [a.ours.seconds for a in of]
        table.add_row(
            track, verdict, status, str(len(of)),
            f"{held.held} of {held.runs}", f"{far.held} of {far.runs}",
            f"{np.median([a.ours.error[1] for a in of]):.3g}",
            f"{np.median(seconds):.2f}, {max(seconds):.2f}",
        )  # fmt: skip
    return table


def _pair(values: np.ndarray) -> Error:
    return float(values[0]), float(values[1])


def _words(error: Error) -> str:
    return f"{error[0]:.3g}, {error[1]:.3g}"
