"""Knowledge of a problem before any measurement: fixed frames, priors of frames, known scales."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import FrameError, OptionError, PriorError, ScaleError, TargetError
from gtsam_rwhec.files.terminal_text import brief, rounded
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.geometry.real_numbers import is_between, is_one_of
from gtsam_rwhec.problem.corners import check_camera, check_corner_px, same_board
from gtsam_rwhec.problem.measurements import LARGEST_WEIGHT, SMALLEST_WEIGHT, Pair, positive_weights

ScaleMode = Literal["known", "shared", "per_target"]
#: Scales below this are refused, as weights are: no target has them, and their squares overflow.
SMALLEST_SCALE = SMALLEST_WEIGHT
#: Scales above this are refused too.
LARGEST_SCALE = LARGEST_WEIGHT
#: Two priors on one frame contradict one another when they differ by more than this many standard deviations.
CONTRADICTION_SIGMAS = 6.0
#: Clouds are stretched if they are by this share, and by so many deviations. A focal length that is 1 % wrong shows as
#: 0.7 to 0.95 %.
STRETCHED, STRETCH_SIGMAS = 0.003, 3.0


@dataclass(frozen=True)
class Stretch:
    """By which share clouds of a sensor are longer across its z axis than along it, and the share's deviation."""

    sensor: str
    share: float
    sigma: float

    @property
    def is_clear(self) -> bool:
        """Whether no noise explains it."""
        return abs(self.share) > max(STRETCHED, STRETCH_SIGMAS * self.sigma)

    def __str__(self) -> str:
        return (
            f"the clouds of {self.sensor} are {rounded(100.0 * abs(self.share))} % "
            f"{'longer' if self.share > 0.0 else 'shorter'} across its z axis than along it (standard deviation "
            f"{rounded(100.0 * self.sigma)} %), as a wrong focal length makes them"
        )


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior: |t - t_0|^2 / sigma^2 and kappa |R - R_0|_F^2 (design fact 11); None leaves that part free.

    ``transform`` (4, 4) is the expected pose of the frame on its carrier, metres; sigma and kappa are as of
    measurements.
    """

    transform: Array
    sigma: float | None
    kappa: float | None


def difference(T: Array, S: Array) -> str:
    """The distance of two poses, in words."""
    angle = np.degrees(2.0 * np.arcsin(min(1.0, np.linalg.norm(T[:3, :3] - S[:3, :3]) / np.sqrt(8.0))))
    return f"{1e3 * np.linalg.norm(T[:3, 3] - S[:3, 3]):.4g} mm and {angle:.4g} deg apart"


def check_name(name: object, what: str) -> None:
    """Raise a FrameError for a name that is no text, or empty."""
    if not isinstance(name, str) or not name:
        raise FrameError(f"{what} is {brief(name)}; give a string that is not empty")


def checked_scale(scale: object, what: str) -> float:
    """A scale (measured over true length); a ScaleError for anything but a number from 1e-15 to 1e15."""
    if not is_between(scale, SMALLEST_SCALE, LARGEST_SCALE):
        raise ScaleError(
            f"{what} is {brief(scale)}; give a positive number from {SMALLEST_SCALE:g} to {LARGEST_SCALE:g} "
            "(measured / true length)"
        )
    return float(scale)


def scale_at(scale: float | Mapping[str, float], target: str) -> float:
    """An answer's scale of one target: its own, or the one of all."""
    return scale[target] if isinstance(scale, Mapping) else scale


def _check_agreement(name: str, first: Prior, second: Prior) -> None:
    """Raise a PriorError where two priors of a frame cannot both be true."""
    said = ""
    if first.sigma is not None and second.sigma is not None:
        distance = np.linalg.norm(first.transform[:3, 3] - second.transform[:3, 3])
        if distance > 1e-9 + CONTRADICTION_SIGMAS * np.hypot(first.sigma, second.sigma):
            said = f"standard deviations of {1e3 * first.sigma:.4g} mm and {1e3 * second.sigma:.4g} mm"
    if first.kappa is not None and second.kappa is not None:
        # The standard deviation about each axis is 1 / sqrt(2 kappa) rad, and |R - R_0|_F^2 = 2 theta^2.
        distance = np.linalg.norm(first.transform[:3, :3] - second.transform[:3, :3])
        spread = np.sqrt(1.0 / first.kappa + 1.0 / second.kappa)
        if distance > 1e-9 + CONTRADICTION_SIGMAS * spread:
            said = said or f"kappa of {first.kappa:.4g} and {second.kappa:.4g}"
    if said:
        apart = difference(first.transform, second.transform)
        raise PriorError(
            f"two stated poses of {name} contradict one another: they are {apart}, with {said}; remove one of the two, "
            "or give a larger sigma or a smaller kappa"
        )


