"""Names of cameras and frames in a first rig file, made of topics, paths and frames of the data."""

from __future__ import annotations

from gtsam_rwhec.rig.field_types import is_name

#: These words in names of topics say what is published, and not by which camera.
COMMON = frozenset({
    "image", "image_raw", "image_color", "image_mono", "image_rect", "image_rect_color", "image_rect_raw", "compressed",
    "raw", "color", "colour", "rgb", "detections", "tag_detections", "apriltag_detections", "detection", "tags",
    "apriltag", "apriltags", "aruco", "aruco_markers", "aruco_detections", "markers", "marker_publisher",
    "images", "img", "imgs", "pictures", "data", ".",
})  # fmt: skip


def frame_name(text: str) -> str:
    """A valid frame name made from a text: characters that are not allowed become _; empty if none is left."""
    words = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in text)[:60].strip("_")
    return words if is_name(words) else (f"f_{words}" if words else "")


def camera_name(topic: str, frame: str) -> str:
    """Name a camera by the words of its topic or path that are not common, or else by its frame."""
    words = [word for word in topic.split("/") if word.lower() not in COMMON]
    return frame_name("_".join(words)) or frame_name(frame) or "camera"


def free_name(name: str, taken: set[str]) -> str:
    """Return the name, with a number added if it is taken. It is taken from now on."""
    numbered = (f"{name}_{number}" for number in range(2, len(taken) + 3))
    free = next(candidate for candidate in (name, *numbered) if candidate not in taken)
    taken.add(free)
    return free
