"""Records of a log's messages, checked and in SI units: one class for each kind of content.

Transforms are ``T_parent_child`` (4, 4), in metres. `stamp_ns` is the message's own time (``header.stamp``,
``timestamp``); `logged_ns` is the time at which the recorder wrote the message; both are integer nanoseconds. Arrays
are views of larger arrays that were decoded together: copy an array to keep it without the rest of a long log.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """A pose or transform.

    Attributes
    ----------
    T : (4, 4) array
        T_parent_child, in metres.
    child : str
        Empty where the message names one frame only (``PoseStamped``, ``PoseInFrame``).
    covariance : (6, 6) array or None
        GTSAM's order: rotation first, right perturbation ``T * Expmap(xi)``. It is None if the message has none.
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
        """Whether the message was on ``tf_static``, ROS's topic of transforms that never change."""
        return self.topic.rpartition("/")[2] == "tf_static"


@dataclass(frozen=True, eq=False)
class PoseSeries:
    """All poses of one pair of frames, by stamp: stamps_ns (N,), T_parent_child (N, 4, 4)."""

    stamps_ns: np.ndarray
    T: Array
    parent: str
    child: str


@dataclass(frozen=True, slots=True, eq=False)
class ImageRecord:
    """An image, not decoded.

    Attributes
    ----------
    encoding : str
        Pixel format (``mono8``, ``rgb8``, ...) of a raw image; format (``jpeg``, ``png``) of a compressed image.
    width, height : int or None
        Pixels of a raw image. They are None for a compressed image.
    step : int or None
        Bytes from one row of a raw image to the next; None for a compressed image.
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
        """Whether `data` is a file in JPEG, PNG or another format of images."""
        return self.step is None


@dataclass(frozen=True, slots=True, eq=False)
class IntrinsicsRecord:
    """A camera's intrinsics as the log states them; the camera model checks the numbers later.

    Attributes
    ----------
    model : str
        The model's name in the log: ``plumb_bob``, ``equidistant``, ``kannala_brandt``, ...
    K, P : (3, 3) and (3, 4) arrays
        Camera matrix and projection matrix of the rectified image, in pixels.
    R : (3, 3) array
        Rotation from the camera to the rectified camera.
    D : (n,) array
        Distortion coefficients, in the order of the model.
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
    """A tag or board that was detected; a message with several tags gives one record for each.

    Attributes
    ----------
    family : str
        Empty where the message does not name it.
    id : str
        The tag's number, or the board's name.
    corners_px : (4, 2) array or None
        Pixels, in the driver's order. A board has (n, 2), with the corners that were seen.
    T_camera_tag, covariance : (4, 4) and (6, 6) arrays or None
        The pose in metres and its covariance as in `PoseRecord`.
    size_m, reprojection_px : float or None
        The tag's side in metres; the root mean square of the reprojection error over the corners, in pixels.
    reason : str
        Why the detection is not used; empty where it is used.
    corner_indices : tuple of int or None
        The number of each row of `corners_px` among the corners of the target, as the target's class numbers them.
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
        """The text beside the detection in a picture."""
        return f"{self.id}: {self.reason}" if self.reason else self.id


@dataclass(frozen=True, slots=True, eq=False)
class PairRecord:
    """A synchronised measurement as this library writes it.

    Attributes
    ----------
    A, B : (4, 4) arrays
        T_sensorcarrier_targetcarrier and T_sensor_target, in metres.
    reason : str
        Why the measurement is an outlier; empty for an inlier.
    covariance : (6, 6) array or None
        The covariance of B, as in `PoseRecord`.
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
