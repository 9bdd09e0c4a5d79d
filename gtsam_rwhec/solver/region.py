"""The region in which a bound holds, where the measurements leave a translation or a scale free.

Exactly free directions exist only in exact arithmetic. The measurements as given are rounded to doubles, and an answer
that is far enough away can have a lower cost because of this rounding. So where a bound rests on a free direction, it
holds up to a distance, and the certificate names it.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import ROUND_DOWN, Context

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import Answer, Point, as_point
from gtsam_rwhec.solver.parts import Part

#: The region reaches at least this many times the extent of the data, and the scale at least by this factor.
AT_LEAST = 100.0
#: Regions larger than the smallest one by these factors are tried first.
LARGER = (1e4, 1e3, 1e2, 1e1)


@dataclass(frozen=True)
class Region:
    """The answers that a lower bound is about: all rotations, and translations and scales as below.

    The translation of each frame differs from that of the returned pose by at most ``radius_m``, and each unknown scale
    from the returned one by at most a ``scale_factor``, either way.
    """

    radius_m: float
    scale_factor: float

    def larger(self, times: float) -> Region:
        """The region with ``times`` the radius and ``times`` the factor."""
        return Region(times * self.radius_m, times * self.scale_factor)

    @staticmethod
    def common(regions: list[Region | None]) -> Region | None:
        """The intersection of the regions; None stands for all answers."""
        named = [region for region in regions if region is not None]
        if not named:
            return None
        return Region(min(r.radius_m for r in named), min(r.scale_factor for r in named))

    def around(self, distance_m: float, scale_ratio: float) -> Region:
        """The region about another answer at this distance and scale ratio (at most) that is surely inside this one."""
        return Region(self.radius_m - distance_m, self.scale_factor / scale_ratio)

    def __str__(self) -> str:
        return (
            f"the bound holds for translations within {self.distance} of the answer's, and for unknown scales within a "
            f"factor of {self.factor}"
        )

    @property
    def distance(self) -> str:
        """The radius in words, rounded down: "353 m", "35.3 km"."""
        return f"{_down(self.radius_m)} m" if self.radius_m < 1e4 else f"{_down(1e-3 * self.radius_m)} km"

    @property
    def factor(self) -> str:
        """The scale's factor in words, rounded down."""
        return _down(self.scale_factor)


def _down(number: float) -> str:
    """Three digits of a number, rounded towards zero."""
    cut = Context(prec=3, rounding=ROUND_DOWN).create_decimal_from_float(number)
    return f"{cut:f}" if cut < 10**6 else f"{float(cut):.3g}"


def extent_of(part: Part, point: Point) -> float:
    """The size of what was measured, in metres, about the gauge: no translation of A, B, X, Y or Y^-1 A X is larger.

    Where the measurements were not kept, what the gauge was moved by is added to their lengths.
    """
    moments, scale = part.moments, part.known_scales.copy()
    if part.scale == "shared":
        scale[:] = abs(point.alpha) if part.kind == "direct" else 1.0 / abs(point.alpha)
    scale[part.owns_scale] = 1.0 / np.abs(point.numbers[part.ends[part.owns_scale, 0], 3])
    reach = np.linalg.norm(point.numbers[:, :3], axis=1).max(initial=0.0)
    largest = [0.0]
    if part.given is None:
        largest += [float(moments.longest[:, 0].max()), float((moments.longest[:, 1] / scale).max())]
    else:
        a = part.gauge.sensor_carrier
        for e, raw in part.given.batches:
            c = a if part.pairs[e].is_motion else part.gauge.target_carrier
            centred = raw.A[:, :3, 3] + raw.A[:, :3, :3] @ c - a
            largest.append(float(np.linalg.norm(centred, axis=1).max()))
            largest.append(float(np.linalg.norm(raw.B[:, :3, 3], axis=1).max() / scale[e]))
        for directed in part.directed:
            largest.append(directed.extent(*part.centres(directed.e), float(scale[directed.e])))
        for shared in part.given.shared:
            many, pair = shared.many, np.repeat(shared.pair, shared.many.counts)
            A, B = many.A[pair >= 0, :3], many.B[pair >= 0, :3, 3]
            centred = A[:, :, 3] + A[:, :, :3] @ part.gauge.target_carrier - a
            largest.append(float(np.linalg.norm(centred, axis=1).max()))
            largest.append(float((np.linalg.norm(B, axis=1) / scale[pair[pair >= 0]]).max()))
    # |R_A t_X + t_A - t_Y|: a poor answer may see a target farther away than any A or B reaches.
    largest.append(max(largest) + 2.0 * float(reach / scale[0] if part.kind == "direct" else reach))
    return max(max(each for each in largest if np.isfinite(each)), 1e-9) * (1.0 + 1e-9)


def smallest_region(part: Part, point: Point, contains: Answer | None) -> Region:
    """The smallest region for a bound; if ``contains`` is given, at least twice as large as needed to contain it."""
    radius, factor = AT_LEAST * extent_of(part, point), AT_LEAST
    if contains is not None:
        reach = float(np.linalg.norm(contains.t, axis=1).max(initial=0.0))
        radius = 2.5 * max(radius, reach)
        ratio = scale_ratio(point, as_point(part, contains))
        factor = 2.0 * max(factor, ratio * ratio)
    return Region(radius, factor)


def scale_ratio(first: Point, second: Point) -> float:
    """The largest ratio of an unknown scale of one point to that of the other; at least 1."""
    ratios = [1.0]
    for a, b in ((first.numbers[:, 3], second.numbers[:, 3]), ([first.alpha], [second.alpha])):
        for p, q in zip(np.abs(a), np.abs(b), strict=True):
            if p > 0.0 and q > 0.0:
                ratios += [float(p / q), float(q / p)]
    return max(ratios)


def half_widths(part: Part, point: Point, region: Region) -> Array:
    """How far each of the form's variables (13 n + 1,) is from the point at most, for any answer in the region."""
    n = len(point.numbers)
    width = np.empty((n, 13))
    width[:, 4:] = 1.0 + np.abs(point.numbers[:, 4:])
    reach = np.linalg.norm(point.numbers[:, :3], axis=1, keepdims=True)
    scale, factor = abs(point.alpha), region.scale_factor
    if part.kind == "direct" and part.scale == "shared":
        # alpha t - alpha_0 t_0, with alpha up to factor times alpha_0; reach is alpha_0 |t_0|
        width[:, :3] = factor * (scale * region.radius_m + reach)
    elif part.kind == "direct":
        width[:, :3] = region.radius_m
    else:  # -R't and -R_0't_0
        width[:, :3] = region.radius_m + 2.0 * reach
    width[:, 3] = factor * np.abs(point.numbers[:, 3])
    return np.append(width.ravel(), factor * scale) * (1.0 + 1e-9)
