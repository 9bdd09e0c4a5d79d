"""Poses and scales from the variables of the form, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import ScaleError
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.problem.knowledge import checked_scale
from gtsam_rwhec.solver.descent import SearchForm, homogeneous
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.point import Point
from gtsam_rwhec.solver.rotations import vec


@dataclass(frozen=True)
class Answer:
    """Poses X and Y of the free frames about a part's gauge (never inverted), in metres.

    R (n, 3, 3) and t (n, 3) have the order of ``part.free``. own_scale (n,) is nan for a frame without an own scale,
    and ``scale`` is the shared scale. A scale that the measurements leave free is 1.
    """

    R: Array
    t: Array
    own_scale: Array
    scale: float

    @property
    def has_positive_scales(self) -> bool:
        """Whether every scale is positive and finite."""
        scales = np.append(self.own_scale[~np.isnan(self.own_scale)], self.scale)
        return bool(((scales > 0.0) & np.isfinite(scales)).all())


def answer_of(part: Part, form: SearchForm, R: Array) -> Answer:
    """The answer with the optimal translations and scales for given rotations of the form (eq. 47)."""
    leaf, center, alpha = form.recover(homogeneous(R))
    return answer_at(part, R, np.concatenate([leaf, center]), float(alpha[0]))


def answer_at(part: Part, R: Array, numbers: Array, alpha: float) -> Answer:
    """The answer at values of the form's variables: R (n, 3, 3), numbers (n, 4) as [t, own scale], and alpha."""
    t, s = numbers[:, :3], numbers[:, 3]
    owners = set(part.scale_owners)
    own = np.array([name in owners for name in part.free], dtype=bool)
    own_scale = np.full(len(R), np.nan)
    if part.kind == "direct":
        scale = alpha if part.scale == "shared" else 1.0
        return Answer(R, t / scale if scale else t, own_scale, scale)
    with np.errstate(divide="ignore"):
        own_scale[own] = 1.0 / s[own]
        scale = float(1.0 / np.float64(alpha)) if part.scale == "shared" else 1.0
    inverse_R = R.transpose(0, 2, 1)
    return Answer(inverse_R, -np.einsum("nij,nj->ni", inverse_R, t), own_scale, scale)


def scales_of(part: Part, answer: Answer) -> dict[str, float]:
    """The scale alpha of each frame's measurements: shared, known, or the frame's own."""
    own = dict(zip(part.free, answer.own_scale.tolist(), strict=True))
    scales = dict.fromkeys(part.names, answer.scale if part.scale == "shared" else 1.0) | part.fixed_scales
    return scales | {name: own[name] for name in part.scale_owners}


def as_point(part: Part, answer: Answer) -> Point:
    """The values of the form's variables at an answer, about the part's gauge: the inverse of ``answer_of``."""
    numbers = np.zeros((len(answer.R), 13))
    if part.kind == "direct":
        alpha = answer.scale if part.scale == "shared" else 1.0
        numbers[:, :3] = alpha * answer.t
        numbers[:, 4:] = vec(answer.R)
        return Point(numbers, answer.scale)
    inverse_R = answer.R.transpose(0, 2, 1)
    numbers[:, :3] = -np.einsum("nij,nj->ni", inverse_R, answer.t)
    has = np.isfinite(answer.own_scale)
    with np.errstate(divide="ignore"):
        numbers[has, 3] = 1.0 / answer.own_scale[has]
        alpha = float(1.0 / np.float64(answer.scale))
    numbers[:, 4:] = vec(inverse_R)
    return Point(numbers, alpha)


def rotations_as_variables(part: Part, R: Array) -> Array:
    """Rotations of frames as the form has them: transposed in the inverse form."""
    return R if part.kind == "direct" else np.ascontiguousarray(R.transpose(0, 2, 1))


def given_answer(
    part: Part, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike], scale: float | Mapping[str, float]
) -> Answer:
    """The user's poses as an answer, about the part's gauge."""
    transforms = []
    for name in part.free:
        poses, what = (X, "X") if name in part.targets else (Y, "Y")
        transforms.append(one_transform(poses[name], f"{what}[{name!r}]"))
    stacked = np.array(transforms).reshape(-1, 4, 4)
    shift = np.array([part.frame_shift(name) for name in part.free]).reshape(-1, 3)
    own = np.full(len(part.free), np.nan)
    for i, name in enumerate(part.free):
        if name in part.scale_owners:
            own[i] = _scale_of(name, scale)
    shared = checked_scale(scale, "the answer's scale of all targets") if part.scale == "shared" else 1.0
    return Answer(np.ascontiguousarray(stacked[:, :3, :3]), stacked[:, :3, 3] - shift, own, shared)


def given_translations(part: Part, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike]) -> Array:
    """The translations (n, 3) of the user's poses as they were given, in metres about the user's origin."""
    poses = [(X if name in part.targets else Y)[name] for name in part.free]
    return np.array([one_transform(pose, "the answer")[:3, 3] for pose in poses]).reshape(-1, 3)


def _scale_of(name: str, scale: float | Mapping[str, float]) -> float:
    """A frame's own scale: its entry, or the one number for all."""
    if isinstance(scale, Mapping):
        if name not in scale:
            raise ScaleError(f"the answer's scale lacks {name}; it has {', '.join(map(shown, scale)) or 'nothing'}")
        return checked_scale(scale[name], f"the answer's scale of {name}")
    return checked_scale(scale, f"the answer's scale of {name}")
