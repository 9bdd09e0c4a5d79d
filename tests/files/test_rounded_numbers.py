"""Numbers in sentences."""

from __future__ import annotations

import pytest

from gtsam_rwhec.files.terminal_text import rounded


@pytest.mark.parametrize(
    ("value", "digits", "written"),
    [(941_653.0, 3, "942000"), (1234.0, 2, "1200"), (0.0512, 2, "0.051"), (3.0, 2, "3"), (float("inf"), 2, "inf")],
)
def test_numbers_have_few_digits_and_no_exponent(value: float, digits: int, written: str) -> None:
    assert rounded(value, digits) == written
