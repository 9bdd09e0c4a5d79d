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
from rwhec_factors import se3

from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.quaternions import to_rotations

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """A pose or transform."""

    logged_ns: int
    stamp_ns: int
    topic: str
    parent: str
    child: str  #: Empty where the message names one frame only (``PoseStamped``, ``PoseInFrame``)
    T: Array  #: (4, 4): T_parent_child, in metres
    #: (6, 6): GTSAM's order: rotation first, right perturbation ``T * Expmap(xi)``. It is None if the message has none.
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
    """An image, not decoded."""

    logged_ns: int
    stamp_ns: int
    topic: str
    frame: str
    #: Pixel format (``mono8``, ``rgb8``, ...) of a raw image; format (``jpeg``, ``png``) of a compressed image.
    encoding: str
    data: bytes
    #: width, height: pixels of a raw image. They are None for a compressed image.
    width: int | None = None
    height: int | None = None
    step: int | None = None  #: Bytes from one row of a raw image to the next; None for a compressed image
    is_bigendian: bool = False

    @property
    def is_compressed(self) -> bool:
        """Whether `data` is a file in JPEG, PNG or another format of images."""
        return self.step is None


@dataclass(frozen=True, slots=True, eq=False)
class IntrinsicsRecord:
    """A camera's intrinsics as the log states them; the camera model checks the numbers later."""

    logged_ns: int
    stamp_ns: int
    topic: str
    frame: str
    width: int
    height: int
    model: str  #: The model's name in the log: ``plumb_bob``, ``equidistant``, ``kannala_brandt``, ...
    #: K, P: (3, 3) and (3, 4): Camera matrix and projection matrix of the rectified image, in pixels
    K: Array
    D: Array  #: (n,): Distortion coefficients, in the order of the model
    R: Array  #: (3, 3): Rotation from the camera to the rectified camera
    P: Array


@dataclass(frozen=True, slots=True, eq=False)
class DetectionRecord:
    """A tag or board that was detected; a message with several tags gives one record for each."""

    logged_ns: int
    stamp_ns: int
    topic: str
    frame: str
    family: str  #: Empty where the message does not name it
    id: str  #: The tag's number, or the board's name
    #: (4, 2): Pixels, in the driver's order. A board has (n, 2), with the corners that were seen.
    corners_px: Array | None = None
    #: T_camera_tag, covariance: (4, 4) and (6, 6): The pose in metres and its covariance as in `PoseRecord`
    T_camera_tag: Array | None = None
    covariance: Array | None = None
    #: size_m, reprojection_px: the tag's side in metres; the root mean square of the reprojection error over the
    #: corners, in pixels
    size_m: float | None = None
    reprojection_px: float | None = None
    reason: str = ""  #: Why the detection is not used; empty where it is used
    #: The number of each row of `corners_px` among the corners of the target, as the target's class numbers them
    corner_indices: tuple[int, ...] | None = None

    @property
    def label(self) -> str:
        """The text beside the detection in a picture."""
        return f"{self.id}: {self.reason}" if self.reason else self.id


@dataclass(frozen=True, slots=True, eq=False)
class PairRecord:
    """A synchronised measurement as this library writes it."""

    logged_ns: int
    stamp_ns: int
    topic: str
    target: str
    sensor: str
    #: A, B: (4, 4): T_sensorcarrier_targetcarrier and T_sensor_target, in metres
    A: Array
    B: Array
    is_inlier: bool = True
    reason: str = ""  #: Why the measurement is an outlier; empty for an inlier
    covariance: Array | None = None  #: (6, 6): The covariance of B, as in `PoseRecord`


@dataclass(frozen=True, slots=True, eq=False)
class CloudRecord:
    """A cloud of points, not decoded: `height` rows of `width` points; a cloud that is no image has one row."""

    logged_ns: int
    stamp_ns: int
    topic: str
    frame: str
    width: int
    height: int
    step: int  #: Bytes of a point
    row_step: int  #: Bytes from one row to the next
    #: Of each field of a point: its name, where it begins in the point, and NumPy's name for its type, ``<f4``
    fields: tuple[tuple[str, int, str], ...]
    data: bytes
    T_frame_points: Array | None = None  #: (4, 4), metres: where the points' origin is; None if it is the frame's


Record: TypeAlias = PoseRecord | ImageRecord | IntrinsicsRecord | DetectionRecord | PairRecord | CloudRecord


#: ROS's topics of transforms end with these words.
TF_TOPICS = ("tf", "tf_static")
TRANSFORM_SCHEMAS = ("foxglove.FrameTransforms", "foxglove.FrameTransform")
INTRINSICS_SCHEMAS = ("sensor_msgs/msg/CameraInfo", "sensor_msgs/CameraInfo", "foxglove.CameraCalibration")
#: In ROS and in Foxglove, the schemas of images that can be decoded end with these words.
IMAGE_SCHEMAS = ("Image", "CompressedImage", "RawImage")
VIDEO_SCHEMAS = ("CompressedVideo",)
#: The schemas of clouds of points end with these words.
CLOUD_SCHEMAS = ("PointCloud2", "PointCloud")
#: These schemas are this library's own.
TAG_DETECTIONS = "gtsam_rwhec.TagDetections"
MEASURED_PAIR = "gtsam_rwhec.MeasuredPair"


def schema_word(schema: str) -> str:
    """The last word of a schema's name, such as ``Image`` of ``sensor_msgs/msg/Image`` and ``foxglove.Image``."""
    return schema.replace("/", ".").rpartition(".")[2]


