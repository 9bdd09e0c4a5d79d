"""The sentences about why a target is not read: what was seen, with its figures, and what to write or to do."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from gtsam_rwhec.cameras.targets import FAMILIES, Checkerboard, CircleGrid, Tag, Target, is_same_print
from gtsam_rwhec.detect.clues import About, edge_blur_px
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.logs import DetectionRecord
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.sensor_detections import SensorDetections

#: A reason for rejections is a cause if it is that of at least this share of a target's detections.
MOSTLY = 0.3
_SHARPER = "Focus the lens, stand still for each image, or expose for a shorter time"


def sentence(rig: Rig, target: Target, about: About, value: object, figures: Sequence[float], looked_at: int) -> str:
    """What images show, and what to do."""
    name, of = target.name, f"{len(figures)} of {looked_at} images"
    figure = float(np.median(figures))

    def write(key: str, text: object, old: str = "") -> str:
        place = rig.source.place(("targets", name, key))
        return f"write {key}: {text}{f' in place of {old}' if old else ''} ({place})"

    match about:
        case About.COUNTS:
            assert isinstance(value, tuple)
            assert isinstance(target, (Checkerboard, CircleGrid))
            key = "inner_corners" if isinstance(target, Checkerboard) else "circles"
            things = "inner corners" if isinstance(target, Checkerboard) else "circles"
            stated = (target.columns, target.rows)
            why = ""
            if isinstance(target, Checkerboard) and stated == (value[0] + 1, value[1] + 1):
                why = " (it counts squares; inner corners are where four squares meet)"
            elif stated == value[::-1]:
                why = ": columns and rows are exchanged"
                if isinstance(target, CircleGrid) and target.larger_dot:
                    return (
                        f"{name}: {of} show a board of {value[0]} x {value[1]} circles, or its larger dot at another "
                        f"corner than the {target.corner.replace('_', ' ')}: {write(key, list(value))}, or larger_dot: "
                        f"{_beside(target.corner)}"
                    )
            return (
                f"{name}: {of} show a board of {value[0]} x {value[1]} {things}, and the rig file says {stated[0]} x "
                f"{stated[1]}{why}: {write(key, list(value))}"
            )
        case About.DOT:
            shown = f"with its larger dot at the {str(value).replace('_', ' ')}" if value else "without a larger dot"
            return f"{name}: {of} show the grid {shown}: {write('larger_dot', value or 'false')}"
        case About.FAMILY:
            family = _family_of(str(value), target)
            return f"{name}: {of} show tags of {family} and none of {target.family}: {write('family', family)}"
        case About.ID:
            return f"{name}: {of} show the tag {value} of {target.family}, and none shows {target.ids[0]}: " + write(
                "id", value
            )
        case About.BORDER:
            lines = "a single black border, which Kalibr's AprilGrids do not have" if value == 1 else "a double border"
            return (
                f"{name}: {of} show its tags with {lines}. Change the type of the target "
                f"({rig.source.place(('targets', name, 'type'))})"
            )
        case About.MARGIN:
            return (
                f"{name}: in {of} it is read once the ground around it is made lighter: a tag needs a white margin "
                "around its black square, one module wide and more. Print it with one, or put white paper behind it"
            )
        case About.SMALL:
            return (
                f"{name}: in {of} it is read only when the image is enlarged: its shortest side is about {figure:.0f} "
                "pixels long there. Go nearer, take a larger one, or images of more pixels"
            )
        case About.BLURRED:
            return (
                f"{name}: in {of} it is read only when the image is made smaller: edges are blurred by about "
                f"{figure:.1f} pixels (standard deviation; sharp ones by less than 1). {_SHARPER}"
            )
        case About.DARK:
            return (
                f"{name}: in {of} it is read only when the image is brightened: the brightest pixels have a gray value "
                f"of about {figure:.0f} of 255. More light, or a longer exposure while the robot stands still"
            )
        case About.BRIGHT:
            return (
                f"{name}: {of} are overexposed: {100.0 * figure:.0f} % of the pixels are saturated. Expose for a "
                "shorter time"
            )


def _beside(corner: str) -> str:
    """The corner to the right or to the left of a corner."""
    return corner.replace("left", "right") if "left" in corner else corner.replace("right", "left")


def _family_of(family: str, target: Target) -> str:
    """The smallest dictionary with the print of a family that has all of the target's ids."""
    same = [name for name in FAMILIES if is_same_print(name, family) and FAMILIES[name] > max(target.ids)]
    return min(same, key=lambda name: FAMILIES[name]) if same else family


