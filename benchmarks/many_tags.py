"""Time of the command on a log of 23 frames in which two cameras see many small tags along an inertial path.

    python benchmarks/many_tags.py [--tags 100] [--seed 0]

The path of the hand drifts as a walk of 0.01 degrees and 0.4 mm a root of a second. Detections have corners. The
command runs as a process; counted is the processor's time of all that it did, report included.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import bars
import numpy as np
import synthetic_logs as logs
from rwhec_factors import se3

BAR_S = 30.0
FRAMES, RATE_HZ, SIZE_M, APART_M = 23, 50, 0.05, 0.08
DRIFT = np.repeat([np.radians(0.01), 4e-4], 3) / np.sqrt(RATE_HZ)
#: Noise of a pose by a driver, rad and m; of a corner, pixels.
OF_POSE, OF_CORNER_PX = np.repeat([np.radians(0.5), 2e-3], 3), 0.1
SQUARE = 0.5 * SIZE_M * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
RIG = """\
carriers:
  sensors: hand
  targets: base
  poses: {tf: [base, hand]}
sensors:
  cam_0: {detections: /cam_0/tags, intrinsics: {topic: /cam_0/camera_info}}
  cam_1: {detections: /cam_1/tags, intrinsics: {topic: /cam_1/camera_info}}
sizes: known
noise: estimate
targets:
"""


def written(folder: Path, tags: int, seed: int) -> int:
    """Write log.mcap and rig.yaml; the number of detections."""
    rng, across = np.random.default_rng(seed), round(np.sqrt(tags))
    places = APART_M * (np.stack(np.divmod(np.arange(tags), across), axis=1) - (across - 1) / 2.0)
    X = [logs.pose(rng.normal(0.0, 3.0, 3), (*place, rng.normal(0.0, 5e-3))) for place in places]
    messages, drift, count = [logs.camera_info(camera) for camera in logs.CAMERAS], np.eye(4), 0
    for step in range((FRAMES + 1) * RATE_HZ + 1):
        stamp_ns = logs.BEGIN_NS + step * 10**9 // RATE_HZ
        messages.append(logs.transform(stamp_ns, "base", "hand", logs.hand(step / RATE_HZ) @ drift))
        drift = drift @ se3.expmap(rng.normal(size=(1, 6)) * DRIFT)[0]
    for camera in logs.CAMERAS:
        for second in range(1, FRAMES + 1):
            seen = []
            for number, of_tag in enumerate(X):
                T = np.linalg.inv(logs.hand(second) @ logs.Y[camera]) @ of_tag
                P = SQUARE @ T[:3, :3].T + T[:3, 3]
                px = logs.FOCAL * P[:, :2] / P[:, 2:] + (0.5 * logs.WIDTH, 0.5 * logs.HEIGHT)
                if ((px > 5.0) & (px < (logs.WIDTH - 5.0, logs.HEIGHT - 5.0))).all():
                    T, px = T @ se3.expmap(rng.normal(size=(1, 6)) * OF_POSE)[0], rng.normal(px, OF_CORNER_PX)
                    seen.append(logs.tag(number, T, size_m=SIZE_M, corners_px=px))
            count += len(seen)
            messages.append(logs.detections(f"/{camera}/tags", logs.BEGIN_NS + second * 10**9, camera, seen))
    logs.write(folder / "log.mcap", sorted(messages, key=lambda message: message.logged_ns))
    kind = f"type: tag, family: tag36h11, size_m: {SIZE_M}"
    (folder / "rig.yaml").write_text(RIG + "".join(f"  tag_{i}: {{{kind}, id: {i}}}\n" for i in range(tags)))
    return count


def rows(tags: int, seed: int) -> list[bars.Row]:
    """The figures of one log."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        count, out = written(folder, tags, seed), folder / "out"
        command = [sys.executable, "-m", "gtsam_rwhec", "calibrate", str(folder / "log.mcap"), "-o", str(out)]
        done = subprocess.run(
            [*command, "--rig", str(folder / "rig.yaml")], capture_output=True, text=True, check=False
        )
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        is_whole = (out / "report.html").is_file()
        if not is_whole:
            print(done.stdout, done.stderr)
        return [
            bars.Row("detections with corners", str(count)),
            bars.at_most("the processor's time", used.ru_utime + used.ru_stime, BAR_S, " s"),
            bars.Row("memory", f"{used.ru_maxrss / 1e6:.2f} GB"),
            bars.Row("report", "written" if is_whole else "none", "written", is_whole),
        ]


if __name__ == "__main__":
    bars.run_script("A wall of tags", rows, tags=100, seed=0)
