"""Whether the cameras are on the moving frame or beside it: both are solved for, and the residuals compared.

With poses T_base_hand, a camera on the hand that sees targets beside the robot has A = T_hand_base; a camera beside the
robot that sees targets on the hand has A = T_base_hand. Only one of them explains what the camera saw, where the motion
is rich enough. Scales are free, because sizes of targets are guesses here.

Poses that are given as T_hand_base look the same as exchanged roles: A is then inverted too. No measurement tells these
two apart; the frames' names in the log do, or a person.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.trial_fits import TrialFit, fitted
from gtsam_rwhec.cameras.board_turns import choose_turns, turns_about_z
from gtsam_rwhec.cameras.plane_ambiguity import choose_over_time
from gtsam_rwhec.cameras.targets import Checkerboard, CircleGrid, Target
from gtsam_rwhec.detect.detector import Detection
from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem

#: A sensor's target counts with at least this number of images.
LEAST_IMAGES = 6
#: At most this number of pairs of a sensor and a target, those with the most images, are solved for.
MOST_PAIRS = 12
#: The product of the residuals' ratios, rotations and translations, must be at least this: one role fits far better.
FAR_BETTER = 9.0
#: And what fits better must explain the rotations to this (rad), and the translations (m).
EXPLAINED_RAD, EXPLAINED_M = math.radians(3.0), 0.05
#: Corners have about this standard deviation where nobody has measured it, pixels.
CORNER_PX = 0.3
#: Images have stamps this far apart where they have none, nanoseconds.
STEP_NS = 10**9

Role = Literal["child", "parent"]


@dataclass(frozen=True, eq=False)
class Seen:
    """A target in one image of a sensor, with the carriers' pose then."""

    sensor: str
    target: Target
    detection: Detection
    T: Array  #: (4, 4), T_parent_child of the poses


@dataclass(frozen=True, eq=False)
class RoleEvidence:
    """What solving for both roles says.

    Attributes
    ----------
    child, parent : TrialFit or None
        The robust fit if the sensors are on the child of the poses, or on their parent; None without an answer.
    images : int
        The number of measurements.
    """

    child: TrialFit | None
    parent: TrialFit | None
    images: int

    @property
    def role(self) -> Role | None:
        """Which of the poses' frames carries the sensors; None if the data cannot tell."""
        if self.child is None or self.parent is None:
            return None
        better, worse = sorted((self.child, self.parent), key=_product)
        explains = better.residual.rotation_rad < EXPLAINED_RAD and _translation_m(better) < EXPLAINED_M
        tells = explains and _product(worse) > FAR_BETTER * _product(better)
        return None if not tells else "child" if better is self.child else "parent"

    def explains_far_better(self, other: RoleEvidence) -> bool:
        """Whether one role explains these measurements, and far better than either does the other's."""
        if self.role is None:
            return False
        fits = [fit for fit in (other.child, other.parent) if fit is not None]
        mine = min(_product(fit) for fit in (self.child, self.parent) if fit is not None)
        return all(_product(fit) > FAR_BETTER * mine for fit in fits)

    def is_better_than(self, other: RoleEvidence) -> bool:
        """Whether the better of both roles has smaller residuals than that of other measurements' roles."""
        mine, theirs = (
            min((_product(fit) for fit in (one.child, one.parent) if fit is not None), default=math.inf)
            for one in (self, other)
        )
        return mine < theirs

    @property
    def sizes(self) -> dict[str, float]:
        """True lengths over guessed ones, by target, as the fit of the role says; empty where the data cannot tell."""
        fit = {"child": self.child, "parent": self.parent, None: None}[self.role]
        if fit is None or not isinstance(fit.scale, dict):
            return {}
        return {name: 1.0 / scale for name, scale in fit.scale.items() if scale > 0.0}

    def in_words(self, parent: str, child: str) -> str:
        """The figures of both, in one phrase."""
        return (
            f"solved both ways over {self.images} measurements, the median residual is {_figures(self.child)} with the "
            f"cameras on {child}, and {_figures(self.parent)} with them on {parent}"
        )


def evidence_of_roles(seen: Iterable[Seen]) -> RoleEvidence:
    """Solve for both roles, with free scales."""
    tracks: dict[Pair, list[Seen]] = defaultdict(list)
    for one in seen:
        if one.detection.rejection is None and np.isfinite(one.T).all():
            tracks[Pair(one.target.name, one.sensor)].append(one)
    chosen = sorted((pair for pair in tracks if len(tracks[pair]) >= LEAST_IMAGES), key=lambda p: -len(tracks[p]))
    chosen = chosen[:MOST_PAIRS]
    images = sum(len(tracks[pair]) for pair in chosen)
    fits = []
    for on_child in (True, False):
        sample = {pair: _track(tracks[pair], on_child) for pair in chosen}
        fits.append(fitted(Problem("per_target"), sample) if chosen else None)
    return RoleEvidence(fits[0], fits[1], images)


def _product(fit: TrialFit) -> float:
    """Of both residuals, the translations in true lengths."""
    return max(fit.residual.rotation_rad, 1e-6) * max(_translation_m(fit), 1e-9)


def _translation_m(fit: TrialFit) -> float:
    """The residual in true lengths, metres."""
    return fit.residual.translation_m / abs(fit.one_scale)


def _figures(fit: TrialFit | None) -> str:
    if fit is None:
        return "none, for want of an answer,"
    mm = 1e3 * _translation_m(fit)
    return f"{rounded(math.degrees(fit.residual.rotation_rad), 2)} deg and {rounded(mm, 2)} mm"


def _track(seen: Sequence[Seen], on_child: bool) -> tuple[Array, Array]:
    """A = T_sensorcarrier_targetcarrier and B = T_sensor_target, of its candidates and turns the one that fits A."""
    poses = np.array([one.T for one in seen])
    A = se3.inverse(poses) if on_child else poses
    T, squared, covariance = (
        np.array([getattr(one.detection, name) for one in seen]) for name in ("T", "squared_px", "covariance")
    )
    board = seen[0].target
    if isinstance(board, (Checkerboard, CircleGrid)) and board.ways > 1:
        which = choose_turns(T, covariance, squared, CORNER_PX, A, board.ways).which
        T = T.copy()
        T[..., :3, :3] = np.nan_to_num(T[..., :3, :3], nan=0.0) @ turns_about_z(board.ways)[which][:, None]
    stamps = STEP_NS * np.arange(1, len(seen) + 1)
    best = choose_over_time(stamps, T, squared, covariance, CORNER_PX, A).which
    return A, T[np.arange(len(T)), best]
