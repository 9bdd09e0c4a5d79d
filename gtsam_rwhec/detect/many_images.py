"""Detection in all images of a log, on all cores; memory holds only the few images in work.

Threads start at once, and do all the work of a short log. They share Python's lock, and half of the work is NumPy's:
in a long log processes take over, which need a second or two to start.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from loky import ProcessPoolExecutor, cpu_count

from gtsam_rwhec.cameras.camera import MOST_PIXELS, Camera
from gtsam_rwhec.detect.detector import Detector, ImageDetections
from gtsam_rwhec.detect.images import Gray, decode_gray, stated_size
from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.files.budgets import PIXELS_TOGETHER
from gtsam_rwhec.logs.records import ImageRecord

#: A batch has this number of images: enough to make their common refinement cheap, and few enough for the memory.
BATCH = 32
#: The threads take this number of images before processes take over the others.
FEW = 320
#: Errors of OpenCV's or of our arithmetic on the pixels of one image. They cost this image, and no other.
OF_ONE_IMAGE = (cv2.error, ArithmeticError, LookupError, ValueError)
#: With this environment, linear algebra uses one thread in each process, since each core has its process.
ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


@dataclass(frozen=True)
class DetectedImage:
    """One image with its detections, or with the fault that prevented detection."""

    topic: str
    stamp_ns: int
    found: ImageDetections | None
    fault: str = ""
    logged_ns: int = 0  #: its log time, by which it is found again


class Kept(Protocol):
    """Detections that are kept batch by batch, so that an interrupted run goes on from them.

    The images of a batch are the same whatever was kept, and they are detected together or not at all: so a run that
    was interrupted finds the same as one that was not, to the last bit.
    """

    def known(self, number: int, batch: Sequence[ImageRecord]) -> list[DetectedImage] | None:
        """What was found in the batch of this number; None if it is not known."""

    def keep(self, number: int, found: list[DetectedImage]) -> None:
        """Keep what was found in the batch of this number."""


def detect_in_images(
    images: Iterable[ImageRecord],
    make_detector: Mapping[str, Callable[[], Detector]],
    *,
    workers: int | None = None,
    few: int = FEW,
    kept: Kept | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[DetectedImage]:
    """Decode images and detect targets in them.

    Parameters
    ----------
    images
        Images of these topics, in any order; read when they are needed.
    make_detector : dict of topic to function
        Called once in each thread or process, since two threads must not use one detector.
    workers : int, optional
        Number of threads or processes; by default the number of cores that this process may use.
    few : int
        After this many images processes take over from threads.
    kept : Kept, optional
        Batches that it knows are not decoded again, and every other is given to it.
    progress : callable, optional
        Called with the number of images that are done, with those that were known, after each new batch.

    Yields
    ------
    DetectedImage
        One for each image, in batches of a topic.
    """
    count = workers or cpu_count()
    done = submitted = 0

    def results(number: int, future: Future[list[DetectedImage]], is_new: bool) -> list[DetectedImage]:
        nonlocal done
        of_batch = future.result()
        done += len(of_batch)
        if is_new and kept is not None:
            kept.keep(number, of_batch)
        if is_new and progress is not None:
            progress(done)
        return of_batch

    with _opencv_as_before(), ThreadPoolExecutor(count) as threads, _Processes(count) as processes:
        quiet_on_one_thread()
        waiting: deque[tuple[int, Future[list[DetectedImage]], bool]] = deque()
        try:
            for number, batch in enumerate(_batches(images)):
                known = None if kept is None else kept.known(number, batch)
                if known is not None:
                    waiting.append((number, _finished(known), False))
                else:
                    if count > 1 and submitted >= few and processes.are_ready():
                        future = processes.submit(batch, make_detector[batch[0].topic])
                    else:
                        future = threads.submit(look, batch, make_detector[batch[0].topic])
                    waiting.append((number, future, True))
                    submitted += len(batch)
                while len(waiting) > count + 1 or (waiting and waiting[0][1].done()):
                    yield from results(*waiting.popleft())
            while waiting:
                yield from results(*waiting.popleft())
        finally:
            for _, future, _ in waiting:
                future.cancel()


def _finished(known: list[DetectedImage]) -> Future[list[DetectedImage]]:
    """A future that has its result: known batches keep their places among the others."""
    future: Future[list[DetectedImage]] = Future()
    future.set_result(known)
    return future


class _Processes(AbstractContextManager["_Processes"]):
    """Processes that start when they are first asked for, and are killed when the detection ends early."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool: ProcessPoolExecutor | None = None
        self._starting: list[Future[int]] = []

    def are_ready(self) -> bool:
        """Whether the processes can take work at once. They start, and import, while the threads work."""
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self.count, env=ONE_THREAD, initializer=quiet_on_one_thread)
            self._starting = [self._pool.submit(int) for _ in range(self.count)]
        return all(future.done() for future in self._starting)

    def submit(self, batch: list[ImageRecord], make_detector: Callable[[], Detector]) -> Future[list[DetectedImage]]:
        assert self._pool is not None
        future: Future[list[DetectedImage]] = self._pool.submit(look, batch, make_detector)
        return future

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=kind is not None or not self.are_ready())


