"""Clouds from points with named fields, as PCD, PLY and messages have them: x, y, z, and what LiDARs add."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.detect.images import decode_depth
from gtsam_rwhec.errors import CloudError, ImageError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs.records import CloudRecord, ImageRecord

#: Names that drivers and programs give to a field.
INTENSITIES = ("intensity", "intensities", "i", "reflectivity", "reflectance", "scalar_Intensity", "scalar_intensity")
RINGS = ("ring", "rings", "channel", "line", "laser_id")
TIMES = ("times_s", "t", "time", "timestamp", "time_stamp", "offset_time", "timeStamp", "stamp")
#: A time of floating point beyond this is in nanoseconds, and one beyond `SECONDS_OF_A_SWEEP` is of a clock.
NANOSECONDS, SECONDS_OF_A_SWEEP = 1e12, 1e4
#: Metres of one unit of a depth image: of whole numbers (16 bits), and of floating point.
MILLIMETRE, METRE = 1e-3, 1.0


def cloud_of_fields(
    fields: Mapping[str, np.ndarray],
    *,
    shape: tuple[int, int] | None,
    unit_m: float = METRE,
    T_frame_points: Array | None = None,
    stamp_ns: int | None = None,
    frame_id: str = "",
    source: str = "",
) -> Cloud:
    """The cloud of fields (N,) by name; `unit_m` is the unit of x, y and z in metres, `shape` that of an image.

    Raises
    ------
    CloudError
        x, y or z is missing, or no point is seen.
    """
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise CloudError(f"{source}: no field {', '.join(missing)}; it has {', '.join(fields) or 'none'}")
    with np.errstate(invalid="ignore"):  # a nan that signals, in damaged bytes
        points = np.stack([fields[axis] for axis in "xyz"], axis=-1, dtype=np.float64)
    if T_frame_points is not None:
        seen = np.isfinite(points).all(axis=1) & points.any(axis=1)  # the origin, where nothing is seen, stays there
        points[seen] = points[seen] @ T_frame_points[:3, :3].T + T_frame_points[:3, 3] / unit_m
    if unit_m != METRE:
        points *= unit_m
    intensities, rings, times = (_first(fields, names) for names in (INTENSITIES, RINGS, TIMES))
    return Cloud.of(
        points if shape is None else points.reshape(*shape, 3),
        rings=rings,
        times_s=None if times is None else _seconds(times, stamp_ns),
        intensities=None if intensities is None else intensities.astype(np.float64),
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        source=source,
    )


def _first(fields: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray | None:
    """The field of one of these names; fields with several numbers a point are none of them."""
    return next((fields[name] for name in names if name in fields and fields[name].ndim == 1), None)


def _seconds(times: np.ndarray, stamp_ns: int | None) -> Array:
    """Seconds after the stamp: whole numbers are nanoseconds; times of a clock begin at the stamp, or at the first."""
    is_whole = np.issubdtype(times.dtype, np.integer)
    finite = times[np.isfinite(times)]
    largest = float(np.abs(finite).max(initial=0.0))
    unit = 1e-9 if is_whole or largest > NANOSECONDS else 1.0
    if largest * unit <= SECONDS_OF_A_SWEEP:
        return times.astype(np.float64) * unit
    first = finite.min()
    after = (times - first).astype(np.float64) * unit
    return np.asarray(after if stamp_ns is None else after + (float(first) * unit - stamp_ns * 1e-9))


def cloud_of_record(record: CloudRecord, unit_m: float = METRE, *, source: str = "", most: int | None = None) -> Cloud:
    """The cloud of a log's message; of more points than ``most``, each so-manieth one. Raises as `cloud_of_fields`."""
    dtype = np.dtype({
        "names": [name for name, _, _ in record.fields],
        "offsets": [offset for _, offset, _ in record.fields],
        "formats": [kind for _, _, kind in record.fields],
        "itemsize": record.step,
    })  # fmt: skip
    count = record.width * record.height
    if record.row_step == record.width * record.step:
        table = np.frombuffer(record.data, dtype, count)
    else:
        rows = np.frombuffer(record.data, np.uint8, record.height * record.row_step).reshape(record.height, -1)
        table = np.ascontiguousarray(rows[:, : record.width * record.step]).reshape(-1).view(dtype)
    every = 1 if most is None else max(1, count // most)
    return cloud_of_fields(
        {name: table[name][::every] for name in dtype.names or ()},
        shape=(record.height, record.width) if record.height > 1 and every == 1 else None,
        unit_m=unit_m,
        T_frame_points=record.T_frame_points,
        stamp_ns=record.stamp_ns,
        frame_id=record.frame,
        source=source or f"topic {record.topic}, cloud at {record.stamp_ns} ns",
    )


def record_of_cloud(cloud: Cloud | None, topic: str, stamp_ns: int, frame: str) -> CloudRecord:
    """A cloud as a message, with nan where nothing is seen; without a cloud, one of no points.

    Numbers of single precision, as nearly all files have, stay such.
    """
    if cloud is None:
        cloud = Cloud(np.empty((0, 3)), np.empty(0, dtype=int))
    rows, columns = (1, len(cloud)) if cloud.shape is None else cloud.shape
    at = np.arange(len(cloud)) if cloud.shape is None else cloud.at
    kind = "<f4" if np.array_equal(cloud.points.astype("<f4"), cloud.points) else "<f8"
    columns_of = {axis: (cloud.points[:, i], kind) for i, axis in enumerate("xyz")}
    for name, values, of in (
        ("intensity", cloud.intensities, "<f4"), ("ring", cloud.rings, "<u2"), ("times_s", cloud.times_s, "<f4")
    ):  # fmt: skip
        if values is not None:
            columns_of[name] = values, of
    dtype = np.dtype([(name, of) for name, (_, of) in columns_of.items()])
    table = np.zeros(rows * columns, dtype)
    for axis in "xyz":
        table[axis] = np.nan
    for name, (values, _) in columns_of.items():
        table[name][at] = values
    offsets = np.cumsum([0, *(np.dtype(of).itemsize for _, of in columns_of.values())]).tolist()[:-1]
    fields = tuple((name, offset, of) for (name, (_, of)), offset in zip(columns_of.items(), offsets, strict=True))
    step = dtype.itemsize
    return CloudRecord(
        stamp_ns, stamp_ns, topic, frame, columns, rows, step, columns * step, fields, table.tobytes()
    )  # fmt: skip


def cloud_of_depth(image: ImageRecord, camera: Camera, unit_m: float | None = None, *, source: str = "") -> Cloud:
    """The organised cloud of a depth image: each pixel has the z of its point, 0 or nan where nothing is seen.

    Without `unit_m`, whole numbers are millimetres, and floating point is metres. Pixels without a ray of the lens are
    dropped as those without a depth are.

    Raises
    ------
    CloudError
        The image cannot be decoded, has another size than the intrinsics are for, or shows no depth.
    """
    stamped = f"topic {image.topic}, image at {image.stamp_ns} ns"
    where = source or stamped
    try:
        depth = decode_depth(image, (camera.width, camera.height))
    except ImageError as error:
        raise CloudError(str(error).replace(stamped, where)) from error
    if unit_m is None:
        unit_m = METRE if np.issubdtype(depth.dtype, np.floating) else MILLIMETRE
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[rows, columns].astype(np.float64) * unit_m
    points = np.full((*depth.shape, 3), np.nan)
    points[rows, columns, :2] = camera.undistort(np.stack([columns, rows], axis=1).astype(np.float64)) * z[:, None]
    points[rows, columns, 2] = z
    return Cloud.of(points, stamp_ns=image.stamp_ns, frame_id=image.frame, source=where)
