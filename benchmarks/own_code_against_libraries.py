"""What is written by hand though a library does it, against that library: same data, in turns.

    pip install -e .[bench] && python benchmarks/own_code_against_libraries.py [--messages 20000]

Each row is the reason why our code stays. Where the bar is missed the library has become as good: use it, and delete
our code. The docstrings of the modules have the figures of the day on which they were compared. OpenCV says on standard
error what is wrong with damaged images.
"""

from __future__ import annotations

import argparse
import io
import struct
import sys
import tempfile
import tracemalloc
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import imagesize
import numpy as np
import zstandard
from bars import Row, print_rows
from interleaved import interleaved
from log_files import POSE, TRANSFORM, header, ros2_log, xyz
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from vision_rate import CELL, the_log

from gtsam_rwhec.detect.images import decode_gray, stated_size
from gtsam_rwhec.detect.tags import dictionary, identified, quadrangles, tag_detector
from gtsam_rwhec.logs import LogWriter, open_log
from gtsam_rwhec.logs.ros2_messages import ros2_decoder
from gtsam_rwhec.rig import read_rig

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "logs"))

T0 = 1_700_000_000_000_000_000
#: Damaged files of each format.
DAMAGED = 500


def row(what: str, figures: dict[str, float], unit: str) -> Row:
    """Ours first; the bar is to have less than every other."""
    ours, *others = figures.values()
    words = ", ".join(f"{name} {figure:.3g}" for name, figure in figures.items())
    return Row(f"{what} ({unit})", words, "ours is less", all(ours < other for other in others))


def reading(folder: Path, count: int) -> list[Row]:
    """``logs/mcap_file.py`` against mcap's reader: time, memory, and what is lost of damaged files."""
    path = folder / "poses.mcap"
    with LogWriter(path) as out:
        for i in range(count):
            out.transforms("/tf", T0 + i * 1_000_000, [("base", "hand", np.eye(4))])

    def ours() -> int:
        with open_log(path) as log:
            return sum(len(part.open(block).heads) for part in log.files for block in part.blocks)

    def mcaps(file: Path = path) -> int:
        found = 0
        with open(file, "rb") as stream:
            try:
                for _ in make_reader(stream, validate_crcs=True).iter_messages():
                    found += 1
            except (McapError, ValueError, EOFError, zstandard.ZstdError):
                pass  # what came before counts
        return found

    times = interleaved(3, {"ours": ours, "mcap": mcaps})
    rows = [row("messages of a log, undecoded", {n: 1e6 * times.median(n) / count for n in times.of}, "us each")]
    peaks = {}
    for name, call in (("ours", ours), ("mcap", mcaps)):
        tracemalloc.start()
        call()
        peaks[name] = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
    content = path.read_bytes()
    cut, damaged = folder / "cut.mcap", folder / "damaged.mcap"
    cut.write_bytes(content[: int(0.7 * len(content))])
    with open_log(path) as log:
        block = log.files[0].blocks[0]
    at = block.offset + block.length // 2
    damaged.write_bytes(content[:at] + bytes([content[at] ^ 255]) + content[at + 1 :])
    rows.append(Row("    memory at its peak", ", ".join(f"{name} {peak:.1f} MB" for name, peak in peaks.items())))
    for what, file in (("breaks off at 70 %", cut), ("has a damaged chunk", damaged)):
        with open_log(file) as log:
            found = sum(1 for _ in log.records())
        lost = {"ours": count - found, "mcap": count - mcaps(file)}
        rows.append(row(f"    of {count} messages lost where a file {what}", lost, "messages"))
    return rows