#: Each thread keeps its detectors here, by topic. A thread or process works for one call of `detect_in_images` only.
_of_thread = threading.local()


def look(batch: list[ImageRecord], make_detector: Callable[[], Detector]) -> list[DetectedImage]:
    """Detect in images of one topic, with a detector of this thread."""
    detectors: dict[str, Detector] = _of_thread.__dict__.setdefault("detectors", {})
    topic = batch[0].topic
    if topic not in detectors:
        detectors[topic] = make_detector()
    camera = detectors[topic].camera
    decoded = [_decoded(image, camera) for image in batch]
    whole = [(image, gray) for image, gray in zip(batch, decoded, strict=True) if not isinstance(gray, str)]
    found = iter(_detected(detectors[topic], whole))
    results = [gray if isinstance(gray, str) else next(found) for gray in decoded]
    return [
        DetectedImage(image.topic, image.stamp_ns, None, result, image.logged_ns)
        if isinstance(result, str)
        else DetectedImage(image.topic, image.stamp_ns, result, "", image.logged_ns)
        for image, result in zip(batch, results, strict=True)
    ]


def _detected(detector: Detector, images: list[tuple[ImageRecord, Gray]]) -> list[ImageDetections | str]:
    """The detections in each image, or the fault of an image on which the detection fails; the others lose nothing."""
    try:
        return list(detector([gray for _, gray in images]))
    except OF_ONE_IMAGE as error:
        if len(images) > 1:
            return [result for one in images for result in _detected(detector, [one])]
        where = f"topic {images[0][0].topic}, image at {images[0][0].stamp_ns} ns"
        message = " ".join(str(error).split())
        return [f"{where}: the detection failed ({type(error).__name__}: {message})"]


def _decoded(image: ImageRecord, camera: Camera) -> Gray | str:
    """The pixels of an image, or the fault that it has."""
    try:
        return decode_gray(image, (camera.width, camera.height))
    except ImageError as error:
        return str(error)


def _batches(images: Iterable[ImageRecord]) -> Iterator[list[ImageRecord]]:
    """Batches of up to `BATCH` images of one topic; fewer of large images, as their pixels are in memory together."""
    open_batches: dict[str, list[ImageRecord]] = {}
    pixels: Counter[str] = Counter()
    for image in images:
        batch = open_batches.setdefault(image.topic, [])
        batch.append(image)
        pixels[image.topic] += _pixels(image)
        if len(batch) == BATCH or pixels[image.topic] >= PIXELS_TOGETHER:
            del pixels[image.topic]
            yield open_batches.pop(image.topic)
    yield from open_batches.values()


def _pixels(image: ImageRecord) -> int:
    """How many pixels an image states, and at most as many as are decoded."""
    width, height = stated_size(image.data) or (0, 0) if image.is_compressed else (image.width or 0, image.height or 0)
    return min(width * height, MOST_PIXELS)


@contextmanager
def _opencv_as_before() -> Iterator[None]:
    """Give OpenCV its number of threads and its log level back."""
    threads, level = cv2.getNumThreads(), cv2.utils.logging.getLogLevel()
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        cv2.utils.logging.setLogLevel(level)


def quiet_on_one_thread() -> None:
    """Let OpenCV use one thread, since each core has one of ours, and print nothing: we report the faults."""
    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


#: Pixels: a corner is known no better, whatever few reprojection errors say.
LEAST_PX = 0.02


def measured_corner_px(squared_px: np.ndarray, corners: np.ndarray) -> float:
    """Standard deviation of a corner along each axis, from reprojection errors.

    `squared_px` (n,) are sums of squared errors of n poses of one target in one camera, px^2; a pose of `corners` (n,)
    corners has 2 corners - 6 degrees of freedom. The result is at least `LEAST_PX`, since few data can give a value
    that is too small.
    """
    freedom = 2 * corners - 6
    mask = np.isfinite(squared_px) & (freedom > 0)
    if not mask.any():
        return LEAST_PX
    # A few wrong poses must not count: poses above six times the median are left out.
    each = squared_px[mask] / freedom[mask]
    kept = each <= 6.0 * np.median(each) + 1e-12
    return max(LEAST_PX, float(np.sqrt(squared_px[mask][kept].sum() / freedom[mask][kept].sum())))
