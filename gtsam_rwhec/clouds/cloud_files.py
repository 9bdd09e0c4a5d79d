"""Files of one cloud: PCD, PLY, NumPy, KITTI's .bin, and depth images with intrinsics.

A file is what its ending says. No header is trusted: what it claims is compared with the bytes that are there before
any of it is made. PCD and PLY are read here: pypcd4 1.5 makes what a header claims, and takes a cut file for a smaller
cloud; plyfile may not be passed on with a library of another licence. Of PCD's LZF the small python-neo-lzf is used.
"""

from __future__ import annotations

import io
import re
import struct
import tokenize
import warnings
import zipfile
from collections.abc import Callable, Mapping
from math import prod
from pathlib import Path

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.clouds.cloud import CLOUD_FORMATS, Cloud
from gtsam_rwhec.clouds.named_fields import METRE, cloud_of_depth, cloud_of_fields
from gtsam_rwhec.errors import CloudError, LogWarning
from gtsam_rwhec.files.budgets import CLOUD, POINT
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.files.whole_files import read_whole
from gtsam_rwhec.logs.image_folder import FORMATS
from gtsam_rwhec.logs.records import ImageRecord

#: The fields (N,) of a file by name, and the shape of an organised one.
Fields = tuple[Mapping[str, np.ndarray], tuple[int, int] | None]
#: PCD's letters for types.
_PCD_TYPES = {"F": "f", "U": "u", "I": "i"}
_PCD_KEYS = ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA")
#: PLY's types, old names and new.
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
#: A header of PCD or PLY ends within this many bytes.
_HEADER = 1 << 16
#: KITTI's points are x, y, z and intensity; nuScenes' (.pcd.bin) have the ring too.
_KITTI, _NUSCENES = ("x", "y", "z", "intensity"), ("x", "y", "z", "intensity", "ring")


