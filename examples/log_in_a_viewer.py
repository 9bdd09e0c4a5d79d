"""A log, calibrated; then what any MCAP viewer shows of ``calibration.mcap``: frames in their places, tags in images.

    python examples/log_in_a_viewer.py

Two fixed cameras look at a tag on a robot's hand. All that is drawn is read from the written log alone, as a viewer
does: transforms (raw and calibrated), the cameras' intrinsics, an image and its annotations.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import BLUE, GREEN, GREY, ORANGE, VERMILLION, arguments_of, save
from matplotlib.figure import Figure
from mcap.reader import make_reader

from gtsam_rwhec.detect.images import decode_gray
from gtsam_rwhec.logs import ImageRecord, TfBuffer, open_log
from gtsam_rwhec.rig import read_rig
from gtsam_rwhec.runs.run_log import read_cameras
from gtsam_rwhec.runs.whole_runs import calibrate_log

CELL = Path(__file__).resolve().parents[1] / "data" / "cell"
CAMERAS = ("cam_front", "cam_side")
AXES = (VERMILLION, GREEN, BLUE)


def annotations(path: Path, topic: str) -> dict[int, Any]:
    """foxglove.ImageAnnotations of a topic, by stamp."""
    with open(path, "rb") as stream:
        messages = make_reader(stream).iter_messages([topic])
        return {message.log_time: json.loads(message.data) for _, _, message in messages}


def main() -> None:
    """Calibrate, then draw from the log."""
    arguments = arguments_of(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        calibrated = calibrate_log(CELL / "eye_to_hand.mcap", read_rig(CELL / "eye_to_hand.yaml"), out, images="copy")
        print(calibrated.refined.solution.certificate)
        figure = draw(out / "calibration.mcap")
    save(figure, arguments.save, "log_in_a_viewer.png")


def draw(path: Path) -> Figure:
    """Frames in three dimensions at the instant of an image; that image with what was seen in it."""
    with open_log(path) as log:
        transforms = [topic.name for topic in log.topics() if topic.is_tf]
        buffer = TfBuffer(log.records(transforms))
        cameras = read_cameras(log)
        images: dict[str, list[ImageRecord]] = {name: [] for name in CAMERAS}
        for name in CAMERAS:
            images[name] = [r for r in log.records([f"/{name}/image/compressed"]) if isinstance(r, ImageRecord)]
    stamp = images[CAMERAS[0]][12].stamp_ns
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = figure.add_subplot(1, 3, 1, projection="3d")
    path_stamps = buffer.stamps("base", "hand")
    hand, _ = buffer.at("base", "hand", path_stamps)
    axes.plot(*hand[:, :3, 3].T, color=GREY, lw=0.8)
    for name in ("base", "hand", "tag_7", *CAMERAS):
        T = buffer.at("base", name, np.array([stamp]))[0][0]
        for axis, colour in zip(T[:3, :3].T, AXES, strict=True):
            axes.plot(*np.array([T[:3, 3], T[:3, 3] + 0.12 * axis]).T, color=colour, lw=2)
        axes.text(*T[:3, 3], f" {name}", fontsize=8)
        if name in cameras:
            camera = cameras[name]
            corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]]) - 0.5
            rays = np.c_[camera.undistort(corners), np.ones(4)] * 0.25 @ T[:3, :3].T + T[:3, 3]
            for start, end in zip(rays, np.roll(rays, -1, axis=0), strict=True):
                axes.plot(*np.array([start, end]).T, color="0.3", lw=0.8)
                axes.plot(*np.array([T[:3, 3], start]).T, color="0.3", lw=0.8)
    axes.set(xlabel="x of base (m)", ylabel="y (m)", zlabel="z (m)")
    axes.set_title("/tf and /calibration/tf_static", fontsize=9)
    axes.set_aspect("equal")
    for k, name in enumerate(CAMERAS):
        image = min(images[name], key=lambda record: abs(record.stamp_ns - stamp))
        panel = figure.add_subplot(1, 3, 2 + k)
        gray = decode_gray(image)
        height, width = gray.shape
        small = cv2.resize(gray, (width // 3, height // 3), interpolation=cv2.INTER_AREA)
        panel.imshow(
            small,
            interpolation="nearest",
            cmap="gray",
            vmin=0,
            vmax=255,
            extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        )
        said = annotations(path, f"/calibration/{name}/annotations").get(image.stamp_ns)
        for outline, text in zip(said["points"], said["texts"], strict=True) if said else ():
            points = np.array([[p["x"], p["y"]] for p in outline["points"]])
            panel.plot(*np.vstack([points, points[:1]]).T, color=ORANGE, lw=1.5)
            panel.text(text["position"]["x"], text["position"]["y"] - 8, text["text"], color=ORANGE, fontsize=8)
        panel.set(title=f"/{name}/image and annotations", xticks=[], yticks=[])
        panel.title.set_fontsize(9)
    return figure


if __name__ == "__main__":
    main()
