"""Records as trees of JSON values and back, bit for bit; and sentences about what is wrong with a file.

Pydantic reads and checks the records. These functions do what pydantic (2.14, tried) does not. Its JSON has null for
NaN and for both infinities, and none of these becomes a float again. A key that is a pair becomes the text "a,b", which
does not become a pair again. Pydantic cannot write gtsam.Pose3, arrays and slices.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, NoReturn

import gtsam
import numpy as np
from pydantic import ValidationError

from gtsam_rwhec.calibration.verdict import Choice
from gtsam_rwhec.files.terminal_text import brief, printable, shown
from gtsam_rwhec.results.acceptance_record import Acceptance
from gtsam_rwhec.results.schema import PointFields
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.free_directions import FreeDirection

#: Fields at the top of a file: those of the refined answer if there is one, else those of the certified answer.
POSED = ("sensors", "targets", "scale", "scale_mode")
#: Fields whose keys are pairs. JSON has no such keys: a file has rows {target, sensor, ...}.
ROWS = ("residuals", "pairs", "noise", "inlier_counts")
#: The field in which a record says in words what it means. It is for people and is not read back.
SENTENCE = "sentence"
#: Records with a sentence.
SAID = (Certificate, FreeDirection, Choice, PointFields, Acceptance)
#: Fields of a covariance of all unknowns; they have far more numbers than all others together.
MATRICES = ("finite", "free", "unit")
#: With more faults than this a message has their number alone: to list a million faults takes a gigabyte.
MOST_FAULTS = 1_000
#: Fields that may be infinite, and the infinity for which null stands in each.
INFINITIES = {
    **dict.fromkeys(("lower_bound", "float_bound", "min_eigenvalue"), -math.inf),
    **dict.fromkeys(("weakest", "degrees_of_freedom", "standard_deviations_deg", "standard_deviations_mm"), math.inf),
    **dict.fromkeys(("estimate_mm", "upper_mm", "radius_mm", "stated_deviations", "innovation_deviations"), math.inf),
}


def to_json(value: Any, place: str, field: str = "") -> Any:
    """Turn a record into JSON values: null for infinity, rows for `ROWS`, and its sentence if it has one.

    Raises `ValueError` if a number is infinite or NaN in a field where it must be finite.
    """
    if is_dataclass(value) and not isinstance(value, type):
        tree = {f.name: to_json(getattr(value, f.name), f"{place}.{f.name}", f.name) for f in fields(value)}
        return {**tree, SENTENCE: str(value)} if isinstance(value, SAID) else tree
    if isinstance(value, Mapping):
        if field in ROWS:
            return [
                {**pair._asdict(), **(item if isinstance(item, dict) else {"value": item})}
                for pair, item in ((pair, to_json(item, f"{place}[{pair}]", field)) for pair, item in value.items())
            ]
        return {str(key): to_json(item, f"{place}.{key}", field) for key, item in value.items()}
    if isinstance(value, slice):
        return [value.start, value.stop]
    if isinstance(value, np.ndarray):
        is_finite = value.dtype == np.float64 and bool(np.isfinite(value).all())
        value = value.tolist()
        if is_finite:  # a covariance of all unknowns has hundreds of thousands
            return value
    if isinstance(value, list | tuple):
        return [to_json(item, f"{place}[{index}]", field) for index, item in enumerate(value)]
    if not isinstance(value, float) or math.isfinite(value):
        return None if isinstance(value, gtsam.Pose3) else value  # `pose_rows` writes poses
    if value == INFINITIES.get(field):
        return None
    allowed = f", or {INFINITIES[field]} (null)" if field in INFINITIES else ""
    raise ValueError(f"{place}: must be finite{allowed} (found {value})")


def from_json(tree: dict[str, Any]) -> dict[str, Any]:
    """Reverse `to_json` for a whole file; a pair that is a key becomes its JSON text.

    Raises `ValueError` if a number is infinite or NaN, if a row lacks its target or sensor or its pair is there twice,
    or if there is more of anything than `json_text` allows.
    """
    restored: dict[str, Any] = _Restored().of(tree, "$", "", 0)
    return restored


class _Restored:
    """Restores the values of one file, and counts them."""

    def __init__(self) -> None:
        self.number = 0

    def of(self, value: Any, place: str, field: str, depth: int) -> Any:
        """The value at a place, inside `depth` lists and objects; `field` is the name of the field that holds it."""
        if isinstance(value, dict | list):
            if depth == DEEPEST:
                refuse_depth()
            if len(value) > MOST_ROWS:
                raise ValueError(f"{_cut(place)}: {len(value)} entries; at most {MOST_ROWS} are read")
            self.number += len(value)
            if self.number > MOST_VALUES:
                raise ValueError(f"{_cut(place)}: the file has more than {MOST_VALUES} values up to here")
        if isinstance(value, dict):
            told = {key: item for key, item in value.items() if key != SENTENCE or not isinstance(item, str)}
            matrices = MATRICES if field == "joint" else ()
            return {
                key: _checked_matrix(item, f"{place}.{key}")
                if key in matrices
                else self.of(item, f"{place}.{shown(key)}", key, depth + 1)
                for key, item in told.items()
            }
        if isinstance(value, list) and field in ROWS and all(isinstance(row, dict) for row in value):
            return self._rows(value, place, depth)
        if isinstance(value, list):
            return [self.of(item, f"{place}[{index}]", field, depth + 1) for index, item in enumerate(value)]
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{_cut(place)}: {value} is not a number of JSON")
        return INFINITIES[field] if value is None and field in INFINITIES else value

    def _rows(self, value: list[dict[str, Any]], place: str, depth: int) -> dict[str, Any]:
        rows: dict[str, Any] = {}
        for index, given in enumerate(value):
            row = self.of(given, f"{place}[{index}]", "", depth + 1)
            pair = [row.pop(name, None) for name in ("target", "sensor")]
            if not all(isinstance(name, str) for name in pair):
                raise ValueError(f"{_cut(place)}[{index}]: a target and a sensor are missing")
            key = json.dumps(pair)
            if key in rows:
                raise ValueError(f"{_cut(place)}[{index}]: the pair {shown(key)} is there twice; keep one")
            rows[key] = row["value"] if row.keys() == {"value"} else row
        return rows


def _checked_matrix(rows: Any, place: str) -> Any:
    """The rows of a matrix, or one row, of finite numbers; pydantic would tell of each number that is none."""
    if not isinstance(rows, list):
        raise ValueError(f"{place}: must be a list (found {brief(rows)})")
    for i, row in enumerate(rows):
        for j, number in enumerate(row if isinstance(row, list) else [row]):
            if type(number) not in (float, int) or not math.isfinite(number):
                where = f"[{i}][{j}]" if isinstance(row, list) else f"[{i}]"
                raise ValueError(f"{place}{where}: must be a finite number (found {brief(number)})")
    return rows


def _cut(place: str) -> str:
    return shown(place, 200)


def in_words(error: Exception, owner: str = "") -> str:
    """What is wrong with a file: of pydantic's error, each fault with its JSON path, the first three in full.

    ``owner`` is the record into which `POSED` was moved from the top of the file before the check.
    """
    if not isinstance(error, ValidationError):
        return f"{error}."
    if error.error_count() > MOST_FAULTS:
        return f"{error.error_count()} fields are missing, unknown or wrong."
    faults = []
    for fault in error.errors(include_url=False):
        keys = fault["loc"][1:] if fault["loc"][:2] in [(owner, name) for name in POSED] else fault["loc"]
        place = "$" + "".join(_step(key) for key in keys)
        given = brief(fault["input"], 60)
        value = f" (found {given})" if "characters ...]" not in given and fault["type"] != "missing" else ""
        faults.append(f"{_cut(place)}: {printable(fault['msg'].removeprefix('Value error, '), 1000)}{value}")
    rest = f"; and {len(faults) - 3} more" if len(faults) > 3 else ""
    return "; ".join(faults[:3]) + rest + "."


def _step(key: int | str) -> str:
    """One step of a JSON path; a key that begins with [ is a pair already."""
    if isinstance(key, int):
        return f"[{key}]"
    return shown(key) if key.startswith("[") else f".{shown(key)}"


#: Bytes of the largest file that is read. The joint covariance of 400 frames takes about half of it.
MOST_BYTES = 500_000_000
#: A file may have this many lists and objects, and this many numbers and texts, whatever its size.
FEW = 20_000
#: A larger file needs this many bytes for each of its lists and objects, brackets and names included,
BYTES_FOR_A_GROUP = 24
#: and this many for each of its values.
BYTES_FOR_A_VALUE = 12
#: Lists and objects inside one another. The deepest place of a result is at nine.
DEEPEST = 20
#: Digits of the longest integer.
MOST_DIGITS = 20
#: Entries of the longest list or object: of targets, sensors or pairs.
MOST_ROWS = 20_000
#: Values in a file without the matrices of the joint covariance. A thousand frames in ten thousand pairs have 300,000.
MOST_VALUES = 1_000_000


def parse_json(content: bytes) -> Any:
    """The values of a JSON text. Raises `ValueError`, in words, for a text that is no JSON or beyond the budget."""
    if not content.strip():
        raise ValueError("it is empty")
    if len(content) > MOST_BYTES:
        raise ValueError(f"it has {len(content)} bytes; at most {MOST_BYTES} are read")
    for number, what, size in (
        (content.count(b"[") + content.count(b"{"), "lists and objects", BYTES_FOR_A_GROUP),
        (content.count(b",") + content.count(b":"), "values", BYTES_FOR_A_VALUE),
    ):
        if number > max(FEW, len(content) // size):
            raise ValueError(f"it has {number} {what} in {len(content)} bytes, which no result has; is it damaged?")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"it is not text in UTF-8 (byte {error.start})") from error
    try:
        return json.loads(text, object_pairs_hook=_object, parse_int=_integer)
    except json.JSONDecodeError as error:
        raise ValueError(f"$: Invalid JSON: {error.msg} (line {error.lineno} column {error.colno})") from error
    except RecursionError:
        refuse_depth()


def refuse_depth() -> NoReturn:
    """Raise the error about lists and objects that are nested too deeply."""
    raise ValueError(f"more than {DEEPEST} lists and objects inside one another; is it damaged?") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        among = ", ".join(map(shown, list(fields)[:5]))
        raise ValueError(f"the key {brief(twice)} is there twice, in the object with the keys {among}; keep one")
    return fields


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"an integer of {len(digits)} digits; at most {MOST_DIGITS} are read")
    return int(digits)
