"""What files for other programs say of a camera: where its intrinsics are from, and why a format cannot have it."""

from __future__ import annotations

from collections.abc import Iterable

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.export.written_poses import number
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.rig.rig_frames import RigFrames

#: A remark in a file has at most this many characters.
LONGEST_COMMENT = 2_000
#: Of intrinsics that nothing was estimated of.
AS_STATED = "as stated"
NOT_KNOWN = "whose intrinsics are not known."


def comment(remark: str) -> str:
    """A remark on one line: names in it come from a log, and a line break would end the comment."""
    return shown(remark, LONGEST_COMMENT)


def origin(frames: RigFrames, name: str) -> str:
    """Where a camera's intrinsics are from."""
    return comment(f"intrinsics {frames.camera_origins.get(name, AS_STATED)}")


def lacks(camera: Camera, program: str) -> str:
    """That a program has no model for a camera's lens."""
    return f"whose lens model ({camera.model}, {len(camera.D)} coefficients) {program} lacks."


def sorted_out(reasons: dict[str, str]) -> tuple[list[str], str]:
    """The sensors without a reason to be left out; and a comment that names the others with their reasons."""
    kept = [name for name, reason in reasons.items() if not reason]
    return kept, "".join(f"# Left out: {name}, {reason}\n" for name, reason in reasons.items() if reason)


def plain_names(names: Iterable[str]) -> dict[str, str]:
    """For each name one of letters, digits and _, no two of which differ in capitals alone."""
    plain: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        wanted = base = name.replace("/", "_")
        count = 1
        while wanted.casefold() in taken:
            count += 1
            wanted = f"{base}_{count}"
        taken.add(wanted.casefold())
        plain[name] = wanted
    return plain


def row(values: Iterable[float]) -> str:
    """Numbers as a list of YAML."""
    return f"[{', '.join(number(value) for value in values)}]"
