"""Folders of CSV files: the two files of one pair, with a line ``----`` between them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from harness import Harness, scratch
from mutations import words_and_lines

from gtsam_rwhec.problem import csv_folder, problem

BETWEEN = b"\n----\n"
FOLDER = scratch()
DEMO = Path(__file__).resolve().parents[2] / "data" / "demo"


def read(data: bytes) -> None:
    """Both files, then the problem that they make; its moments are what everything after reads."""
    first, _, second = data.partition(BETWEEN)
    (FOLDER / "tag_0_cam_0_A.csv").write_bytes(first)
    (FOLDER / "tag_0_cam_0_B.csv").write_bytes(second or first)
    made: problem.Problem = csv_folder.read_csv(FOLDER)
    str(made)


def seeds() -> Iterable[bytes]:
    """The smallest pair of the demo, and ways of writing numbers."""
    yield (DEMO / "tag_2_cam_2_A.csv").read_bytes() + BETWEEN + (DEMO / "tag_2_cam_2_B.csv").read_bytes()
    yield b"1,0,0,0,1,2,3\n0.6,0,0.8,0,-1e-3,2.5,+3\r\n" * 3
    yield b"\xef\xbb\xbf1, 0 ,0,0, .5, 1. ,1e5\n" + BETWEEN + b"1,0,0,0,1,2,3\n\n"


HARNESS = Harness(read, seeds, words_and_lines)
