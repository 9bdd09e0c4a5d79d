"""Whole logs of images: equal results on any number of cores, reported faults, and little memory."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import BARREL, PINHOLE, pose, printed, render

from gtsam_rwhec.cameras.targets import Tag
from gtsam_rwhec.detect.detector import Detector, ImageDetections
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.many_images import BATCH, DetectedImage, detect_in_images, measured_corner_px
from gtsam_rwhec.logs.records import ImageRecord

TAG = Tag("tag", "tag36h11", 7, 0.08)
CAMERAS = {"/left": PINHOLE, "/right": BARREL}
MAKERS: dict[str, Callable[[], Detector]] = {
    topic: (lambda camera=camera: Detector(camera, [TAG])) for topic, camera in CAMERAS.items()
}


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def record(topic: str, stamp_ns: int, data: bytes) -> ImageRecord:
    return ImageRecord(stamp_ns, stamp_ns, topic, "cam", "png", data)


@pytest.fixture(scope="module")
def images() -> list[ImageRecord]:
    """Two topics in turns with different numbers of images; a few views repeat."""
    views = {
        topic: [
            png(render(camera, [(printed(TAG), pose((15.0, tilt, 0.0), (0.0, 0.0, 0.3)))], seed=int(tilt)))
            for tilt in (0.0, 20.0, 40.0)
        ]
        for topic, camera in CAMERAS.items()
    }
    return [
        record("/left" if k % 3 else "/right", 1000 * k, views["/left" if k % 3 else "/right"][k % 7 % 3])
        for k in range(3 * BATCH)
    ]


def by_image(looked: Iterator[DetectedImage]) -> dict[tuple[str, int], DetectedImage]:
    found = {}
    for one in looked:
        assert (one.topic, one.stamp_ns) not in found
        found[one.topic, one.stamp_ns] = one
    return found


def assert_same(a: dict[tuple[str, int], DetectedImage], b: dict[tuple[str, int], DetectedImage]) -> None:
    assert a.keys() == b.keys()
    for key, one in a.items():
        other = b[key]
        assert one.fault == other.fault
        if one.found is None or other.found is None:
            assert one.found is other.found
            continue
        assert one.found.strangers == other.found.strangers
        for x, y in zip(one.found.detections, other.found.detections, strict=True):
            assert (x.target, x.rejection) == (y.target, y.rejection)
            np.testing.assert_allclose(x.corners_px, y.corners_px, atol=1e-9)
            np.testing.assert_allclose(x.T, y.T, atol=1e-6)
            np.testing.assert_allclose(x.covariance, y.covariance, rtol=1e-4, atol=1e-15)


def test_the_same_on_any_number_of_cores_and_in_any_order(images: list[ImageRecord]) -> None:
    one = by_image(detect_in_images(images, MAKERS, workers=1))
    assert len(one) == len(images)
    assert all(looked.found is not None and len(looked.found.detections) == 1 for looked in one.values())
    assert_same(one, by_image(detect_in_images(images, MAKERS, workers=3)))
    assert_same(one, by_image(detect_in_images(iter(images[::-1]), MAKERS)))


class FailsOnDark(Detector):
    """Fails as NumPy and OpenCV do, on each image that begins with a black pixel."""

    def __call__(self, images: Sequence[Gray]) -> list[ImageDetections]:
        for gray in images:
            if gray[0, 0] == 0:
                cv2.resize(gray[:0], (0, 0))  # raises cv2.error
        return super().__call__(images)


def test_an_image_on_which_the_detection_fails_costs_itself_only(images: list[ImageRecord]) -> None:
    bad = [record("/left", stamp, png(np.zeros((240, 320), np.uint8))) for stamp in (5, 7)]
    makers = {topic: (lambda camera=camera: FailsOnDark(camera, [TAG])) for topic, camera in CAMERAS.items()}
    found = by_image(detect_in_images([*images[:10], *bad, *images[10:20]], makers, workers=1))
    faults = {key: found.pop(key).fault for key in (("/left", 5), ("/left", 7))}
    assert "topic /left, image at 7 ns: the detection failed (error: OpenCV" in faults["/left", 7]
    assert faults["/left", 5].startswith("topic /left, image at 5 ns: the detection failed")
    assert_same(found, by_image(detect_in_images(images[:20], MAKERS, workers=1)))


def test_faults_are_reported_and_the_other_images_are_used(images: list[ImageRecord]) -> None:
    good = [image for image in images if image.topic == "/left"][:3]
    broken = record("/left", 5, b"no image")
    large = record("/left", 7, png(np.zeros((480, 640), np.uint8)))
    padded = ImageRecord(9, 9, "/left", "cam", "mono9", bytes(10), 5, 2, 5)
    found = by_image(detect_in_images([good[0], broken, good[1], large, padded, good[2]], MAKERS, workers=1))
    assert "topic /left, image at 5 ns: 8 bytes that begin with 6e6f20" in found["/left", 5].fault
    said = "topic /left, image at 7 ns: 640 x 480 pixels, but the intrinsics are for 320 x 240: it is of another camera"
    assert said in found["/left", 7].fault
    assert "'mono9' is not supported" in found["/left", 9].fault
    assert all(found["/left", stamp].found is None for stamp in (5, 7, 9))
    for image in good:
        one = found["/left", image.stamp_ns]
        assert one.fault == ""
        assert one.found is not None
        assert [d.target for d in one.found.detections] == ["tag"]


def test_images_are_read_only_when_they_are_needed() -> None:
    empty = png(np.zeros((240, 320), np.uint8))
    read, furthest = 0, 0

    def log(count: int, *topics: str) -> Iterator[ImageRecord]:
        nonlocal read
        for k in range(count):
            read += 1
            yield record(topics[k % len(topics)], k, empty)

    for done, _ in enumerate(detect_in_images(log(12 * BATCH, "/left", "/right"), MAKERS, workers=1)):
        furthest = max(furthest, read - done)
    assert read == 12 * BATCH
    # Two workers' batches wait or are looked at, and one of each topic is being filled.
    assert furthest <= 6 * BATCH
    read = 0
    looked = detect_in_images(log(1000, "/left"), MAKERS, workers=1)
    next(looked)
    looked.close()
    assert read <= 4 * BATCH


def test_processes_detect_what_threads_detect(images: list[ImageRecord]) -> None:
    with_faults = [*images, record("/left", 1, b"no image"), record("/right", 2, png(np.zeros((5, 5), np.uint8)))]
    told: list[int] = []
    by_threads = by_image(detect_in_images(with_faults, MAKERS, workers=2))
    by_processes = detect_in_images(with_faults, MAKERS, workers=2, few=BATCH, progress=told.append)
    assert_same(by_threads, by_image(by_processes))
    assert told[-1] == len(with_faults)


def test_processes_end_with_the_caller(images: list[ImageRecord]) -> None:
    def processes() -> list[str]:
        found = subprocess.run(["pgrep", "-P", str(os.getpid()), "-f", "loky.*popen"], capture_output=True, text=True)
        return found.stdout.split()

    looked = detect_in_images(images * 10, MAKERS, workers=2, few=0)
    next(looked)
    assert len(processes()) == 2
    looked.close()
    assert processes() == []


def test_a_script_needs_no_main_guard(tmp_path: Path, images: list[ImageRecord]) -> None:
    """Python's own processes would run the caller's script again."""
    (tmp_path / "image.png").write_bytes(images[1].data)
    script = tmp_path / "script.py"
    script.write_text(
        "from functools import partial\n"
        "from pathlib import Path\n"
        "from gtsam_rwhec.logs.records import ImageRecord\n"
        "from gtsam_rwhec.cameras.camera import Camera\n"
        "from gtsam_rwhec.detect.detector import Detector\n"
        "from gtsam_rwhec.detect.many_images import detect_in_images\n"
        "from gtsam_rwhec.cameras.targets import Tag\n"
        "print('begins')\n"
        f"camera = Camera.of(320, 240, '{PINHOLE.model}', {PINHOLE.K.tolist()}, [], 'the script')\n"
        "data = (Path(__file__).parent / 'image.png').read_bytes()\n"
        "images = [ImageRecord(k, k, '/left', 'cam', 'png', data) for k in range(40)]\n"
        f"make = {{'/left': partial(Detector, camera, [Tag('tag', 'tag36h11', {TAG.id}, 0.08)])}}\n"
        "print(sum(len(one.found.detections) for one in detect_in_images(images, make, workers=2, few=0)))\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False)
    assert (done.stdout, done.stderr) == ("begins\n40\n", "")


def test_an_error_while_reading_reaches_the_caller() -> None:
    def log() -> Iterator[ImageRecord]:
        yield record("/left", 0, b"")
        raise OSError("the disk is gone")

    with pytest.raises(OSError, match="the disk is gone"):
        list(detect_in_images(log(), MAKERS, workers=1))


def test_progress_and_order(images: list[ImageRecord]) -> None:
    told: list[int] = []
    looked = list(detect_in_images(images, MAKERS, workers=2, progress=told.append))
    assert told == sorted(set(told))
    assert told[-1] == len(images)
    assert len(told) >= 3
    for topic in CAMERAS:
        stamps = [one.stamp_ns for one in looked if one.topic == topic]
        assert stamps == sorted(stamps)
    assert list(detect_in_images([], MAKERS)) == []


def test_opencv_gets_its_threads_and_log_level_back(images: list[ImageRecord]) -> None:
    before = cv2.getNumThreads(), cv2.utils.logging.getLogLevel()
    looked = detect_in_images(images[:2], MAKERS)
    next(looked)
    looked.close()
    assert (cv2.getNumThreads(), cv2.utils.logging.getLogLevel()) == before


def test_opencv_prints_nothing_about_broken_images(
    capfd: pytest.CaptureFixture[str], images: list[ImageRecord]
) -> None:
    broken = [record("/left", k, images[1].data[: -40 - k]) for k in range(3)]
    for ending in (".jpg", ".bmp", ".tiff", ".jp2"):
        data = cv2.imencode(ending, np.zeros((240, 320), np.uint8))[1].tobytes()
        broken.append(record("/left", 1000 + len(broken), data[: len(data) // 2]))
    found = list(detect_in_images(broken, MAKERS))
    assert all(one.fault for one in found)
    assert capfd.readouterr().err == ""


def test_measured_corner_noise() -> None:
    generator = np.random.default_rng(0)
    corners = np.repeat([4, 24], 200)
    squared = 0.3**2 * generator.chisquare(2 * corners - 6)
    assert measured_corner_px(squared, corners) == pytest.approx(0.3, rel=0.05)
    # A few that are not the target's.
    squared[::25] = 500.0
    assert measured_corner_px(squared, corners) == pytest.approx(0.3, rel=0.15)
    squared[1::25] = np.nan
    assert measured_corner_px(squared, corners) == pytest.approx(0.3, rel=0.15)


@pytest.mark.parametrize(("corners", "rel"), [(4, 0.1), (24, 0.02)])
def test_measured_corner_noise_of_one_kind_of_target(corners: int, rel: float) -> None:
    for seed in range(3):
        squared = 0.2**2 * np.random.default_rng(seed).chisquare(2 * corners - 6, 400)
        assert measured_corner_px(squared, np.full(400, corners)) == pytest.approx(0.2, rel=rel)
