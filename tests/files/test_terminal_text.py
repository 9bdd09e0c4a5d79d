"""Text of strangers: escaped, on its lines, and cut with its length said."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.files.terminal_text import LONGEST, LONGEST_NAME, brief, printable, rounded, shown

HOSTILE = {
    "\x1b[31mred\x1b[0m": r"\x1b[31mred\x1b[0m",
    "a\rb": r"a\rb",
    "a\tb": r"a\tb",
    "\x9b2J": r"\x9b2J",
    "left\u202eright": r"left\u202eright",
    "\udcff": r"\udcff",
    "\x00": r"\x00",
    "zero\u200bwidth": r"zero\u200bwidth",
    "/camera/image": "/camera/image",
    "Größe 1": "Größe 1",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_unprintable_characters_are_escaped(name: str) -> None:
    assert shown(name) == printable(name) == HOSTILE[name]


def test_a_name_has_one_line_and_a_message_keeps_its_lines() -> None:
    assert shown("a\nError: b") == r"a\nError: b"
    assert printable("a\nb") == "a\nb"


def test_a_long_name_is_cut_with_its_length_said() -> None:
    text = shown("/" + "x" * 60_000)
    assert "[... 60001 characters ...]" in text
    assert len(text) < LONGEST_NAME + 40
    assert shown("x" * LONGEST_NAME) == "x" * LONGEST_NAME


def test_a_long_word_in_a_message_is_cut() -> None:
    text = printable(f"topic {'x' * 9_000} is missing")
    assert text.startswith("topic xxx")
    assert text.endswith("xxx is missing")
    assert "[... 9000 characters ...]" in text
    assert len(text) < 600


def test_a_long_message_is_cut() -> None:
    text = printable("ab " * 100_000)
    assert "[... 300000 characters ...]" in text
    assert len(text) < LONGEST + 100


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("a\x1b", r"'a\x1b'"),
        (1.5, "1.5"),
        ([1.0], "[1.0]"),
        (np.eye(2), "array([[1., 0.], [0., 1.]])"),
        (10**5000, "int of too many digits"),
        ([10**5000], "list of too many digits"),
    ],
    ids=range(6),
)
def test_any_value(value: object, said: str) -> None:
    assert brief(value) == said


@pytest.mark.parametrize(
    "value", ["x" * 10**6, b"x" * 10**6, ["x" * 10**6] * 1000, {"x" * 10**6: 1}, np.ones((300, 300))]
)
def test_a_large_value_is_short(value: object) -> None:
    assert len(brief(value)) < LONGEST_NAME + 60


@pytest.mark.parametrize(
    ("value", "digits", "written"),
    [(941_653.0, 3, "942000"), (1234.0, 2, "1200"), (0.0512, 2, "0.051"), (3.0, 2, "3"), (float("inf"), 2, "inf")],
)
def test_numbers_have_few_digits_and_no_exponent(value: float, digits: int, written: str) -> None:
    assert rounded(value, digits) == written
