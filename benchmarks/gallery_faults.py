"""The gallery's fifteen faults: what each does to a good recording, the words that must name it, and the cure.

A fault and its good run begin with the same random numbers, and differ by the fault alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gallery_recordings as made
import numpy as np
from gallery_scene import Recording, in_motion

Make = Callable[[np.random.Generator], Recording]


@dataclass(frozen=True)
class Fault:
    """One fault of the gallery."""

    #: name, title: A word for files, and a heading.
    name: str
    title: str
    done: str  #: What is done to the data
    words: tuple[str, ...]  #: Patterns (regular expressions) that must all be in the verdict or the first paragraph
    cure: str  #: What to do about it
    #: bad, good: The recording of a generator, with the fault and without it.
    bad: Make
    good: Make


FAULTS: tuple[Fault, ...] = (
    Fault(
        "one_axis",
        "Motion about one axis only",
        "The hand turns about one fixed axis and goes up, down and sideways. It never turns about another axis.",
        (r"about one axis only",),
        "Turn the hand about a second axis, 30 degrees and more, and take ten images there.",
        made.one_axis,
        made.stations,
    ),
    Fault(
        "planar",
        "Planar motion",
        "The hand stays at one height and turns about the vertical, as a camera on a vehicle does.",
        (r"planar motion",),
        "Tilt the sensor's carrier, or state the height: a prior on the sensor or on the board.",
        made.planar,
        made.stations,
    ),
    Fault(
        "little_rotation",
        "Too little rotation",
        "The hand goes to thirty places and turns by two degrees at most.",
        (r"too little rotation",),
        "Turn the hand by 30 degrees and more about two axes.",
        made.little_rotation,
        made.stations,
    ),
    Fault(
        "board_moved",
        "The board was moved half way",
        "Somebody pushes the board by one to three centimetres, and the rest of the images show it there.",
        (r"board was at two poses", r"moved"),
        "Fix the board, and measure again; or calibrate with the images before or after the push.",
        made.board_moved,
        made.stations,
    ),
    Fault(
        "print_size",
        "Board printed to fit the page",
        'The printer\'s "fit to page" made the board 2 to 7 % smaller than the rig file says.',
        (r"size of board is|board is [\d.]+ % too large",),
        "Measure a row of squares with a caliper, and write the length of one; print with 100 %.",
        made.print_size,
        made.stations,
    ),
    Fault(
        "millimetres",
        "Poses in millimetres",
        "The controller writes positions in millimetres; the rig file does not say so.",
        (r"millimet|length: mm|\bmm\b.*\bunit|unit.*\bmm\b",),
        "Write length: mm beside the frames.",
        made.millimetres,
        made.stations,
    ),
    Fault(
        "quaternion_order",
        "Quaternions in another order",
        "The file has w, x, y, z under the names qx, qy, qz, qw.",
        (r"quaternion",),
        "Name the columns right.",
        made.quaternion_order,
        made.stations,
    ),
    Fault(
        "inverted",
        "Poses inverted",
        "The file has the base seen from the hand, and the rig file says the hand seen from the base.",
        (r"files have T_hand_base",),
        "Write frames: [hand, base].",
        made.inverted,
        made.stations,
    ),
    Fault(
        "exchanged",
        "Roles exchanged",
        "The camera is on the hand; the rig file says that it stands in the cell, and that the hand holds the board.",
        (r"exchange `sensors` and `targets`",),
        "Write sensors: hand, targets: base.",
        made.exchanged,
        made.stations,
    ),
    Fault(
        "late_clock",
        "A late clock",
        "Images are stamped 30 to 120 ms after they were taken, while the arm moves; the rig file says 0.",
        (r"clock of camera|time_offset",),
        "Write time_offset: estimate.",
        made.late_clock,
        in_motion,
    ),
    Fault(
        "loose_camera",
        "A loose camera mount",
        "The mount gives way at some moment by one to four degrees and some millimetres.",
        (r"camera was at two poses", r"mount"),
        "Tighten the mount, and measure again.",
        made.loose_camera,
        made.stations,
    ),
    Fault(
        "motion_blur",
        "Motion blur",
        "The arm does not stop, and the light is dim, and the shutter is open for 120 to 250 ms.",
        (r"blur",),
        "Stand still for each image, or expose for a shorter time with more light.",
        made.motion_blur,
        in_motion,
    ),
    Fault(
        "upside_down",
        "One image upside down",
        "One image of the folder was turned by half a turn and saved again.",
        (r"upside down",),
        "Turn it back, or take it out; look for what turned it.",
        made.upside_down,
        made.stations,
    ),
    Fault(
        "wrong_intrinsics",
        "Wrong intrinsics",
        "The stated focal length is off by 2 to 6 % and the centre by 5 to 20 pixels: another camera's calibration.",
        (r"intrinsics",),
        "Calibrate the camera at this resolution and focus, or write intrinsics: estimate.",
        made.wrong_intrinsics,
        made.stations,
    ),
    Fault(
        "bent_link",
        "An arm with a bent link",
        "A collision bent the upper arm or the forearm by one to two degrees; the controller does not know.",
        (r"\barm\b", r"configuration"),
        "Have the arm calibrated.",
        made.bent_link,
        made.reached,
    ),
)
