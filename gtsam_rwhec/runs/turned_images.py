"""Find images that are upside down: their measurements were left out, but agree with the answer after half a turn.

An image viewer that rotates and saves, or a camera that rotates images by gravity, may turn single images of a folder.
Their poses are then turned by 180 degrees about the optical axis. No wrong corner and no wrong arm pose does this.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from rwhec_factors.se3 import inverse, so3_logmap

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs
from gtsam_rwhec.runs.run_log import image_name

#: An image is upside down if its pose is half a turn about the optical axis from the expected one, within this angle.
#: It is not exact: the principal point is not the middle of the image, so the turned target is some pixels off.
NEAR_RAD = float(np.radians(6.0))
#: At most this number of images is named.
MOST_NAMED = 5


def turned_images(
    pairs: Mapping[Pair, MeasuredPairs], refined: Refined, rig: Rig, names: Mapping[str, str]
) -> list[Finding]:
    """A finding for each sensor with images that are upside down.

    Parameters
    ----------
    pairs : dict of Pair to MeasuredPairs
        All measurements, with the reasons of those that were left out.
    refined : Refined
        The answer.
    names : dict of str to str
        Names of the images' files, as `image_names` returns them.
    """
    stamps: dict[str, set[int]] = defaultdict(set)
    of_all: dict[str, set[int]] = defaultdict(set)
    for pair, one in pairs.items():
        X, Y = refined.X.get(pair.target), refined.Y.get(pair.sensor)
        if X is None or Y is None or rig.sensors[pair.sensor].images is None:
            continue
        of_all[pair.sensor].update(one.stamps_ns.tolist())
        expected = inverse(Y.matrix()[None]) @ one.A @ X.matrix()
        error = one.B[:, :3, :3] @ expected[:, :3, :3].transpose(0, 2, 1)
        beside_half_a_turn = np.linalg.norm(so3_logmap(error @ np.diag([-1.0, -1.0, 1.0])), axis=1)
        is_turned = (beside_half_a_turn < NEAR_RAD) & ~one.used
        stamps[pair.sensor].update(one.stamps_ns[is_turned].tolist())
    return [
        Finding(
            Ground.IMAGE_TURNED,
            _words(sensor, sorted(found), len(of_all[sensor]), str(rig.sensors[sensor].images), names),
        )
        for sensor, found in stamps.items()
        if found
    ]


def _words(sensor: str, stamps: list[int], number: int, topic: str, names: Mapping[str, str]) -> str:
    named = [image_name(names, topic, stamp) for stamp in stamps[:MOST_NAMED]]
    more = f" and {len(stamps) - MOST_NAMED} others" if len(stamps) > MOST_NAMED else ""
    are = "is" if len(stamps) == 1 else "are"
    return (
        f"{len(stamps)} of the {number} images of {sensor} in which a target is read {are} upside down and not used: "
        f"{', '.join(named)}{more}"
    )
