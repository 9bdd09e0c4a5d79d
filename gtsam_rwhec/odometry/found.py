"""What a calibration of odometries found beside the poses: proof, windows, dependence, other answers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.certificate import Status
from gtsam_rwhec.solver.free_directions import Twist

#: What is given is contradicted by the data from so many standard deviations on.
CONTRADICTED = 4.0


@dataclass(frozen=True)
class JointCertificate:
    """The proof for the joint quadratic cost of all sensors (design fact 24).

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
    scales_held : bool
        A mirror image with a negative scale costs less, as a vehicle that turns about one axis may make it by chance
        (design fact 5). Then cost and bound are of the form with a term that holds each unknown scale near its value.
    """

    status: Status
    cost: float
    lower_bound: float
    min_eigenvalue: float
    tolerance: float
    region_m: float
    scales_held: bool = False

    @property
    def gap(self) -> float:
        """Cost minus lower bound, at least 0."""
        return max(0.0, self.cost - self.lower_bound)

    @property
    def is_optimal(self) -> bool:
        """Whether the cost is proven optimal; other answers may cost the same."""
        return self.status in (Status.CERTIFIED, Status.CERTIFIED_NOT_UNIQUE)

    def __str__(self) -> str:
        within = f" within {self.region_m:g} m" if np.isfinite(self.region_m) else ""
        held = ", with scales held near the answer's (a mirror image fits as well)" if self.scales_held else ""
        return f"{self.status}: joint cost {self.cost:.6g}, no answer{within} below {self.lower_bound:.6g}{held}"


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
        How far the answer is from the number, in the sigmas of their difference; above ``CONTRADICTED`` the data
        contradict it. Zero where the motions do not measure it.
    """

    what: str
    value: float
    sigma: float
    unit: str
    per_unit: dict[str, Twist] = field(hash=False)
    per_sigma: dict[str, Twist] = field(hash=False)
    off_by: float = 0.0

    @property
    def is_contradicted(self) -> bool:
        """Whether the motions contradict the number."""
        return self.off_by > CONTRADICTED


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
