"""Answers on data, and detections in the first images of the shipped log, into a file of arrays.

    python tests/answers_on_these_cores.py FOLDER OUT.npz [--cores 1] [--workers 2]

Run as a process of its own, as BLAS takes its number of threads from the environment when it is loaded.
"""

from __future__ import annotations

import argparse
import os
import warnings
from collections import Counter
from functools import partial

import numpy as np
from places import CELL

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.detect.many_images import detect_in_images
from gtsam_rwhec.errors import RwhecWarning
from gtsam_rwhec.logs import ImageRecord, IntrinsicsRecord, open_log
from gtsam_rwhec.rig import read_rig

IMAGES = 6


def answers(folder: str) -> dict[str, np.ndarray]:
    """Poses, costs, bounds and covariances, by solve and refine in turn."""
    problem = rw.read_csv(folder, scale="shared", sigma=0.005, kappa=6500.0)
    solution = rw.solve(problem)
    found: dict[str, np.ndarray] = {"status": np.array(str(solution.certificate.status))}
    found["solve: bound"] = np.array([solution.cost, solution.certificate.lower_bound])
    refined = rw.refine(problem, solution, rw.RefineOptions(noise="estimate"))
    found["refine: cost"] = np.array(refined.cost)
    found["refine: covariances"] = np.array([refined.covariance(name) for name in problem.sensors])
    for stage, answer in (("solve", solution), ("refine", refined)):
        frames = answer.X | answer.Y
        found[f"{stage}: poses"] = np.array([frames[name].matrix() for name in sorted(frames)])
    return found


def detections(workers: int) -> dict[str, np.ndarray]:
    """Poses and covariances in a few images of each camera, by topic, stamp and target."""
    rig = read_rig(CELL / "rig.yaml")
    images, cameras = [], {}
    count: Counter[str] = Counter()
    with open_log(CELL / "robot_cell.mcap") as log:
        for record in log.records():
            if isinstance(record, ImageRecord) and count[record.topic] < IMAGES:
                count[record.topic] += 1
                images.append(record)
            elif isinstance(record, IntrinsicsRecord):
                of = Camera.of(record.width, record.height, record.model, record.K, record.D, record.topic)
                cameras[record.topic.replace("/camera_info", "/image")] = of
    makers = {topic: partial(Detector, camera, rig.target_list) for topic, camera in cameras.items()}
    looked = list(detect_in_images(images, makers, workers=workers))
    rows = [
        (f"{one.topic} {one.stamp_ns} {detection.target} {k}", detection)
        for one in looked
        if one.found is not None
        for k, detection in enumerate(one.found.detections)
    ]
    rows.sort(key=lambda row: row[0])
    return {
        "detections: names": np.array([name for name, _ in rows]),
        "detections: poses": np.array([detection.T for _, detection in rows]),
        "detections: covariances": np.array([detection.covariance for _, detection in rows]),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("out")
    parser.add_argument("--cores", type=int)
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.cores is not None:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.cores])
    warnings.simplefilter("ignore", RwhecWarning)
    np.savez(arguments.out, **answers(arguments.folder), **detections(arguments.workers))