def of_rejections(
    rig: Rig, target: Target, found: Mapping[str, SensorDetections], images: Mapping[str, Mapping[int, Gray]]
) -> list[str]:
    """What the rejected detections say themselves, with their figures and limits."""
    records = [(sensor, r) for sensor, of in found.items() for r in of.records if r.id == target.name]
    options, name = rig.detection_options, target.name

    def with_reason(reason: Rejection) -> list[tuple[str, DetectionRecord]]:
        those = [(sensor, r) for sensor, r in records if r.reason == reason]
        return those if len(those) >= MOSTLY * len(records) else []

    causes = []
    small = [_side_px(target, r.corners_px) for _, r in with_reason(Rejection.SMALL) if r.corners_px is not None]
    if small:
        causes.append(
            f"{name}: {len(small)} of {len(records)} detections are small: a side of about {np.median(small):.0f} "
            f"pixels, and at least {options.min_side_px:g} are wanted. Go nearer, take a larger target, or images of "
            "more pixels; or write detection: {min_side_px: ...}"
        )
    blurred = with_reason(Rejection.BLURRED)
    if blurred:
        widths = [edge_blur_px(images[s][r.stamp_ns]) for s, r in blurred if r.stamp_ns in images.get(s, {})]
        much = f": the images' edges have a blur of about {np.median(widths):.1f} pixels" if widths else ""
        causes.append(
            f"{name}: {len(blurred)} of {len(records)} detections are blurred{much}, and at most "
            f"{options.max_blur_px:g} (standard deviation) is wanted. {_SHARPER}"
        )
    off = [r.reprojection_px for _, r in with_reason(Rejection.REPROJECTION) if r.reprojection_px is not None]
    if off:
        sensors = dict.fromkeys(sensor for sensor, _ in with_reason(Rejection.REPROJECTION))
        places = "; ".join(rig.source.place(("sensors", sensor, "intrinsics")) for sensor in sensors)
        causes.append(
            f"{name}: in {len(off)} of {len(records)} detections the corners are {np.median(off):.1f} pixels off those "
            f"of a plane that this camera sees. Are the intrinsics those of these images ({places}), and is the target "
            "flat?"
        )
    layouts = Counter(r.reason for _, r in records if r.reason.startswith(Rejection.LAYOUT))
    if layouts and layouts.total() >= MOSTLY * len(records):
        reason = layouts.most_common(1)[0][0]
        causes.append(
            f"{name}: in {layouts.total()} of {len(records)} detections the {reason} "
            f"({rig.source.place(('targets', name))})"
        )
    unsure = len(with_reason(Rejection.AMBIGUOUS))
    if unsure:
        causes.append(
            f"{name}: {unsure} of {len(records)} detections are ambiguous: two of its poses look alike, and the motion "
            "does not tell which is right. Turn the carriers further between images, about different axes; look at the "
            "target obliquely and from nearer"
        )
    return causes


def of_size(rig: Rig, sensor: str, fault: str) -> str:
    """What to do where images have another size than the intrinsics are for; empty for another fault."""
    sizes = re.search(r"(\d+) x (\d+) pixels, but the intrinsics are for (\d+) x (\d+)", fault)
    if sizes is None:
        return ""
    width, height, of_width, of_height = map(int, sizes.groups())
    place = rig.source.place(("sensors", sensor, "intrinsics"))
    if abs(width * of_height - height * of_width) <= max(of_width, of_height):
        return (
            f". If these images are the whole view in another resolution, multiply fx, fy, cx and cy by "
            f"{width / of_width:.6g} and write size: [{width}, {height}]; if they were cut out, or are of another "
            f"camera, give the intrinsics of these images ({place})"
        )
    if abs(width * of_width - height * of_height) <= max(of_width, of_height):
        return (
            f". Width and height are exchanged: the images were turned by a quarter, or size is written the wrong way "
            f"round. Give images as the camera takes them, and size: [width, height] ({place})"
        )
    return f". Give the intrinsics of these images ({place}): what was cut out of an image has another centre"


def nothing_explains(targets: Sequence[Target], found: Mapping[str, SensorDetections]) -> str:
    """What is said where nothing that was tried explains why targets are not read."""
    names = [target.name for target in targets]
    tried = ["other families, ids and borders"] * any(target.ids for target in targets)
    tried += ["other numbers of columns and rows"] * any(not target.ids for target in targets)
    reasons = Counter(r.reason for of in found.values() for r in of.records if r.id in names and r.reason)
    counts = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    rejected = f" Rejected: {counts}." if reasons else ""
    them = "it" if len(targets) == 1 else "them"
    return (
        f"{', '.join(names)}: some images were searched for {them} with {' and '.join(tried)}, enlarged, brightened "
        f"and made smaller, and that did not help.{rejected} Does an image show {them}, whole and in focus?"
    )


def _side_px(target: Target, corners: np.ndarray) -> float:
    if isinstance(target, Tag):
        return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).min())
    return float(np.ptp(corners, axis=0).min())