def read_cloud(
    path: str | Path, *, unit_m: float | None = None, camera: Camera | None = None, stamp_ns: int | None = None
) -> Cloud:
    """The cloud of a file.

    Parameters
    ----------
    path
        PCD (ascii, binary, binary_compressed), PLY (ascii, binary), NumPy's .npy (N, 3 or more; rows, columns, 3) or
        .npz (``points``, with ``intensities``, ``rings`` and ``times_s`` if they are there), KITTI's .bin (nuScenes'
        .pcd.bin), or a depth image (PNG of 16 bits, TIFF).
    unit_m : float, optional
        Metres of one unit of the file; by default 1, and 0.001 for depth images of whole numbers.
    camera : Camera, optional
        The intrinsics of a depth image.
    stamp_ns : int, optional

    Returns
    -------
    Cloud
        In the sensor's frame, metres.

    Raises
    ------
    FileFormatError
        The file cannot be read, or is larger than a cloud may be.
    CloudError
        It is no file of this kind, is cut, lacks x, y or z, or no point in it is seen; or a depth image has no camera.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in CLOUD_FORMATS:
        raise CloudError(f"{path} is no file of a cloud; these end with {', '.join(CLOUD_FORMATS)}")
    data = read_whole(path, CLOUD, "A cloud was")
    if not data:
        raise CloudError(f"{path} is empty")
    if ending in FORMATS:
        if camera is None:
            raise CloudError(f"{path}: a depth image needs intrinsics; give the camera that took it")
        image = ImageRecord(0, stamp_ns or 0, "", "", FORMATS[ending], data)
        return cloud_of_depth(image, camera, unit_m, source=str(path))
    try:
        fields, shape = _READERS[ending](data, path)
    except CloudError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, struct.error, MemoryError) as error:
        raise CloudError(f"{path} cannot be read as {ending[1:].upper()}: {brief(str(error), 300)}") from error
    return cloud_of_fields(fields, shape=shape, unit_m=unit_m or METRE, stamp_ns=stamp_ns, source=str(path))


def _checked(count: int, dtype: np.dtype, there: int, path: Path) -> None:
    """Refuse claims of more than the file has."""
    if count < 0 or not 0 < dtype.itemsize <= POINT:
        raise CloudError(f"{path}: {count} points of {dtype.itemsize} bytes")
    if count * dtype.itemsize > there:
        raise CloudError(
            f"{path} is cut: {count} points of {dtype.itemsize} bytes are {count * dtype.itemsize} bytes, and "
            f"{there} are there"
        )


def _by_name(table: np.ndarray) -> dict[str, np.ndarray]:
    return {name: table[name] for name in table.dtype.names or ()}


def _text_table(text: bytes, dtype: np.dtype, count: int, path: Path) -> np.ndarray:
    """Lines of numbers as a table of fields."""
    if not count:
        return np.zeros(0, dtype)
    if count * 2 > len(text):  # a number and a blank at least
        raise CloudError(f"{path} is cut: {count} points, and {len(text)} bytes of text")
    widths = [int(prod(dtype[name].shape)) for name in dtype.names or ()]
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # of no lines at all, which the next line says
        try:
            numbers = np.loadtxt(io.BytesIO(text), np.float64, max_rows=count, ndmin=2)
        except ValueError as error:
            words = f"{path} is cut, or has other lines than {count} of {sum(widths)} numbers: {brief(str(error), 200)}"
            raise CloudError(words) from error
    if len(numbers) < count or numbers.shape[1] < sum(widths):
        raise CloudError(
            f"{path} is cut: {count} points of {sum(widths)} numbers, and there are {len(numbers)} lines of "
            f"{numbers.shape[1]}"
        )
    table = np.zeros(count, dtype)
    for name, start, width in zip(dtype.names or (), np.cumsum([0, *widths]), widths, strict=False):
        if width == 1:
            with np.errstate(invalid="ignore"):  # nan in a field of whole numbers
                table[name] = numbers[:, start]
    return table


def _pcd(data: bytes, path: Path) -> Fields:
    match = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data[:_HEADER], re.MULTILINE)
    lines = data[: match.end() if match else 0].decode("latin-1").splitlines()
    head = {line.split()[0].upper(): line.split()[1:] for line in lines if line.strip() and not line.startswith("#")}
    missing = [key for key in _PCD_KEYS if not head.get(key)]
    if match is None or missing:
        raise CloudError(f"{path} is no PCD file: its header lacks {', '.join(missing)}")
    names, counts = head["FIELDS"], [int(count) for count in head.get("COUNT", ["1"] * len(head["FIELDS"]))]
    kinds = [_PCD_TYPES[kind] + str(int(size)) for kind, size in zip(head["TYPE"], head["SIZE"], strict=True)]
    if not len(names) == len(kinds) == len(counts) or not all(0 < each <= POINT for each in counts):
        raise CloudError(f"{path}: FIELDS {names}, SIZE, TYPE and COUNT {counts[:20]} do not fit each other")
    shapes = [() if many == 1 else (many,) for many in counts]
    unique = [f"_{i}" if name == "_" or name in names[:i] else name for i, name in enumerate(names)]  # _ is padding
    dtype = np.dtype([(name, f"<{kind}", shape) for name, kind, shape in zip(unique, kinds, shapes, strict=True)])
    count, width, height = (int(head.get(key, ["0"])[0]) for key in ("POINTS", "WIDTH", "HEIGHT"))
    if "WIDTH" in head and "HEIGHT" in head and width * height != count:
        raise CloudError(f"{path}: {count} points, and WIDTH {width} by HEIGHT {height}")
    viewpoint = [float(number) for number in head.get("VIEWPOINT", [])]
    if viewpoint not in ([], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]):
        words = f"{path}: VIEWPOINT {viewpoint}; the points are taken as the sensor's own, which it should not move"
        warnings.warn(words, LogWarning, stacklevel=4)
    how, body = match[1].decode().lower(), data[match.end() :]
    if how == "ascii":
        table = _text_table(body, dtype, count, path)
    elif how == "binary":
        _checked(count, dtype, len(body), path)
        table = np.frombuffer(body, dtype, count)
    elif how == "binary_compressed":
        table = _uncompressed(body, dtype, count, path)
    else:
        raise CloudError(f"{path}: DATA {how}; PCD has ascii, binary and binary_compressed")
    return _by_name(table), (height, width) if height > 1 else None


def _uncompressed(body: bytes, dtype: np.dtype, count: int, path: Path) -> np.ndarray:
    """The points of a compressed PCD: LZF of all of the first field, then all of the second, and so on."""
    with extra_named():
        import lzf
    packed, whole = struct.unpack_from("<II", body)
    if whole != count * dtype.itemsize or whole > CLOUD or dtype.itemsize > POINT:
        raise CloudError(f"{path}: {count} points of {dtype.itemsize} bytes, and {whole} bytes are compressed")
    if packed > len(body) - 8:
        raise CloudError(f"{path} is cut: {packed} compressed bytes, and {len(body) - 8} are there")
    plain = lzf.decompress(body[8 : 8 + packed], whole) if whole else b""
    if plain is None or len(plain) != whole:
        raise CloudError(f"{path}: its compressed bytes are damaged")
    table, at = np.empty(count, dtype), 0
    for name in dtype.names or ():
        of_field = dtype[name]
        table[name] = np.frombuffer(plain, of_field.base, count * prod(of_field.shape), at).reshape(-1, *of_field.shape)
        at += count * of_field.itemsize
    return table


def _ply(data: bytes, path: Path) -> Fields:
    end = re.search(rb"^end_header[ \t]*\r?\n", data[:_HEADER], re.MULTILINE)
    if not data.startswith(b"ply") or end is None:
        raise CloudError(f"{path} is no PLY file: it does not begin with ply and a header")
    lines = [line.split() for line in data[: end.end()].decode("latin-1").splitlines() if line.strip()]
    how = next((line[1] for line in lines if line[0] == "format"), "")
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines:
        if line[0] == "element":
            elements.append((line[1], int(line[2]), []))
        elif line[0] == "property":
            kind = "list" if line[1] == "list" else _PLY_TYPES[line[1]]
            elements[-1][2].append((line[-1], kind))
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}.get(how)
    if order is None:
        raise CloudError(f"{path}: format {how!r}; PLY has ascii, binary_little_endian and binary_big_endian")
    if "vertex" not in [name for name, _, _ in elements]:
        raise CloudError(f"{path}: no element vertex; it has {', '.join(name for name, _, _ in elements) or 'none'}")
    body = data[end.end() :]
    for name, count, properties in elements:
        if any(kind == "list" for _, kind in properties):
            raise CloudError(f"{path}: the points have lists, or come behind the faces; write the points alone")
        dtype = np.dtype([(field, order + kind) for field, kind in properties])
        if name == "vertex":
            break
        _checked(count, dtype, CLOUD, path)  # passed over
        rest = body.splitlines(keepends=True)[count:] if how == "ascii" else [body[count * dtype.itemsize :]]
        body = b"".join(rest)
    if how == "ascii":
        return _by_name(_text_table(body, dtype, count, path)), None
    _checked(count, dtype, len(body), path)
    return _by_name(np.frombuffer(body, dtype, count)), None


def _array(data: bytes, path: Path) -> np.ndarray:
    """The array of an .npy file, without making more than it has; pickled objects are refused."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, is_fortran, dtype = read(stream)
    except (SyntaxError, tokenize.TokenError) as error:  # the header is Python's text of a dictionary
        raise CloudError(f"{path} is no .npy file: its header is damaged") from error
    if dtype.hasobject:
        raise CloudError(f"{path}: an array of objects, which is not unpickled; save numbers")
    _checked(prod(shape), dtype, len(data) - stream.tell(), path)
    flat = np.frombuffer(data, dtype, prod(shape), stream.tell())
    return flat.reshape(shape, order="F" if is_fortran else "C")


