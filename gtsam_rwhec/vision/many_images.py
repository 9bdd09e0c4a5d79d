"""Detection in all images of a log, on all cores; only the few images in work are held in memory.

Threads begin at once, and work on all of a short log. They share Python's lock, and half of the work is NumPy's: in a
long log processes take over, whose start takes a second or two.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from loky import ProcessPoolExecutor, cpu_count

from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.logs.records import ImageRecord
from gtsam_rwhec.vision.detection import Detector, ImageDetections
from gtsam_rwhec.vision.images import Gray, decode_gray

#: Images that are looked at together: enough for the refinement to be cheap, few enough to hold.
BATCH = 32
#: Images that threads look at, before processes are started for the others.
FEW = 320
#: What processes find in their environment: one thread each for linear algebra, as there is one of them for each core.
_ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


@dataclass(frozen=True)
class DetectedImage:
    """One image: what was detected in it, or why nothing could be."""

    topic: str
    stamp_ns: int
    found: ImageDetections | None
    fault: str = ""


def detect_in_images(
    images: Iterable[ImageRecord],
    make_detector: Mapping[str, Callable[[], Detector]],
    *,
    workers: int | None = None,
    few: int = FEW,
    progress: Callable[[int], None] | None = None,
) -> Iterator[DetectedImage]:
    """Decode and detect.

    Parameters
    ----------
    images
        Of any of the topics, in any order; read as they are needed.
    make_detector : dict of topic to function
        Called once in each thread or process: detectors are not for several.
    workers : int, optional
        Threads or processes at work; left out, as many as there are cores for this process.
    few : int
        Beyond so many images processes take over from threads.
    progress : callable, optional
        Told how many images are done.

    Yields
    ------
    DetectedImage
        One for each image, in batches of a topic.
    """
    count = workers or cpu_count()
    local = threading.local()

    def look(batch: list[ImageRecord]) -> list[DetectedImage]:
        detectors = local.__dict__.setdefault("detectors", {})
        return _look(batch, _kept(detectors, batch[0].topic, make_detector[batch[0].topic]))

    done = 0

    def results(future: Future[list[DetectedImage]]) -> list[DetectedImage]:
        nonlocal done
        of_batch = future.result()
        done += len(of_batch)
        if progress is not None:
            progress(done)
        return of_batch

    with _quiet_on_one_thread(), ThreadPoolExecutor(count) as threads, _Processes(count) as processes:
        waiting: deque[Future[list[DetectedImage]]] = deque()
        try:
            for number, batch in enumerate(_batches(images)):
                if count > 1 and number * BATCH >= few and processes.are_ready():
                    waiting.append(processes.submit(batch, make_detector[batch[0].topic]))
                else:
                    waiting.append(threads.submit(look, batch))
                while len(waiting) > count + 1 or (waiting and waiting[0].done()):
                    yield from results(waiting.popleft())
            while waiting:
                yield from results(waiting.popleft())
        finally:
            for future in waiting:
                future.cancel()


class _Processes:
    """Started when they are first asked for; killed when what needs them ends early."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool: ProcessPoolExecutor | None = None
        self._starting: list[Future[int]] = []

    def are_ready(self) -> bool:
        """Whether they can take work at once; what imports take there goes on beside the threads' work."""
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self.count, env=_ONE_THREAD)
            self._starting = [self._pool.submit(_nothing) for _ in range(self.count)]
        return all(future.done() for future in self._starting)

    def submit(self, batch: list[ImageRecord], make_detector: Callable[[], Detector]) -> Future[list[DetectedImage]]:
        assert self._pool is not None
        future: Future[list[DetectedImage]] = self._pool.submit(_look_in_process, batch, make_detector)
        return future

    def __enter__(self) -> _Processes:
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=kind is not None or not self.are_ready())


def _nothing() -> int:
    """What a process does first: import this module."""
    return cv2.getNumThreads()


#: Of this process, which has work of one call of `detect_in_images` only.
_detectors: dict[str, Detector] = {}


def _look_in_process(batch: list[ImageRecord], make_detector: Callable[[], Detector]) -> list[DetectedImage]:
    with _quiet_on_one_thread():
        return _look(batch, _kept(_detectors, batch[0].topic, make_detector))


def _kept(detectors: dict[str, Detector], topic: str, make_detector: Callable[[], Detector]) -> Detector:
    if topic not in detectors:
        detectors[topic] = make_detector()
    return detectors[topic]


def _look(batch: list[ImageRecord], detector: Detector) -> list[DetectedImage]:
    grays: list[Gray | None] = []
    faults: list[str] = []
    wanted = detector.camera.height, detector.camera.width
    for image in batch:
        gray, fault = None, ""
        try:
            gray = decode_gray(image)
        except ImageError as error:
            fault = str(error)
        if gray is not None and gray.shape != wanted:
            fault = (
                f"topic {image.topic}, image at {image.stamp_ns} ns: {gray.shape[1]} x {gray.shape[0]} pixels, but the "
                f"intrinsics are for {wanted[1]} x {wanted[0]}"
            )
            gray = None
        grays.append(gray)
        faults.append(fault)
    found = iter(detector([gray for gray in grays if gray is not None]))
    return [
        DetectedImage(image.topic, image.stamp_ns, None if gray is None else next(found), fault)
        for image, gray, fault in zip(batch, grays, faults, strict=True)
    ]


def _batches(images: Iterable[ImageRecord]) -> Iterator[list[ImageRecord]]:
    """Up to `BATCH` images of one topic."""
    open_batches: dict[str, list[ImageRecord]] = {}
    for image in images:
        batch = open_batches.setdefault(image.topic, [])
        batch.append(image)
        if len(batch) == BATCH:
            yield open_batches.pop(image.topic)
    yield from open_batches.values()


@contextmanager
def _quiet_on_one_thread() -> Iterator[None]:
    """OpenCV's own threads would fight with ours, and faults are told by us."""
    threads, level = cv2.getNumThreads(), cv2.utils.logging.getLogLevel()
    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        cv2.utils.logging.setLogLevel(level)


def measured_corner_px(squared_px: np.ndarray, corners: np.ndarray, least_px: float = 0.02) -> float:
    """Standard deviation of a corner along each axis, from what reprojection leaves.

    Parameters
    ----------
    squared_px : (n,)
        Sums of squared errors of n poses of one target in one camera.
    corners : (n,)
        How many corners each rests on: 2 corners - 6 equations to spare.
    least_px : float
        Nothing is seen better than this, however few data say so.
    """
    spare = 2 * corners - 6
    mask = np.isfinite(squared_px) & (spare > 0)
    if not mask.any():
        return least_px
    # A few wrong ones must not count: those above six times the median are left out.
    each = squared_px[mask] / spare[mask]
    kept = each <= 6.0 * np.median(each) + 1e-12
    return max(least_px, float(np.sqrt(squared_px[mask][kept].sum() / spare[mask][kept].sum())))
