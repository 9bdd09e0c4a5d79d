"""Problems whose poses were misread, in each of the ways that change residuals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rwhec_factors.se3 import inverse, pose
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.other_readings import Mistake
from gtsam_rwhec.geometry.poses import Array


def unchanged(T: Array) -> Array:
    """Poses as they are."""
    return T


def misordered(given: str, read: str) -> Callable[[Array], Array]:
    """Poses whose quaternions were written in the order ``given`` and read in the order ``read``."""

    def misread(T: Array) -> Array:
        wxyz = Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True)
        written = wxyz if given == "wxyz" else wxyz[:, [1, 2, 3, 0]]
        return pose(Rotation.from_quat(written, scalar_first=read == "wxyz").as_matrix(), T[:, :3, 3])

    return misread


def mirrored(T: Array) -> Array:
    """Poses in a left-handed frame, whose y is the other way."""
    M = np.diag([1.0, -1.0, 1.0, 1.0])
    return M @ T @ M


def in_millimetres(T: Array) -> Array:
    """Poses with their translations in millimetres."""
    return pose(T[:, :3, :3], 1e3 * T[:, :3, 3])


def in_thousands(T: Array) -> Array:
    """Poses whose translations were taken for millimetres: they are divided by 1,000."""
    return pose(T[:, :3, :3], 1e-3 * T[:, :3, 3])


def too_large(T: Array) -> Array:
    """Poses of a target that is smaller than its size was stated, by a fifth."""
    return pose(T[:, :3, :3], 1.25 * T[:, :3, 3])


def transposed(T: Array) -> Array:
    """Poses with the transposes of their rotations."""
    return pose(T[:, :3, :3].transpose(0, 2, 1), T[:, :3, 3])


def in_degrees(T: Array) -> Array:
    """Poses whose rotation vectors in degrees were taken for radians."""
    vectors = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    return pose(Rotation.from_rotvec(np.degrees(vectors)).as_matrix(), T[:, :3, 3])


def in_radians(T: Array) -> Array:
    """Poses whose Euler angles (intrinsic ZYX) in radians were taken for degrees."""
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX")
    return pose(Rotation.from_euler("ZYX", np.radians(angles)).as_matrix(), T[:, :3, 3])


@dataclass(frozen=True)
class Kind:
    """One way to misread A and B, the mistake that it is, and words of the sentence that must name it."""

    name: str
    mistake: Mistake
    words: str
    of_A: Callable[[Array], Array] = unchanged
    of_B: Callable[[Array], Array] = unchanged
    exchange: bool = False
    shift: int = 0


XYZW, WXYZ = misordered("xyzw", "wxyz"), misordered("wxyz", "xyzw")
KINDS = (
    Kind("xyzw of A", Mistake.QUATERNION_ORDER, "quaternions of A are xyzw", XYZW),
    Kind("xyzw of B", Mistake.QUATERNION_ORDER, "quaternions of B are xyzw", of_B=XYZW),
    Kind("xyzw of both", Mistake.QUATERNION_ORDER, "quaternions of A and B are xyzw", XYZW, XYZW),
    Kind("wxyz of A", Mistake.QUATERNION_ORDER, "quaternions of A are wxyz", WXYZ),
    Kind("wxyz of B", Mistake.QUATERNION_ORDER, "quaternions of B are wxyz", of_B=WXYZ),
    Kind("wxyz of both", Mistake.QUATERNION_ORDER, "quaternions of A and B are wxyz", WXYZ, WXYZ),
    Kind("A inverted", Mistake.INVERTED, "A is inverted", inverse),
    Kind("B inverted", Mistake.INVERTED, "B is inverted", of_B=inverse),
    Kind("A transposed", Mistake.TRANSPOSED, "rotations of A are transposed", transposed),
    Kind("B transposed", Mistake.TRANSPOSED, "rotations of B are transposed", of_B=transposed),
    Kind("A left-handed", Mistake.HANDEDNESS, "left-handed", mirrored),
    Kind("B left-handed", Mistake.HANDEDNESS, "left-handed", of_B=mirrored),
    Kind("A in degrees", Mistake.ANGLE_UNIT, "rotation vectors of A are in degrees", in_degrees),
    Kind("B in degrees", Mistake.ANGLE_UNIT, "rotation vectors of B are in degrees", of_B=in_degrees),
    Kind("A in radians", Mistake.ANGLE_UNIT, "angles of A are in radians", in_radians),
    Kind("B in radians", Mistake.ANGLE_UNIT, "angles of B are in radians", of_B=in_radians),
    Kind("A in millimetres", Mistake.UNIT, "A is in millimetres", in_millimetres),
    Kind("B in millimetres", Mistake.UNIT, "B is in millimetres", of_B=in_millimetres),
    Kind("A in thousands", Mistake.UNIT, "those of A are too small", in_thousands),
    Kind("size wrong", Mistake.SCALE, "lengths in B are 1.2", of_B=too_large),
    Kind("rows of A late", Mistake.ROWS_SHIFTED, "rows of A come 1 row later", shift=1),
    Kind("rows of B late", Mistake.ROWS_SHIFTED, "rows of B come 3 rows later", shift=-3),
)
#: These change residuals only where several targets or several sensors join the same frames.
KINDS_OF_GRAPHS = (
    Kind("both inverted", Mistake.INVERTED, "A and B are both inverted", inverse, inverse),
    Kind("roles exchanged", Mistake.ROLES_EXCHANGED, "targets and sensors are exchanged", exchange=True),
)


def misread(problem: rw.Problem, kind: Kind) -> rw.Problem:
    """The problem, misread; without stamps, priors and fixed frames."""
    result = rw.Problem(problem.scale)
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        n = len(raw.A)
        if n <= abs(kind.shift):
            continue
        first, last = max(kind.shift, 0), max(-kind.shift, 0)
        of_A, of_B = slice(last, n - first), slice(first, n - last)
        given = (kind.of_A(raw.A[of_A]), kind.of_B(raw.B[of_B]), raw.sigma[of_B], raw.kappa[of_B])
        if pair.is_motion:
            result.add_motion(pair.sensor, *given)
        else:
            result.add(*(pair[::-1] if kind.exchange else pair), *given)
    return result
