"""Definitions of messages in ROS bags, held against their budget before `rosbags` makes code of them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from gtsam_rwhec.errors import BudgetError
from gtsam_rwhec.files.budgets import BAG_DEFINITIONS, BAG_DEFINITIONS_SHARE, FIXED_LIST

#: A list of fixed length in a definition: its type and its length.
_FIXED = re.compile(r"^[ \t]*([\w/]+)(?:<=\d+)?\[(\d+)\]", re.MULTILINE)
_NUMBERS = re.compile(r"bool|byte|char|u?int(8|16|32|64)|float(32|64)")


def check_definitions(definitions: Iterable[str], path: Path, size: int) -> None:
    """Refuse definitions that take long to read, or that make long code; `size` is the bag's, in bytes.

    Raises a BudgetError.
    """
    most = BAG_DEFINITIONS + int(BAG_DEFINITIONS_SHARE * size)
    total = 0
    for definition in definitions:
        total += len(definition)
        if total > most:
            raise BudgetError(
                f"{path}: the definitions of its messages have more than {most} bytes, and those of a bag of {size} "
                "bytes may have no more. It is damaged, or made to exhaust who reads it."
            )
        for type_, length in _FIXED.findall(definition):
            if not _NUMBERS.fullmatch(type_) and (len(length) > 9 or int(length) > FIXED_LIST):
                raise BudgetError(
                    f"{path}: a message has a list of {length[:20]} {type_[:80]}, and at most {FIXED_LIST} are read."
                )
