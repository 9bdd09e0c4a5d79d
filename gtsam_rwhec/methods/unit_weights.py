"""A X = Y B with all weights 1 as the certified solver's quadratic form, for methods whose cost has no noise model.

A radian weighs as much as a metre (times the square root of two, by the Frobenius norm). Translations and a shared
scale are eliminated exactly: x'Q'x over x = [vec R_1, ..., vec R_n, 1] is the smallest cost for given rotations (RWHEC
paper, eq. 48), its 1/2 included.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import FrameError, ScaleError
from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.answers import answer_of
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part, parts_of
from gtsam_rwhec.solver.reduced_form import ReducedForm

#: The name of this cost in ``Estimate.proof``.
COST = "J with all weights 1"


@dataclass(frozen=True)
class UnitForm:
    """The form of one connected problem, and the way back to its poses.

    With ``turned`` it is the form of B X^-1 = Y^-1 A, whose frames are the inverses of the problem's frames.
    """

    part: Part
    forms: PartForm
    turned: bool

    @staticmethod
    def of(problem: Problem, *, turned: bool = False) -> UnitForm:
        """The form of raw measurements; FrameError for a problem that falls into unconnected parts."""
        parts = parts_of(unit_weights(problem, turned=turned))
        if len(parts) > 1:
            raise FrameError(
                f"the measurements fall into {len(parts)} unconnected parts (one part has "
                f"{', '.join(parts[0].names)}); solve each part as a problem of its own"
            )
        return UnitForm(parts[0], PartForm.of(parts[0]), turned)

    @property
    def reduced(self) -> ReducedForm:
        """Q', translations eliminated."""
        return self.forms.reduced

    @property
    def rotations_alone(self) -> ReducedForm:
        """The form of the rotation residuals alone."""
        form = self.forms.rotation  # over [vec R] of each frame; the numbers before it, [t, s], have no residual here
        before = (13 - form.frames.shape[1], 0)
        return ReducedForm.of(
            replace(
                form,
                frames=np.pad(form.frames, ((0, 0), before, before)),
                tails=np.pad(form.tails, ((0, 0), before, (0, 0))),
                couplings=np.pad(form.couplings, ((0, 0), before, before)),
            )
        )

    def rotations_of(self, X: Poses, Y: Poses) -> Array:
        """Rotations (n, 3, 3) of given poses, as the form has them."""
        poses = {**X, **Y}
        R = np.array([one_transform(poses[name], f"start of {name}")[:3, :3] for name in self.part.free])
        return np.ascontiguousarray(R.transpose(0, 2, 1)) if self.turned else R

    def outcome(self, R: Array, starts_from: str | None = None, notes: tuple[str, ...] = ()) -> Outcome[Poses]:
        """Poses with the best translations (and scale) for rotations R (n, 3, 3); ScaleError if the scale is <= 0."""
        answer = answer_of(self.part, self.reduced, R)
        if not answer.scale > 0.0:
            raise ScaleError(
                f"the scale of least cost is {answer.scale:.6g}; a real scale is positive. Check the conventions of "
                "the poses, or move along more than one circle or sphere"
            )
        T: Array = np.tile(np.eye(4), (len(R), 1, 1))
        T[:, :3, :3] = answer.R
        T[:, :3, 3] = answer.t + np.array([self.part.frame_shift(name) for name in self.part.free])
        if self.turned:
            T = np.linalg.inv(T)
        poses = dict(zip(self.part.free, T, strict=True))
        X = {name: poses[name] for name in self.part.targets}
        Y = {name: poses[name] for name in self.part.sensors}
        return Outcome(X, Y, answer.scale, starts_from=starts_from, notes=notes)


def unit_weights(problem: Problem, *, turned: bool = False) -> Problem:
    """The same measurements with sigma = 1 m and kappa = 1; ``turned``: as B X^-1 = Y^-1 A."""
    plain = Problem(problem.scale, keep_measurements=turned)
    for target, sensor in problem.pairs:
        raw = problem.measurements(target, sensor)
        A, B = (raw.B, raw.A) if turned else (raw.A, raw.B)
        if target == sensor:
            plain.add_motion(sensor, A, B)
        else:
            plain.add(target, sensor, A, B)
    return plain
