"""."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.special import chdtri, fdtri

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.files.terminal_text import brief, rounded
from gtsam_rwhec.fitting.corner_graph import CornerGraph
from gtsam_rwhec.fitting.corner_model import Point
from gtsam_rwhec.fitting.corner_noise import Noise
from gtsam_rwhec.fitting.fit_options import FreeLens
from gtsam_rwhec.fitting.stated_intrinsics import CameraPrior, Innovation, held_by_prior, is_free
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_real


@dataclass(frozen=True, eq=False)
class RefinedIntrinsics:
    """A camera's intrinsics."""

    camera: Camera
    #: (m, m): Covariance of `Camera.parameters`: fx, fy, cx, cy (pixels) and the coefficients.
    covariance: Array
    #: What was known of them, as widened.
    prior: CameraPrior
    #: The factor by which they were widened: 1 where the images do not contradict what was stated.
    widened: float
    #: The test of the intrinsics as they were stated.
    innovation: Innovation
    #: Root mean square error, along each axis, of the corners that count.
    rms_px: float
    #: What was free.
    lens: FreeLens = "all"

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return self.camera.parameter_names

    @property
    def standard_deviations(self) -> tuple[float, ...]:
        """Of the parameters."""
        return tuple(np.sqrt(np.diagonal(self.covariance)).tolist())

    @property
    def not_free(self) -> tuple[str, ...]:
        """Parameters that were held as stated."""
        return tuple(name for name, free in zip(self.names, is_free(self.camera, self.lens), strict=True) if not free)

    @property
    def held_by_prior(self) -> tuple[str, ...]:
        """Parameters that the images do not determine: what is known of them is what was stated."""
        held = held_by_prior(self.prior.root, self.covariance) & is_free(self.camera, self.lens)
        return tuple(name for name, is_held in zip(self.names, held, strict=True) if is_held)


@dataclass(frozen=True, eq=False)
class CornersRefined:
    """Poses, cameras and boards refined from corners, with their joint covariance."""

    #: T_targetcarrier_target and T_sensorcarrier_sensor, metres.
    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    #: By sensor.
    intrinsics: dict[str, RefinedIntrinsics]
    #: (4,) each. By target: its size less the stated one, a share; heights of its edge over its middle along x and y,
    #: and of a bend along its diagonals (`corner_residuals`), metres.
    shapes: dict[str, Array]
    #: (n, 3) each. By target: its corners in its frame, with its size, its bend and what each is off its place, metres.
    corners: dict[str, Array]
    #: By sensor whose clock's offset was free: its images were taken that long after the times of their A.
    time_offsets_s: dict[str, float]
    noise: Noise
    #: (d, d): Covariance of all unknowns; right perturbations [omega, v] of poses, rad and m.
    joint: Array = field(repr=False)
    slots: Mapping[tuple[str, str], slice] = field(repr=False)
    #: Computes `freedom`: what is only compared with others does not need it.
    freedom_of: Callable[[], Mapping[tuple[str, str], float]] = field(repr=False)
    #: (V, n) each. Corners that disagree with all others.
    left_out: dict[tuple[str, str], np.ndarray] = field(repr=False)
    #: The GTSAM graph at the optimum's noise, with its model and its variables' keys.
    graph: CornerGraph = field(repr=False)
    #: The values of all variables, with the carriers' poses at the instants.
    point: Point = field(repr=False)
    #: Steps, in all rounds together.
    iterations: int
    #: What one more Gauss-Newton step would move, in deviations: it is far below 1 at an optimum.
    last_step: float
    #: What is doubtful, in words with the figures, the gravest first; empty where nothing is.
    findings: tuple[str, ...] = ()

    @property
    def freedom(self) -> Mapping[tuple[str, str], float]:
        """Degrees of freedom of each unknown's covariance, whose noise was estimated."""
        return self.freedom_of()

    def __str__(self) -> str:
        """What was refined from what, how well it fits, and what is doubtful, in a few sentences."""
        stacks, noise = self.graph.model.stacks, self.noise
        images = sum(len(stack.pixels) for stack in stacks)
        seen = sum(int(stack.known.sum()) for stack in stacks)
        left_out = sum(int(mask.sum()) for mask in self.left_out.values())
        rms = ", ".join(f"{name} {of.rms_px:.3f}" for name, of in self.intrinsics.items())
        size = f"{rounded(np.degrees(noise.carrier_rad))} degrees and {rounded(1e3 * noise.carrier_m)} mm for each axis"
        of_A = "A counts as exact" if noise.carrier is None else f"noise of A {size}"
        findings = " ".join(self.findings) or "No findings."
        return (
            f"Refined from {seen - left_out} corners in {images} images of {', '.join(self.X)} by {', '.join(self.Y)}; "
            f"{left_out} corners left out. rms in pixels along each axis: {rms}; {of_A}. {findings}"
        )

    def __repr__(self) -> str:
        return f"<CornersRefined: {self}>"

    def covariance(self, *names: str) -> Array:
        """The joint covariance of unknowns, in the order given; without names, of all.

        Frames have six rows each, rotation first (rad, m, in the frame's own axes); ``intrinsics:SENSOR`` a camera's
        parameters in the order of `RefinedIntrinsics.names` (pixels; coefficients have no unit); ``shape:TARGET`` the
        numbers that are free of the size and the two heights of the edge; ``time_offset:SENSOR`` one row, s^2;
        ``corners:TARGET`` three rows a corner, m^2.

        Raises
        ------
        FrameError
            A name is none of the unknowns.
        """
        there = self.names
        rows: list[int] = []
        for name in names or tuple(there):
            if name not in there:
                raise FrameError(f"{name!r} is not among the unknowns; they are {', '.join(there)}")
            at = self.slots[there[name]]
            rows += range(at.start, at.stop)
        return self.joint[np.ix_(rows, rows)]

    def squared_radius(self, name: str, confidence: float = 0.95) -> float:
        """The largest error' covariance^-1 error of an unknown inside its confidence ellipsoid: by an F quantile.

        Raises
        ------
        FrameError
            The name is none of the unknowns.
        OptionError
            The confidence is not between 0 and 1.
        """
        if not (is_real(confidence) and 0.0 < confidence < 1.0):
            raise OptionError(f"confidence={brief(confidence)}; give one between 0 and 1")
        dimension, freedom = len(self.covariance(name)), self.freedom[self.names[name]]
        if np.isinf(freedom):
            return float(chdtri(dimension, 1.0 - confidence))
        return float(dimension * fdtri(dimension, freedom, confidence))

    @property
    def names(self) -> dict[str, tuple[str, str]]:
        """The unknowns' names."""
        frames = {name: (letter, name) for letter, name in self.slots if letter in "xy"}
        cameras = {f"intrinsics:{name}": ("k", self.graph.model.camera_of[name]) for name in self.Y}
        others = {"b": "shape", "t": "time_offset", "p": "corners"}
        return frames | cameras | {f"{others[at[0]]}:{at[1]}": at for at in self.slots if at[0] in others}