def _of_array(array: np.ndarray, path: Path) -> Fields:
    if array.dtype.names:
        return _by_name(array.reshape(-1)), None
    if array.ndim not in (2, 3) or array.shape[-1] < 3 or array.dtype.kind not in "fiu":
        raise CloudError(f"{path}: {array.dtype} of shape {array.shape}; give numbers, (N, 3) or (rows, columns, 3)")
    flat = array.reshape(-1, array.shape[-1])
    return dict(zip("xyz", flat.T, strict=False)), array.shape[:2] if array.ndim == 3 else None


def _npy(data: bytes, path: Path) -> Fields:
    return _of_array(_array(data, path), path)


def _npz(data: bytes, path: Path) -> Fields:
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        sizes = {each.filename: each.file_size for each in archive.infolist()}
        if sum(sizes.values()) > CLOUD:
            raise CloudError(f"{path}: its arrays have {sum(sizes.values())} bytes, and a cloud at most {CLOUD}")
        arrays = {
            name.removesuffix(".npy"): _array(archive.read(name), path) for name in sizes if name.endswith(".npy")
        }
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise CloudError(f"{path} is no .npz file: {error}") from error
    named = next((name for name in ("points", "xyz", *arrays) if name in arrays), None)
    if named is None or (len(arrays) > 1 and named not in ("points", "xyz")):
        raise CloudError(f"{path} has the arrays {', '.join(arrays) or 'none'}; name the one of the points: points")
    fields, shape = _of_array(arrays.pop(named), path)
    return {**{name: array.reshape(-1) for name, array in arrays.items()}, **fields}, shape


def _bin(data: bytes, path: Path) -> Fields:
    names = _NUSCENES if path.name.lower().endswith(".pcd.bin") else _KITTI
    dtype = np.dtype([(name, "<f4") for name in names])
    if len(data) % dtype.itemsize:
        raise CloudError(
            f"{path}: {len(data)} bytes are no whole points of {len(names)} numbers of 4 bytes; is it cut?"
        )
    fields = _by_name(np.frombuffer(data, dtype))
    if "ring" in fields:
        with np.errstate(invalid="ignore"):
            fields["ring"] = fields["ring"].astype(np.int64)
    return fields, None


_READERS: dict[str, Callable[[bytes, Path], Fields]] = {
    ".pcd": _pcd, ".ply": _ply, ".npy": _npy, ".npz": _npz, ".bin": _bin,
}  # fmt: skip