class Knowledge:
    """Frames and scales that are known exactly or by a prior; the part of a `Problem` that is not measured.

    ``fixed`` has poses (4, 4) of frames on their carriers, metres, and ``priors`` has priors, both by the frame's name;
    ``fixed_scales`` has measured over true length by target (or by sensor for motions). Where corners were added,
    ``cameras`` has the sensors' cameras, ``boards`` the targets' corners (n, 3), metres, in their own frames, and
    ``corner_px`` the standard deviation of a corner, pixels.
    """

    def __init__(self, scale: ScaleMode) -> None:
        if not is_one_of(scale, get_args(ScaleMode)):
            raise OptionError(f"scale={brief(scale)} is not one of {', '.join(map(repr, get_args(ScaleMode)))}")
        self.scale: ScaleMode = scale
        self.fixed: dict[str, Array] = {}
        self.priors: dict[str, list[Prior]] = {}
        self.fixed_scales: dict[str, float] = {}
        self.cameras: dict[str, Camera] = {}
        self.boards: dict[str, Array] = {}
        #: Of targets in clouds: what all views are off by alike, in the sensor's axes: (6, k), one deviation a column.
        self.alike: dict[Pair, Array] = {}
        #: How such clouds are stretched.
        self.stretched: dict[Pair, Stretch] = {}
        self.corner_px: float | None = None

    def fix(self, name: str, T_carrier_frame: PoseLike) -> None:
        """Say that a frame's pose on its carrier is known exactly.

        Raises
        ------
        PriorError
            The frame is fixed at another pose already, or a prior contradicts the pose.
        """
        check_name(name, "the name of a frame that is fixed")
        T = one_transform(T_carrier_frame, f"the pose at which {name} is fixed")
        known = self.fixed.get(name)
        if known is not None and np.abs(known - T).max() > 1e-9:
            raise PriorError(
                f"{name} is fixed already, at another pose ({difference(known, T)}); remove one of the two poses"
            )
        for prior in self.priors.get(name, []):
            _check_agreement(name, Prior(T, 0.0, np.inf), prior)
        self.fixed[name] = T

    def add_prior(
        self, name: str, T_carrier_frame: PoseLike, sigma: float | None = None, kappa: float | None = None
    ) -> None:
        """Add a prior of a frame's pose on its carrier: the estimate is then MAP in place of maximum likelihood.

        Parameters
        ----------
        name : str
        T_carrier_frame : pose
        sigma : float, optional
            Standard deviation of the translation along each axis, in metres; None leaves the translation free.
        kappa : float, optional
            Concentration of the rotation, 1 / (2 s^2) for s rad about each axis; None leaves the rotation free.

        Raises
        ------
        PriorError
            The prior contradicts the fixed pose or another prior of the frame, or has neither sigma nor kappa.
        """
        check_name(name, "the name of a frame with a prior")
        where = f"the prior of {name}"
        T = one_transform(T_carrier_frame, where)
        if sigma is None and kappa is None:
            raise PriorError(f"{where} has neither sigma nor kappa; give sigma, kappa or both")
        prior = Prior(
            T,
            None if sigma is None else float(positive_weights(sigma, 0, "sigma", where)),
            None if kappa is None else float(positive_weights(kappa, 0, "kappa", where)),
        )
        if name in self.fixed:
            _check_agreement(name, Prior(self.fixed[name], 0.0, np.inf), prior)
        for other in self.priors.get(name, []):
            _check_agreement(name, other, prior)
        self.priors.setdefault(name, []).append(prior)

    def fix_scale(self, name: str, scale: float = 1.0) -> None:
        """Say that the size of a target (for motions, the odometry scale of a sensor) is known, in "per_target".

        Raises
        ------
        ScaleError
            The scale is not a number from 1e-15 to 1e15, it is fixed at another value, or the problem's scale is not
            "per_target".
        """
        check_name(name, "the name of a target of known size")
        if self.scale != "per_target":
            raise ScaleError(f"fix_scale({name!r}) needs scale='per_target'; this problem has scale={self.scale!r}")
        scale = checked_scale(scale, f"the scale of {name}")
        if self.fixed_scales.get(name, scale) != scale:
            known = self.fixed_scales[name]
            raise ScaleError(f"the scale of {name} is fixed at {known} already, and now at {scale}; fix it once")
        self.fixed_scales[name] = scale

    def _learn(self, other: Knowledge) -> None:
        """Add the knowledge of another problem, which must not contradict the knowledge here."""
        for name, T in other.fixed.items():
            self.fix(name, T)
        for name, priors in other.priors.items():
            for prior in priors:
                self.add_prior(name, prior.transform, prior.sigma, prior.kappa)
        for name, scale in other.fixed_scales.items():
            self.fix_scale(name, scale)
        for name, camera in other.cameras.items():
            self.cameras[name] = check_camera(camera, self.cameras.get(name), name, name)
        for name, board in other.boards.items():
            if not same_board(self.boards.setdefault(name, board), board):
                raise TargetError(f"{name} has other board_points in one problem than in the other; rename one of them")
        self.alike |= other.alike
        self.stretched |= other.stretched
        if other.corner_px is not None:
            self.corner_px = check_corner_px(other.corner_px, self.corner_px, "a problem that is joined")

    def _take_knowledge(self, other: Knowledge, *, frames: Collection[str] = (), scales: Collection[str] = ()) -> None:
        """Copy the knowledge of another problem, without the frames and scales named."""
        self.fixed = {name: T for name, T in other.fixed.items() if name not in frames}
        self.priors = {name: list(priors) for name, priors in other.priors.items() if name not in frames}
        self.fixed_scales = {name: scale for name, scale in other.fixed_scales.items() if name not in scales}
        self.cameras = {name: camera for name, camera in other.cameras.items() if name not in frames}
        self.boards = {name: board for name, board in other.boards.items() if name not in frames}
        self.alike = {pair: of for pair, of in other.alike.items() if not {*pair.frames} & {*frames}}
        self.stretched = {pair: of for pair, of in other.stretched.items() if not {*pair.frames} & {*frames}}
        self.corner_px = other.corner_px
