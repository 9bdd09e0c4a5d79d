"""The definition of a message type with those of all types in it, as MCAP files and the library's reader have it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

PRIMITIVE = re.compile(r"(bool|byte|char|float32|float64|u?int(8|16|32|64)|w?string(<=\d+)?)(\[.*\])?$")


def definition_of(name: str, path_of: Callable[[str], str | Path]) -> str:
    """The text of ``sensor_msgs/msg/Image``, say; `path_of` is ``rosidl_runtime_py.get_interface_path``."""
    texts: dict[str, str] = {}
    waiting = [name]
    while waiting:
        one = waiting.pop(0)
        if one in texts:
            continue
        texts[one] = Path(path_of(one)).read_text(encoding="utf-8")
        package = one.split("/")[0]
        for line in texts[one].splitlines():
            words = line.partition("#")[0].split()
            if len(words) < 2 or PRIMITIVE.match(words[0]):
                continue
            kind = words[0].partition("[")[0]
            owner, _, short = kind.rpartition("/")
            waiting.append(f"{owner.removesuffix('/msg') or package}/msg/{short}")
    first, *others = texts
    parts = [texts[first], *(f"{'=' * 80}\nMSG: {other.replace('/msg/', '/')}\n{texts[other]}" for other in others)]
    return "\n".join(parts)