@dataclass(frozen=True)
class Topic:
    """A topic of a log."""

    name: str
    schema: str
    encoding: str
    count: int
    #: first_ns, last_ns: first and last log time. If the file has an index, they are the times of the chunks that have
    #: the topic.
    first_ns: int | None
    last_ns: int | None
    unreadable: str  #: Why the messages cannot become records; the text is empty if they can

    @property
    def is_tf(self) -> bool:
        """Whether the topic has transforms of the log's tree of frames."""
        return self.name.rpartition("/")[2] in TF_TOPICS or self.schema in TRANSFORM_SCHEMAS

    @property
    def has_images(self) -> bool:
        """Whether its messages are images that can be decoded."""
        return schema_word(self.schema) in IMAGE_SCHEMAS

    @property
    def has_clouds(self) -> bool:
        """Whether its messages are clouds of points."""
        return schema_word(self.schema) in CLOUD_SCHEMAS


#: A quaternion's norm may be this far from 1. The quaternion is then normalised.
QUATERNION_TOLERANCE = 1e-2
#: A position further away than this, in metres, is refused.
LARGEST_M = 1e12
#: A covariance with a larger entry, m^2 or rad^2, says nothing: it is of a place further away than `LARGEST_M`.
LARGEST_VARIANCE = LARGEST_M**2


def transforms(positions: Array, quaternions_xyzw: Array) -> tuple[Array, dict[int, str]]:
    """Make (N, 4, 4) transforms of (N, 3) positions in metres and (N, 4) quaternions, and say what is wrong, by index.

    A fault is an entry that is not finite, a norm that is not 1, or a position too far away; T is the identity there.
    """
    norms = np.sqrt(np.einsum("ij,ij->i", quaternions_xyzw, quaternions_xyzw))
    # Every comparison with NaN is false, so NaN is a fault.
    good = (np.abs(norms - 1.0) <= QUATERNION_TOLERANCE) & (np.abs(positions) <= LARGEST_M).all(axis=1)
    bad = np.flatnonzero(~good).tolist()
    faults = {i: _fault(positions[i], quaternions_xyzw[i], float(norms[i])) for i in bad}
    if bad:
        positions = np.where(good[:, None], positions, 0.0)
        quaternions_xyzw = np.where(good[:, None], quaternions_xyzw, [0.0, 0.0, 0.0, 1.0])
    return se3.pose(to_rotations(quaternions_xyzw), positions), faults


def _fault(position: Array, quaternion: Array, norm: float) -> str:
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        return f"position {position.tolist()} or quaternion {quaternion.tolist()} (x, y, z, w) is not finite"
    if not abs(norm - 1.0) <= QUATERNION_TOLERANCE:
        return f"quaternion {quaternion.tolist()} (x, y, z, w) has norm {norm:.6g} in place of 1"
    return f"position {position.tolist()} is further than {LARGEST_M:g} m away"


def gtsam_covariances(T: Array, covariances: Array) -> list[Array | None]:
    """Turn (N, 6, 6) covariances of ROS poses T (N, 4, 4) into GTSAM's.

    ROS has (x, y, z, rotations about the fixed axes x, y, z) in the parent frame: t + d, Exp(phi) R. A right
    perturbation [omega, v] moves (R, t) to (R Exp(omega), t + R v), so omega = R' phi and v = R' d. A covariance that
    is all zeros or has a negative variance (so ROS marks an unknown covariance), is not finite or has entries beyond
    `LARGEST_VARIANCE` becomes None.
    """
    diagonal = np.diagonal(covariances, axis1=1, axis2=2)
    # Every comparison with NaN is false, so NaN is unknown.
    known: NDArray[np.bool_] = np.asarray((np.abs(covariances) <= LARGEST_VARIANCE).all(axis=(1, 2)))
    known &= (diagonal >= 0).all(axis=1) & diagonal.any(axis=1)
    if not known.any():
        return [None] * len(T)
    given = np.where(known[:, None, None], covariances, 0.0)
    symmetric = 0.5 * (given + given.transpose(0, 2, 1))
    # (N, 2, 2, 3, 3) blocks, rotation first
    blocks = symmetric.reshape(-1, 2, 3, 2, 3).transpose(0, 1, 3, 2, 4)[:, ::-1, ::-1]
    R = T[:, None, None, :3, :3]
    right = (R.swapaxes(-1, -2) @ blocks @ R).transpose(0, 1, 3, 2, 4).reshape(-1, 6, 6)
    return [right[i] if is_known else None for i, is_known in enumerate(known.tolist())]


def cloud_fault(cloud: CloudRecord) -> str:
    """Say what is wrong with a cloud's size; the text is empty if the data has all points, with all of their fields."""
    for name, offset, kind in cloud.fields:
        if offset + np.dtype(kind).itemsize > cloud.step:
            return f"field {brief(name)} ends beyond the {cloud.step} bytes of a point"
    rows = f"{cloud.height} x {cloud.width} points of {cloud.step} bytes, {cloud.row_step} bytes a row,"
    if cloud.row_step < cloud.width * cloud.step or cloud.height * cloud.row_step > len(cloud.data):
        return f"a cloud of {rows} has {len(cloud.data)} bytes"
    return ""


def image_fault(width: int, height: int, step: int, data: bytes) -> str:
    """Say what is wrong with a raw image's size; the text is empty if the data has all rows."""
    if width * height and step * height <= len(data):
        return ""
    return f"image of {width} x {height} pixels, {step} bytes a row, has {len(data)} bytes"
