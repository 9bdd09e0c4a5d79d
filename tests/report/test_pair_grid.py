"""The grid of Figure 8."""

from __future__ import annotations

import io

from rich.console import Console

from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report import PairGrid
from gtsam_rwhec.solver.identification import Identifiability, PairIdentifiability


def grid(pairs: dict[tuple[str, str], bool]) -> PairGrid:
    """A grid of pairs that are determined on their own, or not."""
    found = {Pair(*pair): PairIdentifiability(unique, (), 2, 10, 1.0, 1.0) for pair, unique in pairs.items()}
    return PairGrid(Identifiability(True, (), 1.0, 1.0, found, ()))


def lines_of(grid: PairGrid, width: int = 80, encoding: str = "utf-8", *, color: bool = False) -> list[str]:
    """What is printed."""
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    console = Console(
        file=stream, width=width, force_terminal=color, color_system="truecolor" if color else None, highlight=False
    )
    console.print(grid)
    stream.flush()
    stream.seek(0)
    return stream.read().splitlines()


THREE_STATES = {("tag_2", "cam_0"): True, ("tag_10", "cam_0"): False, ("tag_10", "cam_1"): True}


def test_three_states_aligned_under_their_targets_in_natural_order() -> None:
    assert lines_of(grid(THREE_STATES)) == [
        "      2 10",
        "cam_0 ■  □",
        "cam_1 ·  ■",
        "Columns: targets (tag_*). Rows: sensors. The pair is",
        "■ determined by its own measurements: 2",
        "□ seen, but not determined by its own measurements: 1",
        "· not seen: 1",
    ]


def test_plain_characters_where_there_are_no_others() -> None:
    lines = lines_of(grid(THREE_STATES), encoding="ascii")
    assert lines[1:3] == ["cam_0 #  o", "cam_1 .  #"]
    assert "o seen, but not determined by its own measurements: 1" in lines


def test_colours_are_those_that_everybody_tells_apart() -> None:
    text = "\n".join(lines_of(grid(THREE_STATES), color=True))
    assert "38;2;0;114;178m■" in text  # Okabe and Ito's blue, #0072B2
    assert "38;2;213;94;0m□" in text  # and vermillion, #D55E00


def test_a_narrow_terminal_gets_several_blocks() -> None:
    pairs = {(f"tag_{j}", "cam_0"): True for j in range(40)}
    lines = lines_of(grid(pairs), width=40)
    rows = [line for line in lines if line.startswith("cam_0")]
    assert max(len(line) for line in lines if "■" in line) <= 40
    assert len(rows) > 1
    assert sum(line.count("■") for line in rows) == 40


def test_names_without_anything_in_common_are_written_out() -> None:
    lines = lines_of(grid({("door", "left"): True, ("window", "left"): False}))
    assert lines[:2] == ["     door window", "left    ■      □"]
    assert lines[2].startswith("Columns: targets. Rows: sensors.")


def test_only_whole_words_are_taken_off_names() -> None:
    lines = lines_of(grid({("board_front", "cam"): True, ("board_floor", "cam"): True}))
    assert lines[0] == "    floor front"


def test_a_sensors_own_motion_has_no_square() -> None:
    lines = lines_of(grid({("tag_0", "cam_0"): True, ("cam_0", "cam_0"): False}))
    assert lines[0] == "      tag_0"
    assert lines[-1] == "cam_0 from its own motion: not determined"


def test_nothing_but_motions() -> None:
    assert lines_of(grid({("imu", "imu"): True})) == ["imu from its own motion: determined"]


def test_no_line_is_cut() -> None:
    for width in (30, 50, 80, 200):
        text = "".join(lines_of(grid({(f"tag_{j}", "cam_0"): True for j in range(100)}), width=width))
        assert text.count("■") == 100 + 1
