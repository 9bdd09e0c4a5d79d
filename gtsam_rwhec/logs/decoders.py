"""The decoder of a channel's messages, by schema and encoding; protobuf messages by the descriptors in the log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from google.protobuf.descriptor import Descriptor
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.files.budgets import MESSAGE_TYPES, MIB, SCHEMA, Spending
from gtsam_rwhec.logs import foxglove_schemas, ros2_schemas

Decoder = Callable[[str, Sequence[bytes | memoryview], list[int]], list[foxglove_schemas.Read]]
#: A descriptor pool raises these errors for wrong descriptors in a file.
_FAULTS = (McapError, DecodeError, TypeError, ValueError, KeyError, RecursionError)
#: Bytes. A protobuf message with lists in it has at most this much: two bytes of it become an object of a hundred.
LISTED_BYTES = MIB


def _protobuf_parser(schema: Schema) -> Callable[[bytes | memoryview], Any]:
    """Make the function from bytes to messages of `schema`. Raise a MessageError if descriptors lack it or are wrong.

    The function raises a MessageError for bytes that are not a message.
    """
    try:
        types = sum(
            _count(type_) for file in FileDescriptorSet.FromString(schema.data).file for type_ in file.message_type
        )
        if types > MESSAGE_TYPES:
            raise ValueError(f"they define {types} types of messages, and at most {MESSAGE_TYPES} are read")
        decode = DecoderFactory().decoder_for("protobuf", schema)
    except _FAULTS as error:
        raise MessageError(f"schema {schema.name}: its protobuf descriptors cannot be used: {error}") from error
    if decode is None:
        raise MessageError(f"schema {schema.name} is in {schema.encoding!r} in place of protobuf")
    has_lists = _has_lists(decode(b"").DESCRIPTOR, set())

    def parse(message: bytes | memoryview) -> Any:
        if has_lists and len(message) > LISTED_BYTES:
            raise MessageError(f"{len(message)} bytes with lists in them, beyond the limit of {LISTED_BYTES}")
        try:
            return decode(bytes(message))
        except DecodeError as error:
            raise MessageError(f"not a protobuf message: {error}") from error

    return parse


def _count(type_: DescriptorProto) -> int:
    """A type and all that are nested in it."""
    return 1 + sum(map(_count, type_.nested_type))


def _has_lists(descriptor: Descriptor, known: set[str]) -> bool:
    """Whether a message, or one inside it, has a list."""
    known.add(descriptor.full_name)
    for field in descriptor.fields:
        inner = field.message_type
        # protobuf before 6.31 has labels in place of the property.
        is_list = getattr(field, "is_repeated", getattr(field, "label", None) == field.LABEL_REPEATED)
        if is_list or (inner and inner.full_name not in known and _has_lists(inner, known)):
            return True
    return False


def decoder_for(channel: Channel, schema: Schema | None, spending: Spending) -> Decoder:
    """The function from messages of a channel to their records; what they cost is taken from `spending`.

    If there is none, a MessageError is raised.
    """
    if schema is None:
        raise MessageError("it has no schema")
    name, encoding, take = schema.name, channel.message_encoding, spending.take_parts
    if len(schema.data) > SCHEMA:
        raise MessageError(f"the definition of {name[:80]} has {len(schema.data)} bytes, beyond the limit of {SCHEMA}")
    if encoding == "cdr" and schema.encoding == "ros2msg" and name.replace("/msg/", "/") in ros2_schemas.SCHEMAS:
        spending.take_schema(len(schema.data))
        try:
            return ros2_schemas.decoder(name, schema.data.decode(), take)
        except UnicodeDecodeError as error:
            raise MessageError(f"the definition of {name} is not UTF-8") from error
    if encoding == "json" and name in foxglove_schemas.SCHEMAS:
        parse = partial(foxglove_schemas.parse_json, take=take)
        return foxglove_schemas.decoder(name, parse, foxglove_schemas.JSON, take)
    if encoding == "protobuf" and name in foxglove_schemas.SCHEMAS:
        spending.take_schema(len(schema.data))
        return foxglove_schemas.decoder(name, _protobuf_parser(schema), foxglove_schemas.PROTOBUF, take)
    raise MessageError(f"schema {name!r} ({schema.encoding}) in {encoding!r} is not read by this library")
