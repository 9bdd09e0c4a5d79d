"""Detection in all images of a log, on all cores; memory stays that of the few images that are being looked at."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np

from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.logs.records import ImageRecord
from gtsam_rwhec.vision.detect import Detector, Seen
from gtsam_rwhec.vision.images import Gray, decode_gray

#: Images that are looked at together: enough for the refinement to be cheap, few enough to hold.
BATCH = 16


@dataclass(frozen=True)
class Looked:
    """One image: what was seen, or why it could not be looked at."""

    topic: str
    stamp_ns: int
    seen: Seen | None
    fault: str = ""


def detect_in_images(
    images: Iterable[ImageRecord],
    make_detector: Mapping[str, Callable[[], Detector]],
    *,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Looked]:
    """Decode and detect.

    Parameters
    ----------
    images
        Of any of the topics, in any order; read as they are needed.
    make_detector : dict of topic to function
        Called once in each thread: detectors are not for several.
    workers : int, optional
        Threads (OpenCV lets them run side by side); left out, as many as there are cores for this process.
    progress : callable, optional
        Told how many images are done.

    Yields
    ------
    Looked
        One for each image, in batches of a topic.
    """
    count = workers or len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1))
    local = threading.local()

    def look(batch: list[ImageRecord]) -> list[Looked]:
        detectors = local.__dict__.setdefault("detectors", {})
        topic = batch[0].topic
        if topic not in detectors:
            detectors[topic] = make_detector[topic]()
        return _look(batch, detectors[topic])

    done = 0
    with _quiet_on_one_thread(), ThreadPoolExecutor(count) as pool:
        waiting: deque[Future[list[Looked]]] = deque()
        try:
            for batch in _batches(images):
                waiting.append(pool.submit(look, batch))
                while len(waiting) > count + 1 or (waiting and waiting[0].done()):
                    results = waiting.popleft().result()
                    done += len(results)
                    if progress is not None:
                        progress(done)
                    yield from results
            while waiting:
                results = waiting.popleft().result()
                done += len(results)
                if progress is not None:
                    progress(done)
                yield from results
        finally:
            for future in waiting:
                future.cancel()


def _look(batch: list[ImageRecord], detector: Detector) -> list[Looked]:
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
        Looked(image.topic, image.stamp_ns, None if gray is None else next(found), fault)
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
