"""Images a second: decoded, detected, with poses and covariances, against a bare loop of OpenCV's calls.

    python benchmarks/vision_rate.py [--repetitions 5]

The bare loop decodes and runs ArucoDetector.detectMarkers and CharucoDetector.detectBoard with default parameters for
the same targets: rough corners, no poses, nothing judged. Both take the shipped log's images from memory, again and
again, on one core and on all, in turns; the bare loop with threads, ours as it does, the start of processes included.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from bars import Row, benchmark_parser, print_rows
from interleaved import interleaved
from loky import cpu_count

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.detect.many_images import detect_in_images
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.logs.records import ImageRecord, IntrinsicsRecord
from gtsam_rwhec.rig import read_rig

CELL = Path(__file__).resolve().parents[1] / "data" / "cell"
LEAST = 0.8
#: Seconds of the bare loop: as many rounds of the images as make a log worth its processes' start.
LONG_S = 45.0
#: The shipped log's boards and tags, for the bare loop.
SQUARES, SQUARE_M, MARKER_M = (7, 5), 0.041, 0.03075


class _Bare:
    """OpenCV's detectors, for one thread."""

    def __init__(self) -> None:
        tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        self.tags = cv2.aruco.ArucoDetector(tags)
        self.board = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard(SQUARES, SQUARE_M, MARKER_M, markers))

    def __call__(self, image: ImageRecord) -> int:
        """How many tags and corners of the board."""
        gray = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        _, ids, _ = self.tags.detectMarkers(gray)
        _, corners, _, _ = self.board.detectBoard(gray)
        return sum(0 if found is None else len(found) for found in (ids, corners))


def bare_loop(images: Sequence[ImageRecord], workers: int) -> int:
    """Over all images, in order or on as many threads."""
    local = threading.local()

    def look(image: ImageRecord) -> int:
        if not hasattr(local, "bare"):
            local.bare = _Bare()
        found: int = local.bare(image)
        return found

    cv2.setNumThreads(1)
    if workers == 1:
        return sum(map(look, images))
    with ThreadPoolExecutor(workers) as pool:
        return sum(pool.map(look, images))


def the_log() -> tuple[list[ImageRecord], dict[str, Camera]]:
    """Its images, and the camera of each topic."""
    rig = read_rig(CELL / "rig.yaml")
    topics = [source.images for source in rig.sensors.values() if source.images is not None]
    images: list[ImageRecord] = []
    cameras: dict[str, Camera] = {}
    with open_log(CELL / "robot_cell.mcap") as log:
        for record in log.records():
            if isinstance(record, ImageRecord) and record.topic in topics:
                images.append(record)
            elif isinstance(record, IntrinsicsRecord):
                topic = record.topic.replace("/camera_info", "/image")
                cameras[topic] = Camera.of(record.width, record.height, record.model, record.K, record.D, record.topic)
    return images, cameras


def rows(repetitions: int, bare_loop_s: float = LONG_S) -> list[Row]:
    """With one worker, and with all cores."""
    once, cameras = the_log()
    targets = read_rig(CELL / "rig.yaml").target_list
    makers = {topic: partial(Detector, camera, targets) for topic, camera in cameras.items()}
    cores = cpu_count()
    start = time.perf_counter()
    bare_loop(once, 1)
    images = once * max(1, round(bare_loop_s / (time.perf_counter() - start)))
    result = []
    for workers in sorted({1, cores}):

        def ours(count: int = workers) -> int:
            looked = detect_in_images(images, makers, workers=count)
            return sum(len(one.found.detections) for one in looked if one.found is not None)

        def bare(count: int = workers) -> int:
            return bare_loop(images, count)

        times = interleaved(repetitions, {"ours": ours, "bare": bare})
        ratio = 1.0 / times.ratio("ours", "bare")
        rate = {name: len(images) / times.median(name) / workers for name in ("ours", "bare")}
        of_cores = "one worker" if workers == 1 else f"{workers} workers"
        result.append(
            Row(
                f"OpenCV {cv2.__version__}: {len(images)} images of 640 x 480 with poses, over a bare loop, {of_cores}",
                f"{ratio:.2f}x ({rate['ours']:.1f} images a second and core; bare {rate['bare']:.1f})",
                f">= {LEAST}x",
                ratio >= LEAST,
            )
        )
    return result


def main() -> int:
    """Print the table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--repetitions", type=int, default=5)
    arguments = parser.parse_args()
    return print_rows("Images a second", rows(arguments.repetitions), store=arguments.store)


if __name__ == "__main__":
    raise SystemExit(main())
