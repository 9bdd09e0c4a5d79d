"""Files of clouds: what is written is read back, and what is cut, wrong or too large is refused in words."""

from __future__ import annotations

import contextlib
import io
import struct
import tracemalloc
from pathlib import Path

import cv2
import lzf
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.recfunctions import unstructured_to_structured

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.clouds import read_cloud
from gtsam_rwhec.errors import CloudError, FileFormatError, LogWarning

CAMERA = Camera.of(8, 6, "pinhole", [[10.0, 0.0, 3.5], [0.0, 12.0, 2.5], [0.0, 0.0, 1.0]], (), "a test")
#: A PCD as scanners write it: four bytes of padding behind each point.
HEAD = (
    "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z _\nSIZE 4 4 4 1\nTYPE F F F U\n"
    "COUNT 1 1 1 4\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {how}\n"
)


def points_of(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 1.0, (count, 3)).astype(np.float32)


def pcd(points: np.ndarray, how: str, rows: int = 1) -> bytes:
    head = HEAD.format(width=len(points) // rows, height=rows, count=len(points), how=how).encode()
    if how == "ascii":
        return head + "".join(f"{x!r} {y!r} {z!r} 1 2 3 4\n" for x, y, z in points.tolist()).encode()
    if how == "binary":
        return head + np.c_[points.view(np.uint8), np.zeros((len(points), 4), np.uint8)].tobytes()
    plain = points.T.tobytes() + bytes(4 * len(points))
    packed = lzf.compress(plain, 2 * len(plain))
    return head + struct.pack("<II", len(packed), len(plain)) + packed


def ply(points: np.ndarray, how: str, before: str = "", elements: bytes = b"") -> bytes:
    head = f"ply\nformat {how} 1.0\ncomment made by a test\n{before}element vertex {len(points)}\n"
    head += "property float x\nproperty float y\nproperty double z\nproperty uchar red\nelement face 1\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    order = ">" if how == "binary_big_endian" else "<"
    if how == "ascii":
        return head.encode() + elements + "".join(f"{x!r} {y!r} {z!r} 7\n" for x, y, z in points.tolist()).encode()
    dtype = np.dtype([("x", order + "f4"), ("y", order + "f4"), ("z", order + "f8"), ("red", "u1")])
    table = unstructured_to_structured(np.c_[points, np.zeros(len(points))], dtype)
    return head.encode() + elements + table.tobytes() + b"\3\0\0\0\0"


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


WRITERS = {
    "ascii.pcd": lambda points: pcd(points, "ascii"),
    "binary.pcd": lambda points: pcd(points, "binary"),
    "compressed.pcd": lambda points: pcd(points, "binary_compressed"),
    "ascii.ply": lambda points: ply(points, "ascii"),
    "little.ply": lambda points: ply(points, "binary_little_endian"),
    "big.ply": lambda points: ply(points, "binary_big_endian"),
    "a.npy": npy,
    "fortran.npy": lambda points: npy(np.asfortranarray(points)),
    "kitti.bin": lambda points: np.c_[points, np.ones(len(points), np.float32)].tobytes(),
    "sweep.pcd.bin": lambda points: np.c_[points, np.ones((len(points), 2), np.float32)].tobytes(),
}


@pytest.mark.parametrize("name", WRITERS)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 60))
def test_what_is_written_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, name: str, seed: int, count: int
) -> None:
    points = points_of(seed, count)
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(WRITERS[name](points))
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, points)
    assert cloud.shape is None
    assert cloud.source == str(path)


