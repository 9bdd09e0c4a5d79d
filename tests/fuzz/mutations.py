"""Changes of inputs that keep most of a format: values in JSON trees, words and lines in text, numbers in bytes."""

from __future__ import annotations

import json
import random
import re
import struct
from collections.abc import Callable
from typing import Any

#: Numbers at which something ends: a type, a range, a digit.
NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 3, 255, 256, 65535, 2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**63 - 1, 2**63, 2**64, -(2**63) - 1,
    10**18, 10**19, 10**400, 0.0, -0.0, 0.5, 1e-320, 1e-160, 1e-9, 1e9, 1e150, 1e200, 1.7e308, -1.7e308,
    float("nan"), float("inf"), float("-inf"), 1e-2, 1.01, 0.99,
)  # fmt: skip
#: Texts that are not what they seem: empty, a number, an escape code, half a character, very long.
TEXTS = (
    "", " ", "0", "1e999", "nan", "null", "true", "a,b", "[", "{", "\x00", "\x1b[2J\x1b]0;x\x07", "\ud800", "\u202e",
    "a\nb", "\r", "../../etc/passwd", "/dev/zero", "~", "%s%n", "%(a)s", "{0.__class__}", "\U0001f600", "x" * 3000,
)  # fmt: skip
#: Words of YAML and of tables of numbers, and what breaks them.
WORDS = (
    "null", "true", "no", ".nan", ".inf", "-.INF", "0x10", "1_000", "1e400", "-1e-400", "9" * 30, "9" * 5000, "1:30",
    "*a", "&a", "!!python/object/apply:os.system [ls]", "!!binary aGk=", "!!opencv-matrix", "<<: *a", "? ", "- ", "---",
    "...", "%YAML 1.1", "%YAML:1.0", "{", "}", "[", "]", "{}", "[]", "[[]]", ",", ":", "|", ">", "'", '"', '"\\u0000"',
    '"\\ud800"', "\t", "#", "\x07", "\u2028", "\ufeff", "\x85", "é", "1e5", "-0", "+1", "1.", ".5", "0b1", "1__0", "٣",
)  # fmt: skip
_WORD = re.compile(r"[^\s,:\[\]{}]+")


def _dumped(tree: Any, chance: random.Random) -> bytes:
    text = json.dumps(tree, ensure_ascii=chance.random() < 0.5)
    return text.encode("utf-8", "surrogatepass")


def _nodes(tree: Any) -> list[tuple[Any, Any]]:
    """Every (mapping or list, key or index) of a tree."""
    found: list[tuple[Any, Any]] = []
    todo = [tree]
    while todo:
        value = todo.pop()
        if isinstance(value, dict | list):
            keys = list(value) if isinstance(value, dict) else range(len(value))
            found += [(value, key) for key in keys]
            todo += [value[key] for key in keys]
    return found


def _new_value(old: Any, nodes: list[tuple[Any, Any]], chance: random.Random) -> Any:
    kind = chance.randrange(9)
    if kind == 0 and isinstance(old, int | float):
        return old * chance.choice((-1, 0, 2, 0.5, 1 + 1e-12, 1e10, 1e-10, 1e300)) if abs(old) < 1e200 else old
    if kind <= 2:
        return chance.choice(NUMBERS)
    if kind == 3:
        return chance.choice(TEXTS)
    if kind == 4:
        return chance.choice((None, True, False, [], {}, [[]], [None], {"": None}))
    if kind == 5:
        container, key = chance.choice(nodes)
        return json.loads(json.dumps(container[key]))  # a copy, since a tree has no loops
    if kind == 6:
        return [old] * chance.choice((1, 2, 3, 100))
    if kind == 7:
        for _ in range(chance.choice((1, 5, 60))):
            old = [old] if chance.random() < 0.5 else {"a": old}
        return old
    return str(old)


def json_tree(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change values, keys and rows of a JSON document; what is not JSON is changed as bytes."""
    try:
        tree = json.loads(data)
        nodes = _nodes(tree)
        if not nodes or len(data) > 200_000 or chance.random() < 0.15:
            return plain(data)
        for _ in range(chance.choice((1, 1, 1, 2, 4))):
            nodes = _nodes(tree)
            if not nodes:
                break
            container, key = chance.choice(nodes)
            kind = chance.randrange(8)
            if kind == 0:
                del container[key]
            elif kind == 1 and isinstance(container, dict):
                container[chance.choice((*TEXTS, str(key) + "x"))] = container.pop(key)
            elif kind == 1:
                container.insert(key, container[key])
            elif kind == 2 and isinstance(container, list):
                other = chance.randrange(len(container))
                container[key], container[other] = container[other], container[key]
            else:
                container[key] = _new_value(container[key], nodes, chance)
        out = _dumped(tree, chance)
    except (ValueError, RecursionError, TypeError, OverflowError):
        return plain(data)
    if chance.random() < 0.05:  # a key twice, which no tree has
        out = re.sub(rb'("\w+": )(\d+)', rb"\1\2, \1\2", out, count=1)
    return out


def words_and_lines(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change words and lines of a text; what is not text is changed as bytes."""
    if chance.random() < 0.3:
        return plain(data)
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return plain(data)
    for _ in range(chance.choice((1, 1, 2, 4))):
        kind = chance.randrange(6)
        words = list(_WORD.finditer(text))
        lines = text.split("\n")
        at = chance.randrange(len(lines))
        if kind <= 2 and words:
            word = chance.choice(words)
            new = chance.choice((*WORDS, *map(str, NUMBERS), *TEXTS, chance.choice(words)[0]))
            text = text[: word.start()] + new + text[word.end() :]
        elif kind == 3:
            del lines[at]
            text = "\n".join(lines)
        elif kind == 4:
            lines.insert(chance.randrange(len(lines) + 1), lines[at])
            text = "\n".join(lines)
        else:
            moved = " " * chance.randrange(6) + lines[at].lstrip()
            lines[at] = chance.choice((moved, lines[at] + chance.choice(WORDS)))
            text = "\n".join(lines)
    return text.encode("utf-8", "surrogatepass")


def numbers_in_bytes(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Overwrite a length, a count or a double, or do as libFuzzer does."""
    if chance.random() < 0.5 or len(data) < 8:
        return plain(data)
    code = chance.choice(["<B", "<H", "<I", "<Q", ">I", "<d", "<f"])
    size = struct.calcsize(code)
    out = bytearray(data)
    at = chance.randrange(len(out) - size + 1)
    if code[1] in "df":
        value: Any = chance.choice([n for n in NUMBERS if isinstance(n, float)])
        packed = (
            struct.pack("<d", value) if code == "<d" else struct.pack("<I", chance.choice((0x7F800000, 0x7FC00000)))
        )
    else:
        most = 256**size - 1
        (old,) = struct.unpack_from(code, out, at)
        ends = (0, 1, most, most // 2, most // 2 + 1, len(data), len(data) - at)
        value = chance.choice((*ends, old + 1, old - 1, old * 2))
        packed = struct.pack(code, value & most)
    out[at : at + size] = packed
    return bytes(out)
