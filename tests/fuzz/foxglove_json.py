"""Messages in JSON: the first byte names the schema, the rest is one message, or several with a null byte between."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from harness import Harness, check_said
from mutations import json_tree
from seed_messages import FOXGLOVE

from gtsam_rwhec.files.budgets import Spending
from gtsam_rwhec.logs.foxglove_messages import JSON, foxglove_decoder, parse_json

NAMES = sorted(FOXGLOVE)


def read(data: bytes) -> None:
    """Records or sentences; both can be printed."""
    if not data:
        return
    take = Spending(Path("a.mcap"), len(data)).take_parts
    parse = partial(parse_json, take=take)
    decode = foxglove_decoder(NAMES[data[0] % len(NAMES)], parse, JSON, take)
    messages = data[1:].split(b"\0")
    found = decode("/topic", messages, list(range(len(messages))))
    assert len(found) == len(messages)
    check_said(found)


def mutate(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change one message's tree, or the schema that it is read as."""
    if not data or chance.random() < 0.05:
        return plain(data)
    messages = data[1:].split(b"\0")
    which = chance.randrange(len(messages))
    messages[which] = json_tree(messages[which], chance, plain)
    kind = data[:1] if chance.random() < 0.95 else bytes([chance.randrange(len(NAMES))])
    return kind + b"\0".join(messages)


def seeds() -> Iterable[bytes]:
    """A message of each schema."""
    for i, name in enumerate(NAMES):
        message = json.dumps(FOXGLOVE[name]).encode()
        yield bytes([i]) + message
        yield bytes([i]) + message + b"\0" + message


HARNESS = Harness(read, seeds, mutate)
