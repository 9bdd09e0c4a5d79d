"""Gray pixels from a log's images: compressed (JPEG, PNG and others) or in raw encodings of ROS and Foxglove."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.files.budgets import SCANS, pixel_budget
from gtsam_rwhec.logs.records import ImageRecord
from gtsam_rwhec.vision.camera import MOST_PIXELS
from gtsam_rwhec.vision.image_sizes import (
    JPEG,
    PNG,
    Size,
    bytes_a_pixel,
    is_whole_png,
    jpeg_scans,
    stated_size,
    with_pixels_only,
)

Gray = NDArray[np.uint8]

#: Each raw encoding has its channels, the bytes in a channel, and OpenCV's conversion to gray (None for gray images).
_RAW: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None), "8uc1": (1, 1, None), "mono16": (1, 2, None), "16uc1": (1, 2, None),
    "rgb8": (3, 1, cv2.COLOR_RGB2GRAY), "8uc3": (3, 1, cv2.COLOR_BGR2GRAY), "bgr8": (3, 1, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, 1, cv2.COLOR_RGBA2GRAY), "bgra8": (4, 1, cv2.COLOR_BGRA2GRAY), "8uc4": (4, 1, cv2.COLOR_BGRA2GRAY),
    # OpenCV names a Bayer pattern by the second row's second and third pixels, ROS by the first row's first two.
    "bayer_rggb8": (1, 1, cv2.COLOR_BayerBG2GRAY), "bayer_bggr8": (1, 1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, 1, cv2.COLOR_BayerGR2GRAY), "bayer_grbg8": (1, 1, cv2.COLOR_BayerGB2GRAY),
    "yuv422": (2, 1, cv2.COLOR_YUV2GRAY_UYVY), "uyvy": (2, 1, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2GRAY_YUY2), "yuyv": (2, 1, cv2.COLOR_YUV2GRAY_YUY2),
}  # fmt: skip
RAW_ENCODINGS = tuple(_RAW)
#: Intrinsics are for the pixels as recorded: EXIF's orientation is ignored. More than 8 bits are kept until they are
#: scaled.
_WHOLE = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
#: Parts of its size at which a JPEG can be decoded.
_REDUCED = {
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4, 2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
}  # fmt: skip
#: Pixels are scaled to 8 bits in pieces of about this many.
_PIECE = 1 << 20


def decode_gray(image: ImageRecord, size: Size | None = None) -> Gray:
    """Pixels (height, width), 8 bits, of a log's image; 16 bits are scaled so that the brightest pixel is 255.

    Parameters
    ----------
    image
    size : (width, height), optional
        The size that the camera's intrinsics are for. An image of another size is refused before it is decoded.

    Raises
    ------
    ImageError
        The image cannot be decoded, has another size, has more pixels than an image of its bytes may have
        (``files/budgets.py``), or has an encoding that is not supported.
    """
    where = f"topic {image.topic}, image at {image.stamp_ns} ns"
    gray = _compressed(image, where, size) if image.is_compressed else _raw(image, where, size)
    _check_size(where, (gray.shape[1], gray.shape[0]), size)
    return gray


def decode_small(image: ImageRecord, width: int) -> Gray:
    """Pixels, 8 bits, of a small picture of so many columns; a JPEG is decoded at a part of its size, which is faster.

    Raises
    ------
    ImageError
        As `decode_gray`.
    """
    where = f"topic {image.topic}, image at {image.stamp_ns} ns"
    size = stated_size(image.data) if image.is_compressed and image.data.startswith(JPEG) else None
    part = 1 if size is None else next((part for part in _REDUCED if size[0] >= part * width), 1)
    gray = decode_gray(image) if part == 1 else _compressed(image, where, None, _REDUCED[part])
    height = max(1, round(gray.shape[0] * width / gray.shape[1]))
    return np.asarray(cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _check_size(where: str, found: Size, wanted: Size | None) -> None:
    if wanted is not None and found != wanted:
        raise ImageError(
            f"{where}: {found[0]} x {found[1]} pixels, but the intrinsics are for {wanted[0]} x {wanted[1]}"
        )


def _compressed(image: ImageRecord, where: str, wanted: Size | None, flags: int = _WHOLE) -> Gray:
    if not len(image.data):
        raise ImageError(f"{where}: there are no bytes in it")
    begins, claims = image.data[:8].hex(), image.encoding[:40]
    what = f"{where}: {len(image.data)} bytes that begin with {begins} and claim to be {claims!r}"
    size = stated_size(image.data)
    if size is None:
        raise ImageError(f"{what} are not a JPEG, PNG, WebP, TIFF or BMP file with a size")
    most = min(MOST_PIXELS, pixel_budget(len(image.data), bytes_a_pixel(image.data)))
    if size[0] * size[1] > most:
        raise ImageError(
            f"{where}: {size[0]} x {size[1]} pixels are more than the {most} that are decoded of an image of "
            f"{len(image.data)} bytes"
        )
    _check_size(where, size, wanted)
    if image.data.startswith(PNG) and not is_whole_png(image.data):  # libpng would print a line for each
        raise ImageError(f"{where}: {len(image.data)} bytes of a PNG file that is cut short")
    if jpeg_scans(image.data) > SCANS:
        raise ImageError(f"{where}: a JPEG of {jpeg_scans(image.data)} scans, more than the {SCANS} that are decoded")
    buffer = np.frombuffer(with_pixels_only(image.data), dtype=np.uint8)
    try:
        gray = cv2.imdecode(buffer, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # OpenCV 4 and 5 raise for some broken images and return None for others
        gray = None
    if gray is None:
        raise ImageError(f"{what}: OpenCV cannot decode them")
    return gray.astype(np.uint8, copy=False) if gray.dtype == np.uint8 else _eight_bits(gray)


def _eight_bits(wide: NDArray[np.generic]) -> Gray:
    """Pixels scaled so that the brightest pixel is 255; negative and non-finite pixels become black."""
    rows = max(1, _PIECE // max(1, wide.shape[1]))
    pieces = [wide[start : start + rows] for start in range(0, len(wide), rows)]
    brightest = max((float(_finite(piece).max(initial=0.0)) for piece in pieces), default=0.0)
    factor = np.float32(255.0 / brightest if brightest > 0.0 else 0.0)
    gray: Gray = np.empty(wide.shape, dtype=np.uint8)
    for i, piece in enumerate(pieces):
        gray[i * rows : i * rows + rows] = np.rint(np.maximum(_finite(piece), 0.0) * factor)
    return gray


def _finite(wide: NDArray[np.generic]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        return np.nan_to_num(wide.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


def _raw(image: ImageRecord, where: str, wanted: Size | None) -> Gray:
    width, height, step = image.width, image.height, image.step
    if width is None or height is None or step is None:
        raise ImageError(f"{where}: a raw image without width, height or step")
    encoding = image.encoding.strip().lower()
    if encoding not in _RAW:
        raise ImageError(f"{where}: encoding {image.encoding!r} is not supported; supported are {', '.join(_RAW)}")
    channels, size, code = _RAW[encoding]
    if width < 1 or height < 1 or step < width * channels * size or len(image.data) < step * height:
        raise ImageError(
            f"{where}: {width} x {height} pixels of {encoding} in rows of {step} bytes do not fit {len(image.data)} "
            "bytes"
        )
    if width * height > MOST_PIXELS:
        raise ImageError(f"{where}: {width} x {height} pixels are more than the {MOST_PIXELS} that are decoded")
    _check_size(where, (width, height), wanted)
    rows = np.frombuffer(image.data, dtype=np.uint8, count=step * height).reshape(height, step)
    rows = np.ascontiguousarray(rows[:, : width * channels * size])
    if size == 2:
        return _eight_bits(rows.view(">u2" if image.is_bigendian else "<u2"))
    pixels = rows.reshape(height, width, channels) if channels > 1 else rows
    if code is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, code), dtype=np.uint8)
    except cv2.error as error:
        raise ImageError(f"{where}: {encoding} of {width} x {height} pixels not converted: {error}") from error
