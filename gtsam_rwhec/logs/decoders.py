"""The decoder of a channel's messages, by schema and encoding; protobuf messages by the descriptors in the log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs import foxglove_schemas, ros2_schemas

Decoder = Callable[[str, Sequence[bytes | memoryview], list[int]], list[foxglove_schemas.Read]]
#: A descriptor pool raises these errors for wrong descriptors in a file.
_FAULTS = (McapError, DecodeError, TypeError, ValueError, KeyError, RecursionError)


def _protobuf_parser(schema: Schema) -> Callable[[bytes | memoryview], Any]:
    """Make the function from bytes to messages of `schema`. Raise a MessageError if descriptors lack it or are wrong.

    The function raises a MessageError for bytes that are not a message.
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


def decoder_for(channel: Channel, schema: Schema | None) -> Decoder:
    """The function from messages of a channel to their records. If there is none, a MessageError is raised."""
    if schema is None:
        raise MessageError("it has no schema")
    name, encoding = schema.name, channel.message_encoding
    if encoding == "cdr" and schema.encoding == "ros2msg" and name.replace("/msg/", "/") in ros2_schemas.SCHEMAS:
        try:
            return ros2_schemas.decoder(name, schema.data.decode())
        except UnicodeDecodeError as error:
            raise MessageError(f"the definition of {name} is not UTF-8") from error
    if encoding == "json" and name in foxglove_schemas.SCHEMAS:
        return foxglove_schemas.decoder(name, foxglove_schemas.parse_json, foxglove_schemas.JSON)
    if encoding == "protobuf" and name in foxglove_schemas.SCHEMAS:
        return foxglove_schemas.decoder(name, _protobuf_parser(schema), foxglove_schemas.PROTOBUF)
    raise MessageError(f"schema {name!r} ({schema.encoding}) in {encoding!r} is not read by this library")
