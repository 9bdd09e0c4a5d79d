"""Arrays and facts in one small file, with a checksum: what partial results and merged moments are kept in.

A file is one line of text (what it is, its version, the checksum of what follows before it was compressed), then
zstandard: a length, the facts as JSON, and the arrays' bytes one after the other.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import zstandard

from gtsam_rwhec.errors import FileFormatError, ResultVersionError

#: The version of all files of this kind: it is in their names, through the keys.
FORMAT_VERSION = 1
#: A file unpacks to at most this many bytes.
MOST_BYTES = 1 << 31
_LENGTH = struct.Struct("<Q")


def packed(kind: str, facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """The bytes of a file; the same for the same facts and arrays.

    Parameters
    ----------
    kind : str
        What the file is: one word.
    facts : dict
        JSON values.
    arrays : dict of str to array
        Numbers of any shape.
    """
    listed = {name: [array.dtype.str, list(array.shape)] for name, array in arrays.items()}
    head = json.dumps({"facts": facts, "arrays": listed}, sort_keys=True, allow_nan=False).encode()
    # In the order of the names in the head.
    body = b"".join(np.ascontiguousarray(arrays[name]).tobytes() for name in sorted(arrays))
    payload = _LENGTH.pack(len(head)) + head + body
    line = f"gtsam-rwhec fleet {kind} {FORMAT_VERSION} {hashlib.sha256(payload).hexdigest()}\n"
    return line.encode() + zstandard.ZstdCompressor(level=3, write_checksum=False).compress(payload)


def unpacked(content: bytes, kind: str, where: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The facts and the arrays of a file.

    Raises
    ------
    ResultVersionError
        Another version of the library wrote it.
    FileFormatError
        It is no such file, or its bytes are not those that were written; ``where`` names it.
    """
    line, _, rest = content.partition(b"\n")
    words = line.decode("ascii", "replace").split(" ")
    if words[:3] != ["gtsam-rwhec", "fleet", kind] or len(words) != 5:
        raise FileFormatError(f"{where} is no {kind} of a fleet; remove it, and run the fleet again")
    if words[3] != str(FORMAT_VERSION):
        raise ResultVersionError(
            f"{where} is of format {words[3]}, and this version reads {FORMAT_VERSION}; run the fleet again"
        )
    try:
        payload = zstandard.ZstdDecompressor().decompress(rest, max_output_size=MOST_BYTES)
    except zstandard.ZstdError as error:
        raise FileFormatError(_damaged(where)) from error
    if hashlib.sha256(payload).hexdigest() != words[4]:
        raise FileFormatError(_damaged(where))
    (length,) = _LENGTH.unpack_from(payload)
    head = json.loads(payload[_LENGTH.size : _LENGTH.size + length])
    at, arrays = _LENGTH.size + length, {}
    for name, (dtype, shape) in sorted(head["arrays"].items()):
        array = np.frombuffer(payload, np.dtype(dtype), int(np.prod(shape)), at).reshape(shape)
        arrays[name], at = array, at + array.nbytes
    return head["facts"], arrays


def _damaged(where: str) -> str:
    return f"{where} is damaged: its checksum is not that of its bytes. Remove it, and run the fleet again"
