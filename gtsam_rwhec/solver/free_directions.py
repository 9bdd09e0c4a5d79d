"""Free directions: how an answer can move while the measurements still fit equally well, up to their noise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from gtsam_rwhec.files.terminal_text import listed
from gtsam_rwhec.geometry.poses import Array

#: A turn, a shift or a change takes no part in a direction if it is at most this part of the direction's largest. A
#: direction of length 1 that turns the frames by less than this (in rad) is a translation.
SHARE = 0.05
#: A sentence names at most this many frames and counts the rest.
NAMED = 4
#: A sentence names a coordinate axis where the direction is within 8 degrees of it.
AXIS_COSINE = np.cos(np.radians(8.0))
#: A motion that turns by more than this (root mean square) really turned, even if its residuals are as large.
TURNED_RAD = np.radians(3.0)
#: Up to this many measurements of a pair are one motion, which has one axis.
FEW = 2

Twist = tuple[float, float, float, float, float, float]


class FreeKind(StrEnum):
    """What moves along a free direction."""

    #: A frame turns; its translation, or another frame, may move with it.
    ROTATION = "rotation"
    #: Frames translate, and nothing turns.
    TRANSLATION = "translation"
    #: A scale changes; frames may translate with it.
    SCALE = "scale"
    #: A sensor's time offset changes.
    TIME_OFFSET = "time_offset"
    #: No direction at the answer, but another answer far away that costs as little.
    TWIN = "twin"


class FreeReason(StrEnum):
    """Why a direction is free: the reason's name in files, and its words at the end of a sentence."""

    words: str

    CONTRADICTION = (
        "contradiction",
        "the rotation residuals are as large as the motion: check whether A or B is inverted and the order of the "
        "quaternions",
    )
    FEW = "few", "no pair of these frames has more than two measurements, which are one motion"
    NO_ROTATION = "no_rotation", "the motion did not turn"
    ONE_AXIS = "one_axis", "the motion turned about one axis only"
    #: The motion turned enough, and still the information is no more than noise alone would create.
    NOISE = "noise", "the measurements say no more about it than their noise would"
    COMPENSATED = "compensated", "with these motions, translations of the frames have the same effect"
    #: A target that looks the same along it: no measurement of it, and no other frame's pose, is about this direction.
    SLIDES = "slides", "all that was seen of it slides in this direction, and no other frame's pose depends on it"
    STANDSTILL = "standstill", "the carriers moved no faster than the noise of their poses makes it seem"
    SYMMETRY = "symmetry", "the motion is symmetric or has half turns only, and two answers fit it"

    def __new__(cls, value: str, words: str) -> FreeReason:
        """A member of the table."""
        reason = str.__new__(cls, value)
        reason._value_, reason.words = value, words
        return reason