@pytest.mark.parametrize("name", WRITERS)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_damage_is_refused_or_gives_points_and_never_fails_otherwise(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    whole = bytearray(WRITERS[name](points_of(1, 20)))
    at = data.draw(st.integers(0, len(whole) - 1))
    if data.draw(st.booleans()):
        whole = whole[:at]
    else:
        whole[at : at + 4] = data.draw(st.binary(min_size=4, max_size=4))
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(whole)
    with contextlib.suppress(CloudError):
        assert np.isfinite(read_cloud(path).points).all()


@pytest.mark.parametrize("name", [name for name in WRITERS if "bin" not in name])
def test_a_cut_file_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(WRITERS[name](points_of(1, 50))[:-200])
    with pytest.raises(CloudError, match=r"is cut|damaged"):
        read_cloud(path)


def test_an_organised_cloud_keeps_its_rows(tmp_path: Path) -> None:
    points = points_of(2, 12)
    points[5] = np.nan
    (tmp_path / "a.pcd").write_bytes(pcd(points, "binary", rows=3))
    cloud = read_cloud(tmp_path / "a.pcd", unit_m=0.001)
    assert cloud.shape == (3, 4)
    assert cloud.dropped == 1
    assert 5 not in cloud.at
    np.testing.assert_allclose(cloud.points, 0.001 * np.delete(points, 5, axis=0).astype(float), rtol=1e-12)


def test_what_a_lidar_adds(tmp_path: Path) -> None:
    points = points_of(3, 10)
    np.savez(tmp_path / "a.npz", points=points, intensities=np.arange(10), rings=np.arange(10), t=np.arange(10) * 10**6)
    cloud = read_cloud(tmp_path / "a.npz", stamp_ns=5)
    assert cloud.rings is not None
    assert cloud.intensities is not None
    assert cloud.times_s is not None
    np.testing.assert_allclose(cloud.times_s, np.arange(10) * 1e-3)
    assert cloud.stamp_ns == 5
    assert cloud.rings.tolist() == list(range(10))


def test_times_of_a_clock_count_from_the_stamp(tmp_path: Path) -> None:
    stamp_ns = 1_700_000_000 * 10**9
    times = 1_700_000_000.0 + np.arange(10) * 1e-3
    np.savez(tmp_path / "a.npz", points=points_of(3, 10), timestamp=times)
    found = read_cloud(tmp_path / "a.npz", stamp_ns=stamp_ns).times_s
    np.testing.assert_allclose(found, np.arange(10) * 1e-3, atol=1e-6)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.npz").times_s, np.arange(10) * 1e-3, atol=1e-6)


@pytest.mark.parametrize(("ending", "kind", "unit_m"), [("png", np.uint16, None), ("png", np.uint16, 0.0002),
                                                       ("tiff", np.float32, None)])  # fmt: skip
def test_a_depth_image_becomes_points(tmp_path: Path, ending: str, kind: type, unit_m: float | None) -> None:
    depth = np.zeros((6, 8), kind)
    depth[2, 3], depth[5, 0] = (1500, 800) if kind is np.uint16 else (1.5, 0.8)
    cv2.imwrite(str(tmp_path / f"a.{ending}"), depth)
    cloud = read_cloud(tmp_path / f"a.{ending}", camera=CAMERA, unit_m=unit_m)
    z = np.array([1.5, 0.8]) * (1.0 if unit_m is None else unit_m / 0.001)
    expected = np.array([[(3 - 3.5) / 10.0, (2 - 2.5) / 12.0, 1.0], [(0 - 3.5) / 10.0, (5 - 2.5) / 12.0, 1.0]])
    np.testing.assert_allclose(cloud.points, expected * z[:, None], rtol=1e-6)
    assert cloud.shape == (6, 8)
    assert cloud.dropped == 46


def refused(path: Path, data: bytes, match: str, **options: object) -> None:
    path.write_bytes(data)
    with pytest.raises(CloudError, match=match):
        read_cloud(path, **options)  # type: ignore[arg-type]


def test_bad_input_in_words(tmp_path: Path) -> None:
    points = points_of(4, 20)
    jpeg = cv2.imencode(".jpg", np.zeros((6, 8), np.uint8))[1].tobytes()
    refused(tmp_path / "a.pcd", b"", "is empty")
    refused(tmp_path / "b.pcd", jpeg, "is no PCD file: its header lacks FIELDS")
    refused(tmp_path / "b.ply", jpeg, "is no PLY file")
    refused(tmp_path / "b.npy", jpeg, "cannot be read as NPY")
    refused(tmp_path / "b.npz", jpeg, "is no .npz file")
    refused(tmp_path / "c.pcd", pcd(points * np.nan, "binary"), "of 20 points none is seen")
    for how in ("ascii", "binary"):
        refused(tmp_path / "c.pcd", pcd(points[:0], how), "c.pcd has no points")
    refused(tmp_path / "c.ply", ply(points * 0.0, "ascii"), "none is seen")
    refused(tmp_path / "d.pcd", pcd(points, "binary").replace(b"x y z", b"x y w"), "no field z; it has x, y, w")
    refused(tmp_path / "d.ply", ply(points, "ascii").replace(b"element vertex", b"element corner"), "no element vertex")
    refused(tmp_path / "e.npy", npy(np.array([{}])), "objects")
    refused(tmp_path / "e.npz", b"PK\5\6" + bytes(18), "the arrays none")
    refused(tmp_path / "f.npy", npy(np.zeros((5, 2))), "shape")
    refused(tmp_path / "g.png", cv2.imencode(".png", np.zeros((6, 8), np.uint8))[1].tobytes(), "needs intrinsics")
    refused(tmp_path / "h.png", cv2.imencode(".png", np.ones((6, 8), np.uint8))[1].tobytes(), "8 bits", camera=CAMERA)
    refused(tmp_path / "i.png", cv2.imencode(".png", np.ones((9, 8), np.uint16))[1].tobytes(), "8 x 9", camera=CAMERA)
    refused(tmp_path / "a.obj", b"v 1 2 3", "no file of a cloud")
    with pytest.raises(FileFormatError, match="No such file"):
        read_cloud(tmp_path / "none.pcd")


def test_elements_before_the_points_are_passed_over(tmp_path: Path) -> None:
    points = points_of(5, 4)
    for how, elements in (("ascii", b"9\n"), ("binary_little_endian", b"\t\0\0\0")):
        (tmp_path / "a.ply").write_bytes(ply(points, how, "element camera 1\nproperty int n\n", elements))
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply").points, points)


def test_a_viewpoint_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(points_of(6, 9), "binary").replace(b"POINT 0 0 0 1", b"POINT 1 0 0 1"))
    with pytest.warns(LogWarning, match="VIEWPOINT"):
        read_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize("how", ["ascii", "binary", "binary_compressed"])
def test_a_claim_of_many_points_costs_nothing(tmp_path: Path, how: str) -> None:
    many = (
        HEAD.format(width=10**9, height=1, count=10**9, how=how).encode() + struct.pack("<II", 9, 4 * 10**9) + b"\0" * 9
    )
    path = tmp_path / "a.pcd"
    tracemalloc.start()
    refused(path, many, "cut|compressed")
    refused(path, many.replace(b"COUNT 1 1 1 4", b"COUNT 1 1 1 999999999"), "do not fit")
    refused(path, b"\x93NUMPY\1\0v\0" + f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({10**12}, 3), }}".encode()
            .ljust(117) + b"\n", "no PCD")  # fmt: skip
    refused(tmp_path / "a.npy", path.read_bytes(), "cut")
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()
