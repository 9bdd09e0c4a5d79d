"""The result of a calibration of sensors that know only their own motion."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.cleaning.removed import Removed
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.identifiability.free_directions import FreeDirection, Twist
from gtsam_rwhec.odometry.tracks import OdometryNoise
from gtsam_rwhec.odometry.words import in_words
from gtsam_rwhec.solver.cause import Status


@dataclass(frozen=True)
class JointCertificate:
    """The proof for the joint quadratic cost of all sensors (design fact 23).

    The cost is half the squared residuals of the windows' rotation vectors and translations in all sensors at once,
    with the vehicle's own motion eliminated. The turn of each window inside the lever arms' term, and the length of the
    way that scales are compared with, are the fused ones. So the proof is of this cost; the exact likelihood is refined
    from there.

    Attributes
    ----------
    status : Status
    cost : float
        The cost at the answer.
    lower_bound : float
        No answer (of the region) costs less.
    min_eigenvalue : float
        A lower bound on the certificate matrix's smallest eigenvalue, after its diagonal was scaled to one.
    tolerance : float
        The gap up to which the answer counts as optimal.
    region_m : float
        The bound is about all answers whose sensors are at most this far from the reference along each axis.
    """

    status: Status
    cost: float
    lower_bound: float
    min_eigenvalue: float
    tolerance: float
    region_m: float

    @property
    def gap(self) -> float:
        """Cost minus lower bound, at least 0."""
        return max(0.0, self.cost - self.lower_bound)

    @property
    def is_optimal(self) -> bool:
        """Whether the cost is proven optimal; other answers may cost the same."""
        return self.status in (Status.CERTIFIED, Status.CERTIFIED_NOT_UNIQUE)

    def __str__(self) -> str:
        return (
            f"{self.status}: joint cost {self.cost:.6g}, no answer within {self.region_m:g} m below "
            f"{self.lower_bound:.6g}"
        )


@dataclass(frozen=True)
class Windows:
    """The windows of time over which motions were compared.

    Attributes
    ----------
    seconds : float
        Length of a window.
    count : int
        How many there are.
    used : dict of sensor to int
        In how many of them each sensor is used.
    start_ns, end_ns : (N,) integers
        Their ends, on the reference's clock.
    """

    seconds: float
    count: int
    used: dict[str, int]
    start_ns: np.ndarray
    end_ns: np.ndarray


@dataclass(frozen=True)
class Influence:
    """How the answer depends on one given number.

    Attributes
    ----------
    what : str
        The number: "height of lidar" and the like.
    value, sigma : float
        As it was given; in its unit.
    unit : "m" or "rad"
    per_unit : dict of sensor to (6,)
        Derivative of each pose's tangent [omega, v] by the number.
    per_sigma : dict of sensor to (6,)
        How far the pose moves if the number is off by one sigma: rad and m.
    off_by : float
        How far the answer is from the number, in the sigmas of their difference; above 3 the data contradict it.
    """

    what: str
    value: float
    sigma: float
    unit: str
    per_unit: dict[str, Twist] = field(hash=False)
    per_sigma: dict[str, Twist] = field(hash=False)
    off_by: float = 0.0


@dataclass(frozen=True)
class OtherAnswer:
    """Another answer that fits as well.

    Attributes
    ----------
    why : str
        What leaves it open: "the distance of a and b has two signs".
    T_reference_sensor : dict of sensor to (4, 4) array
    cost_above : float
        Its cost (half a chi-square) above the answer's.
    """

    why: str
    T_reference_sensor: dict[str, Array] = field(hash=False)
    cost_above: float = 0.0


@dataclass(frozen=True)
class OdometryCalibration:
    """Poses of sensors that know only their own motion, and what is known of them. ``str()`` has the verdict first.

    Attributes
    ----------
    reference : str
        The sensor in whose frame the poses are.
    sensors : tuple of str
        All sensors, the reference first.
    T_reference_sensor : dict of sensor to (4, 4) array
        The identity for the reference. Along a free direction a pose is as the search left it.
    scales : dict of sensor to float
        Measured over true length, of the sensors of unknown scale.
    time_offsets_s : dict of sensor to float
        A sensor's stamp t is the reference's t + offset.
    time_offset_sigmas_s : dict of sensor to float
        Their standard deviations; empty where the clocks were not compared.
    order : tuple of str
        The sensors in the order of ``covariance``: all but the reference.
    covariance : (d, d) array
        Joint covariance: [omega, v] of each sensor in ``order`` (right perturbation, rad and m), then the logarithms of
        ``scales`` in their order. Infinite on the diagonal (and zero elsewhere in the row) where a free direction
        reaches.
    certificate : JointCertificate
    free_directions : tuple of FreeDirection
        How the answer can move while the measurements (and what was given) fit as well.
    windows : Windows
    noise : dict of sensor to OdometryNoise
        As it was stated or found.
    noise_was_found : frozenset of str
        The sensors whose noise was estimated.
    removed : dict of sensor to tuple of Removed
        Poses and windows that were not used, and why.
    residuals : dict of sensor to (rotation, translation)
        Root mean square of the windows' residuals, in their standard deviations: 1 is expected.
    influences : tuple of Influence
        How the answer depends on what was given.
    others : tuple of OtherAnswer
        Other answers that fit alike.
    findings : tuple of str
        What a person should know, in sentences.
    """

    reference: str
    sensors: tuple[str, ...]
    T_reference_sensor: dict[str, Array] = field(hash=False)
    scales: dict[str, float] = field(hash=False)
    time_offsets_s: dict[str, float] = field(hash=False)
    time_offset_sigmas_s: dict[str, float] = field(hash=False)
    order: tuple[str, ...]
    covariance: Array = field(hash=False)
    certificate: JointCertificate
    free_directions: tuple[FreeDirection, ...]
    windows: Windows = field(hash=False)
    noise: dict[str, OdometryNoise] = field(hash=False)
    noise_was_found: frozenset[str]
    removed: dict[str, tuple[Removed, ...]] = field(hash=False)
    residuals: dict[str, tuple[float, float]] = field(hash=False)
    influences: tuple[Influence, ...] = ()
    others: tuple[OtherAnswer, ...] = ()
    findings: tuple[str, ...] = ()

    @property
    def status(self) -> Status:
        """The certificate's status."""
        return self.certificate.status

    @property
    def is_unique(self) -> bool:
        """Whether measurements and what was given determine every pose."""
        return not self.free_directions and not self.others

    def covariance_of(self, sensor: str) -> Array:
        """The covariance (6, 6) of a sensor's pose, [omega, v], rad and m; zero for the reference."""
        if sensor == self.reference:
            return np.zeros((6, 6))
        first = 6 * self.order.index(sensor)
        block: Array = self.covariance[first : first + 6, first : first + 6]
        return block

    def T(self, first: str, second: str) -> Array:
        """The pose (4, 4) of sensor ``second`` in the frame of sensor ``first``: loops close exactly."""
        inverse = np.linalg.inv(self.T_reference_sensor[first])
        pose: Array = inverse @ self.T_reference_sensor[second]
        return pose

    def __str__(self) -> str:
        return in_words(self)
