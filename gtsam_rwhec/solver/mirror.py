"""The mirror image of an answer, which costs the same when the motion is planar and the scale unknown.

Let every A turn about one axis (u_s in the sensor carrier, u_t in the target carrier, A u_t = u_s) and translate at
right angles to it. Then each residual is a component along the axis plus an independent component at right angles to
it. A half turn of all frames about the axis changes the sign of this second component, and so does a negative scale: (H
R, -alpha) and (R, alpha) cost the same. Both have det R = 1, but only one of them has a positive scale.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import ONE, R_A
from gtsam_rwhec.solver.parts import Part


def mirrored(part: Part, R: Array) -> Array:
    """Rotations (n, 3, 3) of the form's variables after a half turn of all frames about the motions' main axis."""
    sums = part.moments.entries(R_A, np.array([ONE])).reshape(-1, 3, 3).transpose(0, 2, 1)
    still = ~part.moments.motion
    if still.any():
        U, _, Vt = np.linalg.svd(sums[still].sum(axis=0))
        of_sensor, of_target = U[:, 0], Vt[0]
    else:  # both ends of a motion are the sensor's carrier
        turned = sums.sum(axis=0)
        of_sensor = of_target = np.linalg.eigh(turned + turned.T)[1][:, -1]
    half_turns = np.array(
        [
            2.0 * np.outer(axis, axis) - np.eye(3)
            for axis in (of_target if name in part.targets else of_sensor for name in part.free)
        ]
    )
    result: Array = half_turns @ R if part.kind == "direct" else R @ half_turns
    return result
