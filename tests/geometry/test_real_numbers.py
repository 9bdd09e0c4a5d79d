"""What counts as a number, one or many, and what is said of the rest."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from gtsam_rwhec.geometry.real_numbers import LARGEST_WHOLE, is_between, is_one_of, is_real, is_whole, real_array

NO_NUMBERS = [
    None,
    "1",
    b"1",
    True,
    np.True_,
    1 + 0j,
    [1.0],
    np.array(1.0),
    np.array([1.0]),
    {},
    np.timedelta64(3, "s"),
]


@pytest.mark.parametrize("value", [1, 1.5, np.float32(2.0), np.int64(3), Fraction(1, 3), 10**400, float("nan")])
def test_a_real_number(value: object) -> None:
    assert is_real(value)


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_what_is_no_real_number(value: object) -> None:
    assert not is_real(value)
    assert not is_between(value, -1e300, 1e300)
    assert not is_whole(value, 0)


def test_between() -> None:
    assert is_between(1, 1.0, 2.0)
    assert is_between(np.float32(2.0), 1.0, 2.0)
    assert not is_between(10**400, 0.0, 1e308)
    assert not is_between(float("nan"), 0.0, 1.0)


@pytest.mark.parametrize("value", [1.0, -1, LARGEST_WHOLE + 1, 10**400])
def test_not_whole(value: object) -> None:
    assert not is_whole(value, 0)


@pytest.mark.parametrize("value", [0, np.int8(3), LARGEST_WHOLE])
def test_whole(value: object) -> None:
    assert is_whole(value, 0)


@pytest.mark.parametrize("value", [np.ones(2), np.array("a"), None, ["a"], 3])
def test_only_text_is_one_of(value: object) -> None:
    assert not is_one_of(value, ("a", "b"))
    assert is_one_of("b", ("a", "b"))


@pytest.mark.parametrize("values", [[1, 2.5], (1, np.float32(2.5)), np.array([1.0, 2.5]), [1, Fraction(5, 2)]])
def test_numbers(values: object) -> None:
    array = real_array(values)
    assert array.dtype == np.float64
    assert array.tolist() == [1.0, 2.5]


def test_an_array_is_not_copied() -> None:
    array = np.ones(3)
    assert real_array(array) is array


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (["1", "2"], "text such as '1'"),
        ([1, "x"], "text"),
        (b"x", "bytes such as b'x'"),
        ([1j], "complex numbers; give real numbers"),
        (np.clongdouble(1j), "complex numbers"),
        ([[1, 2], [3]], "inhomogeneous"),
        ([10**400], "too large"),
        (np.array([10**400], dtype=object), "too large"),
        ({"a": 1}, "dict"),
        (np.datetime64("2020"), "times such as"),
        (np.timedelta64(3, "s"), "durations such as"),
        (np.zeros(2, dtype=[("a", float)]), "records"),
        (np.ma.masked_array([1.0], [True]), "a masked array; leave masked measurements out"),
    ],
)
def test_what_is_no_array_of_numbers(values: object, said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        real_array(values)
    assert len(str(caught.value)) < 300