def decoding(folder: Path, count: int) -> list[Row]:
    """``logs/cdr.py`` and ``ros2_messages.py`` against mcap-ros2-support and rosbags."""
    tag = {
        "family": "36h11", "id": 7, "hamming": 0, "goodness": 0.0, "decision_margin": 50.0, "centre": xyz(1, 1),
        "corners": [xyz(0, 0), xyz(2, 0), xyz(2, 2), xyz(0, 2)], "homography": [0.0] * 9,
    }  # fmt: skip
    zero = {"twist": {"linear": xyz(0, 0, 0), "angular": xyz(0, 0, 0)}, "covariance": [0.0] * 36}
    transform = {"header": header(T0), "child_frame_id": "hand", "transform": TRANSFORM}
    pose = {"pose": POSE, "covariance": [1.0] * 36}
    messages: dict[str, dict[str, Any]] = {
        "geometry_msgs/PoseStamped": {"header": header(T0), "pose": POSE},
        "tf2_msgs/TFMessage": {"transforms": [transform]},
        "nav_msgs/Odometry": {"header": header(T0), "child_frame_id": "hand", "pose": pose, "twist": zero},
        "apriltag_msgs/AprilTagDetectionArray": {"header": header(T0), "detections": [tag, tag]},
        "sensor_msgs/CompressedImage": {"header": header(T0), "format": "jpeg", "data": b"\xff\xd8" * 100},
    }
    rows = []
    for name, message in messages.items():
        path = ros2_log(folder / "ros2.mcap", [("/a", name, message, T0)])
        with open(path, "rb") as stream:
            ((schema, _, written),) = make_reader(stream).iter_messages()
        assert schema is not None
        definition, data = schema.data.decode(), written.data
        ours = ros2_decoder(schema.name, definition)
        mcap_ros2 = DecoderFactory().decoder_for("cdr", schema)
        assert mcap_ros2 is not None
        store = get_typestore(Stores.EMPTY)
        builtin = get_typestore(Stores.ROS2_HUMBLE).fielddefs
        store.register({**builtin, **get_types_from_msg(definition, schema.name)})

        def mine(read: Any = ours, data: bytes = data) -> object:
            return [read("/a", [data] * 4096, [0] * 4096) for _ in range(count // 4096 + 1)]

        def theirs(decode: Callable[[bytes], object] = mcap_ros2, data: bytes = data) -> object:
            return [decode(data) for _ in range(count)]

        def bags(store: Any = store, name: str = schema.name, data: bytes = data) -> object:
            return [store.deserialize_cdr(data, name) for _ in range(count)]

        times = interleaved(2, {"ours, to records": mine, "mcap-ros2-support": theirs, "rosbags": bags})
        each = {n: 1e6 * times.median(n) / (4096 * (count // 4096 + 1) if "ours" in n else count) for n in times.of}
        rows.append(row(f"{name}, decoded", each, "us each"))
    accepted = 0
    for length in range(len(data)):
        try:
            mcap_ros2(data[:length])
            accepted += 1
        except (ValueError, IndexError, struct.error):
            pass
    own = sum(not isinstance(read, str) for n in range(len(data)) for read in ours("/a", [data[:n]], [0]))
    cut = {"ours": float(own), "mcap-ros2-support": float(accepted)}
    return [*rows, row(f"    images cut short, of {len(data)} lengths, that are taken for whole", cut, "images")]


def tags(most: int = 40) -> list[Row]:
    """``detect/tags.py`` against OpenCV: all tags of the targets' families in images of the shipped log."""
    images, _ = the_log()
    grays = [decode_gray(image) for image in images[:most]]
    families = sorted({target.family for target in read_rig(CELL / "rig.yaml").target_list if target.ids})
    detectors = {family: tag_detector(family) for family in families}
    found: dict[str, Counter[tuple[str, int]]] = {}

    def note(name: str, family: str, ids: Sequence[int]) -> None:
        found.setdefault(name, Counter()).update((family, int(i)) for i in ids if i >= 0)

    def ours() -> None:
        for gray in grays:
            quads = quadrangles(gray)
            for family in families:
                note("ours", family, identified(gray, quads, family).tolist())

    def one_by_one() -> None:
        for gray in grays:
            quads = quadrangles(gray)
            for family in families:
                note("identify", family, [_identify(gray, quad, family) for quad in quads])

    def whole_families() -> None:
        for gray in grays:
            for family, detector in detectors.items():
                _, ids, _ = detector.detectMarkers(gray)
                note("detect", family, [] if ids is None else np.ravel(ids).tolist())

    calls = {"ours": ours, "Dictionary.identify": one_by_one, "ArucoDetector": whole_families}
    times = interleaved(2, calls)
    each = {name: 1e3 * times.median(name) / len(grays) for name in calls}
    kinds = {name: len(counter) for name, counter in found.items()}
    return [
        row(f"tags of whole families in an image, OpenCV {cv2.__version__}", each, "ms each"),
        Row("    different tags that were read", ", ".join(f"{name} {count}" for name, count in kinds.items())),
    ]


def _identify(gray: np.ndarray, quad: np.ndarray, family: str) -> int:
    """A tag's id as OpenCV's Dictionary reads it from the flattened quadrangle; -1 for none."""
    tags_of = dictionary(family)
    modules = int(tags_of.markerSize) + 2
    side = 4 * modules
    square = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32) - 0.5
    flat = cv2.warpPerspective(gray, cv2.getPerspectiveTransform(quad.astype(np.float32), square), (side, side))
    flat = cv2.threshold(flat, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[1]
    bits = (cv2.resize(flat.astype(np.float32), (modules, modules), interpolation=cv2.INTER_AREA) > 0.5).astype(
        np.uint8
    )
    inner = np.ascontiguousarray(bits[1:-1, 1:-1])
    if int(bits.sum()) - int(inner.sum()) > 0.35 * (4 * modules - 4):
        return -1
    is_one, number, _ = tags_of.identify(inner, 0.6)
    return int(number) if is_one else -1


def sizes() -> list[Row]:
    """``detect/images.py`` against Pillow and imagesize: damaged files, and TIFFs that state two widths."""
    Image.MAX_IMAGE_PIXELS = None
    gray = (60 + 6 * np.arange(24)[None] + 2 * np.arange(18)[:, None]).astype(np.uint8)

    def pillow(data: bytes) -> tuple[int, int] | None:
        try:
            return Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "WEBP", "TIFF", "BMP")).size
        except Exception:  # noqa: BLE001  (whatever its readers raise)
            return None

    def image_size(data: bytes) -> tuple[int, int] | None:
        try:
            width, height = imagesize.get(io.BytesIO(data))
        except Exception:  # noqa: BLE001
            return None
        return (width, height) if width > 0 else None

    readers = {"ours": stated_size, "Pillow": pillow, "imagesize": image_size}
    refused = dict.fromkeys(readers, 0.0)
    too_small = dict.fromkeys(readers, 0.0)
    decoded = 0

    def look(data: bytes) -> None:
        nonlocal decoded
        stated = {name: read(data) for name, read in readers.items()}
        if any(size is not None and size[0] * size[1] > 3e7 for size in stated.values()):
            return
        try:
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
        except cv2.error:
            return
        if pixels is None:
            return
        decoded += 1
        for name, size in stated.items():
            refused[name] += size is None
            too_small[name] += size is not None and size[0] * size[1] < pixels.size

    whole = cv2.imencode(".tiff", gray)[1].tobytes()
    (at,) = struct.unpack_from("<I", whole, 4)
    (count,) = struct.unpack_from("<H", whole, at)
    for entry in range(1, count):
        twice = bytearray(whole)
        struct.pack_into("<HHII", twice, at + 2 + 12 * entry, 256, 4, 1, 1)  # a second width: one pixel
        look(bytes(twice))
    of_two = Row(
        f"of {decoded} TIFFs with two widths, stated smaller than OpenCV decodes",
        ", ".join(f"{name} {number:.0f}" for name, number in too_small.items()),
        "none of ours, some of imagesize",
        too_small["ours"] == 0 < too_small["imagesize"],
    )
    refused |= dict.fromkeys(readers, 0.0)
    decoded = 0
    generator = np.random.default_rng(1)
    for ending in (".bmp", ".tiff"):
        whole = cv2.imencode(ending, gray)[1].tobytes()
        for _ in range(DAMAGED):
            data = bytearray(whole)
            data[generator.integers(len(data))] = generator.integers(256)
            look(bytes(data))
    of_damaged = Row(
        f"of {decoded} damaged images that OpenCV decodes, refused",
        ", ".join(f"{name} {number:.0f}" for name, number in refused.items()),
        "ours is less than Pillow",
        refused["ours"] < refused["Pillow"],
    )
    return [of_two, of_damaged]


def rows(messages: int) -> list[Row]:
    """All of them."""
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return [*reading(Path(name), messages), *decoding(Path(name), messages), *tags(), *sizes()]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=20_000)
    status = print_rows("Our own code against libraries", rows(parser.parse_args().messages))
    names_of = ("mcap", "mcap-ros2-support", "rosbags", "pillow", "imagesize")
    print(", ".join(f"{name} {version(name)}" for name in names_of))
    raise SystemExit(status)
