"""What the fuzzing driver needs to know of a reader."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

#: Changes one input. It gets the input, a source of chance, and libFuzzer's own change of bytes.
Mutate = Callable[[bytes, random.Random, Callable[[bytes], bytes]], bytes]


@dataclass(frozen=True)
class Harness:
    """One reader under attack."""

    read: Callable[[bytes], None]  #: Reads one input. Whatever leaves it but RwhecError is a finding
    seeds: Callable[[], Iterable[bytes]]  #: Valid inputs, made by code, from which the changes start
    #: Changes that know the format, so that they get behind its first checks; None for changes of bytes alone.
    mutate: Mutate | None = None
    limit_s: float = 10.0  #: Seconds of the processor that one input may take


def check_said(found: Iterable[object]) -> None:
    """What a decoder gave for each message can be shown: records, or why there are none in a sentence."""
    for each in found:
        assert not isinstance(each, str) or len(each) < 5000, f"a sentence of {len(each)} characters"
        str(each)


def scratch() -> Path:
    """A new folder, which `run.py` puts into memory and deletes: files are written for every input."""
    return Path(tempfile.mkdtemp(prefix="fuzz-"))
