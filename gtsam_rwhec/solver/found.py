"""What a search found."""

from __future__ import annotations

from dataclasses import dataclass, field

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.bound import Bound
from gtsam_rwhec.solver.cause import Cause, SearchPath


@dataclass(frozen=True)
class Found:
    """The best rotations of a part and the best bound on the cost of any answer.

    Attributes
    ----------
    R : (n, 3, 3) array
        In the order of ``part.free``, as the form has them.
    cost : float
        x'Q'x at R.
    bound : Bound
        Its ``lower_bound`` is at most ``cost``.
    tolerance : float
        The absolute gap up to which the answer counts as proven optimal.
    path : SearchPath
    cause : Cause
    figures : dict of str to float
        The numbers behind the cause, as in ``Certificate``.
    """

    R: Array
    cost: float
    bound: Bound
    tolerance: float
    path: SearchPath
    cause: Cause
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def is_closed(self) -> bool:
        """Whether the gap is within the tolerance: the answer is proven optimal."""
        return self.cost - self.bound.lower_bound <= self.tolerance
