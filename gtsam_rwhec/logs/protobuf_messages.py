"""Protobuf messages of a log, parsed with the descriptors in the log."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory

from gtsam_rwhec.errors import MessageError

#: What a pool raises for wrong descriptors in a stranger's file.
_FAULTS = (McapError, DecodeError, TypeError, ValueError, KeyError, RecursionError)


def parser(schema: Schema) -> Callable[[bytes | memoryview], Any]:
    """Make the function from bytes to messages of `schema`.

    Raises
    ------
    MessageError
        The descriptors cannot be read or lack the schema. The function raises it for bytes that are not a message.
    """
    try:
        decode = DecoderFactory().decoder_for("protobuf", schema)
    except _FAULTS as error:
        raise MessageError(f"schema {schema.name}: its protobuf descriptors cannot be used: {error}") from error
    if decode is None:
        raise MessageError(f"schema {schema.name} is in {schema.encoding!r} in place of protobuf")

    def parse(message: bytes | memoryview) -> Any:
        try:
            return decode(bytes(message))
        except DecodeError as error:
            raise MessageError(f"not a protobuf message: {error}") from error

    return parse
