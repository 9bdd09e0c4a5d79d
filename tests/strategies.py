"""Hypothesis strategies for the readers of files: valid content with something changed, and content made from words."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

from hypothesis import strategies as st

#: Doubles with the ends of their range, and NaN and infinities.
doubles = st.floats() | st.sampled_from([0.0, -0.0, 5e-324, 1e-160, 1e160, 1.7e308, math.inf, -math.inf, math.nan])
#: Whole numbers with the ends of C's types.
integers = st.integers() | st.sampled_from([-1, 2**31, 2**32, 2**53 + 1, 2**63 - 1, 2**63, 2**64, 10**30])
#: Text with what steers terminals, ends lines and is no character.
texts = st.text(max_size=12) | st.sampled_from(["", "\x00", "\x1b[2J", "\ud800", "a\nb", "../x", "%s", "x" * 3000])
#: Any value of JSON.
json_values = st.recursive(
    st.none() | st.booleans() | integers | doubles | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)
#: Numbers and what is nearly one, as text.
written_numbers = (
    st.floats(-10.0, 10.0).map(repr)
    | doubles.map(repr)
    | st.sampled_from(
        ["", " ", "1_0", "0x1", "1e", "+1", "--1", ".", "\u0663", "1 2", "nan", "-inf", '"1"', "#", "9" * 400]
    )
)


@st.composite
def tables(draw: st.DrawFn, columns: int, good: str, separator: str = ",") -> str:
    """Lines of numbers, most of them `good`, with odd fields, lengths and line ends."""
    odd = st.lists(written_numbers, max_size=columns + 2).map(separator.join)
    lines = draw(st.lists(st.just(good) | st.just(good) | odd, max_size=8))
    return draw(st.sampled_from(["", "\ufeff", " "])) + draw(st.sampled_from(["\n", "\r\n", "\r", "\n\n"])).join(lines)


@st.composite
def changed_trees(draw: st.DrawFn, tree: Any) -> Any:
    """A copy of a JSON tree, of which up to three values are changed, removed, doubled or renamed."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        at: Any = tree
        key = _drawn_key(draw, at)
        while key is not None and isinstance(at[key], dict | list) and at[key] and draw(st.integers(0, 4)):
            at = at[key]
            key = _drawn_key(draw, at)
        if key is None:
            continue
        what = draw(st.sampled_from(["change", "change", "change", "remove", "double"]))
        if what == "change":
            at[key] = draw(json_values)
        elif what == "remove":
            del at[key]
        elif isinstance(at, list):
            at.append(copy.deepcopy(at[key]))
        else:
            at[draw(texts)] = copy.deepcopy(at[key])
    return tree


def _drawn_key(draw: st.DrawFn, at: Any) -> Any:
    keys = list(at) if isinstance(at, dict) else list(range(len(at)))
    return draw(st.sampled_from(keys)) if keys else None


@st.composite
def damaged(draw: st.DrawFn, contents: Sequence[bytes], first: int = 0) -> bytes:
    """One of several contents with bytes overwritten, a piece doubled or removed, or the end cut off."""
    content = bytearray(draw(st.sampled_from(list(contents))))
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(first, max(first, len(content) - 1)))
        patch = draw(st.binary(min_size=1, max_size=8) | st.sampled_from([b"\xff" * 4, b"\xff" * 8, bytes(8)]))
        kind = draw(st.sampled_from(["overwrite", "overwrite", "insert", "remove", "double"]))
        if kind == "overwrite":
            content[at : at + len(patch)] = patch
        elif kind == "insert":
            content[at:at] = patch
        elif kind == "remove":
            del content[at : at + len(patch)]
        else:
            content[at:at] = content[at : at + 64]
    return bytes(content[: draw(st.integers(first, len(content)))] if draw(st.booleans()) else content)


#: Lines of a ROS message's definition.
definition_lines = st.sampled_from(
    [
        "bool b", "int16[] n", "string s", "string[] many", "string[9] nine", "string<=10[<=3] w", "float64[36] m",
        "Inner i", "Inner[] is", "m/Inner[5] five", "T itself", "uint8[0] none", "Missing x", "int32 X=1", "# no",
        "=" * 80, "MSG: m/Inner", "MSG: m/T", "uint8[999999999] all", "wstring w", "7 dwarfs", "",
    ]
)  # fmt: skip
definitions = st.lists(definition_lines, max_size=10).map("\n".join)
#: Messages in CDR: their first four bytes name the encoding.
cdr_messages = st.builds(
    lambda kind, numbers, rest: bytes([0, kind, 0, 0]) + b"".join(n.to_bytes(4, "little") for n in numbers) + rest,
    st.sampled_from([0, 1, 6, 7]),
    st.lists(st.integers(0, 8) | st.sampled_from([2**31, 2**32 - 1]), max_size=8),
    st.binary(max_size=60),
)