@dataclass(frozen=True)
class FreeDirection:
    """A direction in which the answer can move without a change of the residuals larger than the noise.

    It has length 1, where a rotation of 1 rad, a translation of ``length_m``, a scale times e, and a time offset of 1 s
    each count as 1. Its sign is arbitrary. ``str()`` is a sentence. The hash is of the fields that are not dicts.

    Attributes
    ----------
    frames : dict of str to (omega_x, omega_y, omega_z, v_x, v_y, v_z)
        The right perturbation T Expmap(xi) of each frame that takes part, GTSAM's order, rad and m, in its own axes. A
        frame takes no part if its turn and its shift are at most ``SHARE`` of the largest turn, shift or change.
    scale, own_scales
        Change of the logarithm of the shared scale, and of each own scale that takes part.
    time_offsets_s
        Change of each sensor's time offset, s.
    """

    kind: FreeKind
    reason: FreeReason
    frames: dict[str, Twist] = field(default_factory=dict, hash=False)
    scale: float = 0.0
    own_scales: dict[str, float] = field(default_factory=dict, hash=False)
    time_offsets_s: dict[str, float] = field(default_factory=dict, hash=False)
    length_m: float = 1.0

    def __str__(self) -> str:
        if self.kind is FreeKind.TWIN:
            return f"another answer, far from this one, costs the same: {self.reason.words}"
        first, *others = self._movements()
        what = {FreeKind.ROTATION: "rotation of ", FreeKind.TRANSLATION: "translation of "}.get(self.kind, "change of ")
        more = len(others) + 1 - NAMED
        named = others[: NAMED - 1] + ([f"{more} more"] if more > 0 else [])
        together = f", together with {listed(named)}" if named else ""
        return f"{what}{first}{together}: {self.reason.words}"

    def _movements(self) -> Iterator[str]:
        """What moves; first what the direction's kind names."""
        twists = {name: np.array(twist) / np.repeat([1.0, self.length_m], 3) for name, twist in self.frames.items()}
        turns = {name: twist[:3] for name, twist in twists.items()}
        shifts = {name: twist[3:] for name, twist in twists.items()}
        changes = {"the scale": self.scale} | {f"the scale of {name}": x for name, x in self.own_scales.items()}
        changes |= {f"the time offset of {name}": x for name, x in self.time_offsets_s.items()}
        vectors = [*turns.values(), *shifts.values(), *changes.values()]
        least = SHARE * max((float(np.linalg.norm(vector)) for vector in vectors), default=0.0)
        turning = [name for name, omega in turns.items() if np.linalg.norm(omega) > least]
        yield from (what for what, change in changes.items() if abs(change) > least)
        for name in turning:
            moves = " (its origin moves too)" if np.linalg.norm(shifts[name]) > least else ""
            yield f"{name} about {_axis(turns[name])}{moves}"
        for name, v in shifts.items():
            if name not in turning and np.linalg.norm(v) > least:
                yield f"{name} along {_axis(v)}"


def all_slide(directions: Iterable[FreeDirection]) -> bool:
    """Whether each direction, if there are any, is of a target that slides: then all that may be asked is known."""
    return all(one.reason is FreeReason.SLIDES for one in directions)


def reason_for(axes: int, turned_rad: float, residual_rad: float, measurements: int) -> FreeReason:
    """Why a direction of a pair is free.

    ``axes``: about how many axes the pair's motion turned by more than the noise (0, 1, or 2 for two and more).
    ``turned_rad`` and ``residual_rad``: root mean squares of its turning, noise included, and of its rotation
    residuals.
    """
    if axes < 2 and turned_rad > TURNED_RAD and residual_rad > 0.5 * turned_rad:
        return FreeReason.CONTRADICTION
    if measurements <= FEW:
        return FreeReason.FEW
    return (FreeReason.NO_ROTATION, FreeReason.ONE_AXIS, FreeReason.NOISE)[axes]


def sparse_basis(basis: Array, length_m: float) -> Array:
    """Another basis (7 n + 1, k) of the same free directions. Each column is as sparse as possible and has length 1.

    Columns that turn frames come first, then changes of scales, then translations.
    ``basis`` (7 n + 1, k): free directions of n frames, [omega (rad), v (m), log own scale] for each frame, then the
    shared scale's logarithm. ``length_m``: how many metres count as one radian.
    """
    if basis.shape[1] == 0:
        return basis
    frames = len(basis) // 7
    unit = _units(frames, length_m)
    weighed, _ = np.linalg.qr(basis / unit[:, None])
    row = np.tile(np.arange(7), frames)
    is_turn, is_scale = np.r_[row < 3, False], np.r_[row == 6, True]
    # The right singular vectors of the rotations' rows separate directions that turn frames from the rest.
    _, s, Vt = np.linalg.svd(weighed[is_turn], full_matrices=True)
    turns = np.zeros(len(Vt), dtype=bool)
    turns[: len(s)] = s > SHARE
    turned = _sparse(weighed @ Vt[turns].T, [is_turn])
    still = _sparse(weighed @ Vt[~turns].T, [is_scale, ~is_turn])
    columns = np.hstack([turned, still])
    columns /= np.linalg.norm(columns, axis=0)
    columns[np.abs(columns) < 1e-12] = 0.0  # rounding
    columns *= np.sign(np.take_along_axis(columns, np.abs(columns).argmax(axis=0)[None], axis=0))
    return columns * unit[:, None]


