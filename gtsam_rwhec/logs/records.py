"""Records: what the messages of a log are read as, checked and in SI units, one class for each kind of content.

Transforms are ``T_parent_child`` (4, 4), metres. Stamps are the messages' own (``header.stamp``, ``timestamp``),
`logged_ns` is when the recorder wrote the message; both are integer nanoseconds. Arrays are views of larger ones that
were decoded together: copy what is kept for long out of a long log.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """A pose or transform, T = T_parent_child (4, 4).

    `child` is empty where the message names one frame only (``PoseStamped``, ``PoseInFrame``). `covariance` is (6, 6)
    as GTSAM has it: rotation first, right perturbation ``T * Expmap(xi)``; None where the message has none.
    """

    logged_ns: int
    stamp_ns: int
    topic: str
    parent: str
    child: str
    T: Array
    covariance: Array | None = None

    @property
    def is_static(self) -> bool:
        """Whether it came by ROS's topic for transforms that never change."""
        return self.topic.rpartition("/")[2] == "tf_static"


@dataclass(frozen=True, slots=True, eq=False)
class ImageRecord:
    """An image, not decoded.

    `encoding` is a pixel format (``mono8``, ``rgb8``, ...) of a raw image, whose rows are `step` bytes apart, or the
    format (``jpeg``, ``png``) of a compressed one, for which `width`, `height` and `step` are None.
    """

    logged_ns: int
    stamp_ns: int
    topic: str
    frame: str
    encoding: str
    data: bytes
    width: int | None = None
    height: int | None = None
    step: int | None = None
    is_bigendian: bool = False

    @property
    def is_compressed(self) -> bool:
        """Whether `data` is a JPEG, PNG or the like."""
        return self.step is None


@dataclass(frozen=True, slots=True, eq=False)
class IntrinsicsRecord:
    """A camera's intrinsics as the log states them: K (3, 3) and P (3, 4) in pixels, R (3, 3), D (n,).

    `model` is the log's own word (``plumb_bob``, ``equidistant``, ``kannala_brandt``, ...). Whether the numbers make
    sense is for the camera model to say.
    """

    logged_ns: int
    stamp_ns: int
    topic: str
    frame: str
    width: int
    height: int
    model: str
    K: Array
    D: Array
    R: Array
    P: Array


@dataclass(frozen=True, slots=True, eq=False)
class DetectionRecord:
    """A tag as a driver saw it; a message with several tags becomes as many records.

    `family` is empty where the message does not say. `id` is a number, or a board's name. `corners_px` is (4, 2) in
    the driver's order (of a board as many as were seen), `T_camera_tag` (4, 4), `covariance` (6, 6) as in `PoseRecord`,
    `reprojection_px` the root mean square over the corners, `corner_indices` says which of a target's corners (as its
    class numbers them) those in `corners_px` are. `reason` says why it is not used; empty where it is.
    """

    logged_ns: int
    stamp_ns: int
    topic: str
    frame: str
    family: str
    id: str
    corners_px: Array | None = None
    T_camera_tag: Array | None = None
    covariance: Array | None = None
    size_m: float | None = None
    reprojection_px: float | None = None
    reason: str = ""
    corner_indices: tuple[int, ...] | None = None

    @property
    def label(self) -> str:
        """What stands beside it in a picture."""
        return f"{self.id}: {self.reason}" if self.reason else self.id


@dataclass(frozen=True, slots=True, eq=False)
class PairRecord:
    """A synchronised measurement as this library writes it: A = T_sensorcarrier_targetcarrier, B = T_sensor_target.

    `covariance` is B's, (6, 6) as in `PoseRecord`. `reason` says why it is no inlier; empty where it is one.
    """

    logged_ns: int
    stamp_ns: int
    topic: str
    target: str
    sensor: str
    A: Array
    B: Array
    is_inlier: bool = True
    reason: str = ""
    covariance: Array | None = None


Record: TypeAlias = PoseRecord | ImageRecord | IntrinsicsRecord | DetectionRecord | PairRecord
