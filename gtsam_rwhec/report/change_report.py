"""What changed between two calibrations, on the terminal: the verdict, a table, and what to keep in mind."""

from __future__ import annotations

from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.printing import print_heading, print_list, print_sentence, print_tables, report_console
from gtsam_rwhec.results.change_test import ChangeTest
from gtsam_rwhec.results.common_quantities import Movement
from gtsam_rwhec.results.difference import Difference, share_words

MOVED_HEADINGS = ("mm", "°", "deviations", "chance", "changed")
NUMBER_HEADINGS = ("old", "new", "deviations", "chance", "changed")
CHANGE_LEGEND = (
    "deviations: joint (Mahalanobis) deviations of the difference, correlations counted. chance: how often a "
    "difference is so large without a change, corrected for the number of lines."
)
#: Green where nothing changed, red where something did, yellow where nothing was tested.
STYLES = {False: "bold green", True: "bold red", None: "bold yellow"}


def print_difference(found: Difference) -> None:
    """Print what changed: the verdict first, then how every frame moved, then remarks."""
    console = report_console()
    tested = None if found.test is None and not found.is_same else found.has_changed
    print_sentence(console, str(found), STYLES[tested])
    console.print()
    if not found.is_same:
        print_tables(console, change_tables(found), CHANGE_LEGEND if found.test is not None else "")
    words = list(remark_sentences(found))
    if words:
        print_heading(console, "Keep in mind")
        print_list(console, words)


def change_tables(found: Difference) -> tuple[FrameTable, FrameTable]:
    """How every frame moved, and how every number changed."""
    frames = {name: moved_cells(moved, found.test, name) for name, moved in found.movements.items()}
    numbers = {
        one.name: (f"{one.old:.7g}", f"{one.new:.7g}", *_test_cells(found.test, group))
        for group, ones in found.numbers.items()
        for one in ones
    }
    return (
        FrameTable("From OLD to NEW, in each frame's own axes", "frame", MOVED_HEADINGS, frames),
        FrameTable(
            "Other numbers that both estimated (the intrinsics of a camera are tested together)",
            "number",
            NUMBER_HEADINGS,
            numbers,
        ),
    )


def moved_cells(moved: Movement, test: ChangeTest | None, name: str) -> tuple[str, ...]:
    """The cells of a frame under ``MOVED_HEADINGS``."""
    return f"{moved.translation_mm:.3f}", f"{moved.rotation_deg:.4f}", *_test_cells(test, name)


def remark_sentences(found: Difference) -> list[str]:
    """What to keep in mind."""
    words = [f"Not tested: {name}, because {why}." for name, why in found.not_compared.items()]
    test = found.test
    if test is not None:
        words.append(
            f"All {test.dimension} compared directions together: {test.deviations:.1f} joint deviations, as much "
            f"without a change in {share_words(test.joint_chance)}."
        )
    return [*words, *(f"{remark[0].upper()}{remark[1:].removesuffix('.')}." for remark in found.remarks)]


def _test_cells(test: ChangeTest | None, name: str) -> tuple[str, str, str]:
    if test is None or name not in test.groups or not test.groups[name].dimension:
        return "-", "-", "not tested"
    group = test.groups[name]
    chance = "< 0.0001" if group.corrected < 1e-4 else rounded(group.corrected)
    return f"{group.deviations:.1f}", chance, "yes" if name in test.changed else "no"