def free_directions_of(
    names: tuple[str, ...], basis: Array, length_m: float, reasons: Mapping[str, FreeReason]
) -> tuple[FreeDirection, ...]:
    """One record for each column of a ``sparse_basis`` of the frames ``names``, with what takes part in it.

    ``reasons``: the reason of each frame, from ``reason_for``.
    """
    if basis.shape[1] == 0:
        return ()
    weighed = basis / _units(len(names), length_m)[:, None]
    return tuple(_record(names, column, length_m, reasons) for column in weighed.T)


def _units(frames: int, length_m: float) -> Array:
    """The unit of each row of a basis: 1 rad, ``length_m`` metres, a scale times e."""
    unit: Array = np.r_[np.tile(np.r_[np.ones(3), np.full(3, length_m), 1.0], frames), 1.0]
    return unit


def _sparse(columns: Array, rows_first: list[np.ndarray]) -> Array:
    """Another basis (d, k) of the columns' span, by elimination: each column has a row that is zero in the others.

    ``rows_first`` are masks (d,) of rows. Such rows are searched in the first mask, then in the next. The same span
    gives the same basis, whichever ``columns`` span it.
    """
    done: dict[int, Array] = {}
    for rows in rows_first:
        while columns.shape[1]:
            size = np.where(rows, np.linalg.norm(columns, axis=1), 0.0)
            if size.max() <= SHARE:
                break
            pivot = int(np.argmax(size > 0.9 * size.max()))  # the first of several that are as large
            along = np.linalg.svd(columns[pivot : pivot + 1])[2].T  # the row is zero in all columns but the first
            new, columns = columns @ along[:, 0], columns @ along[:, 1:]
            done = {row: column - new * (column[pivot] / new[pivot]) for row, column in done.items()} | {pivot: new}
    return np.column_stack([*done.values(), columns]) if done else columns


def _record(names: tuple[str, ...], column: Array, length_m: float, reasons: Mapping[str, FreeReason]) -> FreeDirection:
    of_frame, shared = column[:-1].reshape(-1, 7), column[-1]
    # What takes part: turns, shifts and own scales of the frames (n, 3), and the shared scale.
    sizes = np.sqrt(np.add.reduceat(of_frame**2, (0, 3, 6), axis=1))
    least = SHARE * max(sizes.max(initial=0.0), abs(shared))
    takes_part = sizes > least
    of_frame = np.where(np.repeat(takes_part, (3, 3, 1), axis=1), of_frame, 0.0)
    shared = shared if abs(shared) > least else 0.0
    length = np.hypot(np.linalg.norm(of_frame), shared)
    of_frame, shared = of_frame / length, shared / length
    turns, shifts, own = takes_part.T
    without_turn = FreeKind.SCALE if own.any() or shared else FreeKind.TRANSLATION
    kind = FreeKind.ROTATION if turns.any() else without_turn
    taking_part = [reasons[name] for name, parts in zip(names, takes_part, strict=True) if parts.any()]
    reason = min(taking_part, key=list(FreeReason).index, default=FreeReason.NOISE)
    if kind is FreeKind.SCALE and reason is FreeReason.NOISE and shifts.any():
        reason = FreeReason.COMPENSATED
    metric = np.repeat([1.0, length_m], 3)
    return FreeDirection(
        kind=kind,
        reason=reason,
        frames={names[i]: _twist(of_frame[i, :6] * metric) for i in np.flatnonzero(turns | shifts)},
        scale=float(shared) + 0.0,
        own_scales={names[i]: float(of_frame[i, 6]) for i in np.flatnonzero(own)},
        length_m=length_m,
    )


def _twist(xi: Array) -> Twist:
    a, b, c, d, e, f = (xi + 0.0).tolist()  # no -0.0
    return a, b, c, d, e, f


def _axis(direction: Array) -> str:
    """Words for an axis: "its own z axis", "(0.60, 0.80, 0.00) in its own frame"."""
    direction = direction / np.linalg.norm(direction)
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) > AXIS_COSINE:
        return f"its own {'xyz'[k]} axis"
    rounded = np.round(direction * np.sign(direction[k]), 2) + 0.0  # no -0.00
    return "(" + ", ".join(f"{x:.2f}" for x in rounded) + ") in its own frame"
