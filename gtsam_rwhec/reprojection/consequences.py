"""What would move the extrinsics, and by how much: intrinsics that are kept although they are off, and errors of A.

To first order an error dk of intrinsics that are held moves the other unknowns by -H_ee^-1 H_ek dk, with the
information H of all unknowns; and errors of A with the covariance S at each instant, where A is taken as exact, have
the covariance H^-1 (sum C_i' S C_i) H^-1 / s^4.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.refinement.reprojection_found import Consequence
from gtsam_rwhec.reprojection.reduced import Reduced
from gtsam_rwhec.reprojection.refined import CornersRefined

#: What is asked: pixels of the centre, a share of the focal length, radians of A's rotation about each axis.
CENTRE_PX, FOCAL_SHARE, CARRIER_RAD = 1.0, 1e-3, np.radians(0.1)


#: The cause of A's, in words: how they begin.
OF_CARRIERS = f"{np.degrees(CARRIER_RAD):.1f} degrees of A's noise about each axis"


def carrier_cause(refined: CornersRefined) -> str:
    """A's noise, in words: rotations of A leave the origin of one of the two carriers where it is."""
    about = {"targetcarrier": "target carrier", "sensorcarrier": "sensor carrier"}[refined.graph.model.about]
    return f"{OF_CARRIERS} (one standard deviation; A turns about the origin of the {about})"


def centre_causes(sensor: str) -> tuple[str, str]:
    """Errors of a camera's centre, in words."""
    return f"{CENTRE_PX:g} pixel of {sensor}'s cx", f"{CENTRE_PX:g} pixel of {sensor}'s cy"


def focal_cause(sensor: str) -> str:
    """An error of a camera's focal length, in words."""
    return f"{FOCAL_SHARE:.1%} of {sensor}'s focal length"


def consequences_of(refined: CornersRefined) -> tuple[Consequence, ...]:
    """What one pixel of c, one part in a thousand of f and 0.1 degrees of A's noise would do to each frame."""
    slots = refined.slots
    information = np.linalg.inv(refined.joint)
    poses = {name: at for (letter, name), at in slots.items() if letter in "xy"}
    rest = np.concatenate([np.arange(at.start, at.stop) for (letter, _), at in slots.items() if letter != "k"])
    result = []
    for (letter, name), at in slots.items():
        if letter != "k":
            continue
        focal = refined.intrinsics[name].camera.K[[0, 1], [0, 1]]
        of_cx, of_cy = centre_causes(name)
        steps: dict[str, tuple[int | slice, float | Array]] = {
            of_cx: (2, CENTRE_PX),
            of_cy: (3, CENTRE_PX),
            focal_cause(name): (slice(0, 2), FOCAL_SHARE * focal),
        }
        for cause, (which, size) in steps.items():
            dk = np.zeros(at.stop - at.start)
            dk[which] = size
            moved = np.zeros(len(information))
            moved[rest] = -np.linalg.solve(information[np.ix_(rest, rest)], information[rest, at] @ dk)
            result += [_moved(frame, cause, moved[rows]) for frame, rows in poses.items()]
    covariance, cause = _of_carrier_noise(refined), carrier_cause(refined)
    for frame, rows in poses.items():
        block = covariance[rows, rows]
        worst = [np.sqrt(np.linalg.eigvalsh(part)[-1]) for part in (block[:3, :3], block[3:, 3:])]
        result.append(Consequence(frame, cause, float(np.degrees(worst[0])), float(1e3 * worst[1])))
    return tuple(result)


def _moved(frame: str, cause: str, xi: Array) -> Consequence:
    return Consequence(frame, cause, float(np.degrees(np.linalg.norm(xi[:3]))), float(1e3 * np.linalg.norm(xi[3:])))


def _of_carrier_noise(refined: CornersRefined) -> Array:
    """The covariance of all unknowns from errors of A about each axis, where A is taken as exact."""
    model = refined.graph.model
    reduced = Reduced.of(model, replace(refined.point, A=model.A))
    s2 = refined.noise.corner_px**2
    inverse = np.linalg.inv(reduced.G / s2 + np.diag(reduced.prior))
    C = reduced.C[:, :3] / s2 * CARRIER_RAD
    flat = C.reshape(-1, C.shape[2])
    covariance: Array = inverse @ (flat.T @ flat) @ inverse
    return covariance
